// SPDX-License-Identifier: Apache-2.0
export default {
  mode: 'production',
  entry: './main.ts',
  output: { path: `${import.meta.dirname}/dist/webpack`, publicPath: 'auto' },
  resolve: { extensions: ['.ts', '.js'] },
  module: { rules: [{ test: /\.ts$/, loader: 'ts-loader', options: { transpileOnly: true } }] },
  performance: { hints: false },
};
