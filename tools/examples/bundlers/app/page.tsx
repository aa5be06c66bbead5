// SPDX-License-Identifier: Apache-2.0
// page.tsx
'use client'; // the server renders it, too, and imports the loader for that

import { useEffect, useRef } from 'react';
import { show } from '../scene';

export default function Page() {
  const canvas = useRef<HTMLCanvasElement>(null);
  useEffect(() => {
    const controller = new AbortController();
    const url = new URLSearchParams(location.search).get('scene') ?? 'scene.csplat';
    show(canvas.current!, url, controller.signal).then(
      (count) => (document.title = `${count} splats`),
      (error: unknown) => controller.signal.aborted || (document.title = String(error)),
    );
    return () => controller.abort();
  }, []);
  return <canvas ref={canvas} style={{ width: '100%', height: '90vh' }} />;
}
