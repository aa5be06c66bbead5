// SPDX-License-Identifier: Apache-2.0
// Configuration of the example pages; `npm run build` builds them into dist/. The scene is in public/.
import { defineConfig } from 'vite';
import manifest from './package.json' with { type: 'json' };

const pages = ['index', 'three', 'spark', 'playcanvas', 'babylon', 'view'];

export default defineConfig({
  base: './',
  // The decoder is outside node_modules and must use the engines installed here.
  resolve: { dedupe: Object.keys(manifest.dependencies) },
  server: { fs: { allow: ['.', '../../codec/js'] } },
  build: {
    rollupOptions: { input: pages.map((name) => `${name}.html`) },
    chunkSizeWarningLimit: 4000,
    target: 'esnext',
  },
});
