// SPDX-License-Identifier: Apache-2.0
// The page of Vite, webpack and esbuild.
import { show } from './scene';

const url = new URLSearchParams(location.search).get('scene') ?? 'scene.csplat';
show(document.querySelector('canvas')!, url).then(
  (count) => (document.title = `${count} splats`),
  (error: unknown) => (document.title = String(error)),
);
