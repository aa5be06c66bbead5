// The pages as they are; `npm run build` puts them into dist/. The scene lies in public/.
import { defineConfig } from 'vite';
import manifest from './package.json' with { type: 'json' };

const pages = ['index', 'three', 'spark', 'playcanvas', 'babylon', 'view'];

export default defineConfig({
  base: './',
  // The decoder lies beside these pages, not in node_modules, and takes its engines from here.
  resolve: { dedupe: Object.keys(manifest.dependencies) },
  server: { fs: { allow: ['.', '../../codec/js'] } },
  build: {
    rollupOptions: { input: pages.map((name) => `${name}.html`) },
    chunkSizeWarningLimit: 4000,
    target: 'esnext',
  },
});
