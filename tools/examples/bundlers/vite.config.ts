// SPDX-License-Identifier: Apache-2.0
import { defineConfig } from 'vite';

export default defineConfig({ base: './', build: { outDir: 'dist/vite', chunkSizeWarningLimit: 4000 } });
