// SPDX-License-Identifier: Apache-2.0
import type { ReactNode } from 'react';

export const metadata = { title: '.csplat', icons: 'data:,' };
export const dynamic = 'force-dynamic'; // rendered on the server for each request

export default function Layout({ children }: { children: ReactNode }) {
  return (
    <html lang="en">
      <body>{children}</body>
    </html>
  );
}
