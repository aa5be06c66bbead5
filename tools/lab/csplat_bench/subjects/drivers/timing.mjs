// SPDX-License-Identifier: Apache-2.0
// Times one decoding: [seconds, bytes of all arrays]. A gc() in between would discard compiled code.

export async function once(decode, bytes) {
  const start = performance.now();
  const result = await decode(bytes);
  const seconds = (performance.now() - start) / 1000;
  const arrays = Object.values(result).filter(ArrayBuffer.isView);
  return [seconds, arrays.reduce((sum, array) => sum + array.byteLength, 0)];
}
