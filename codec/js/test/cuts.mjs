// SPDX-License-Identifier: Apache-2.0
/**
 * Return the options of `cut` for a cut of the conformance suite.
 *
 * @param {string} line such as `level 1`, `pixel_size 0.5 0.25`, `splats 100`, `level 0 box -1 -1 -1 1 1 1`
 */
export function cutOptions(line) {
  const [cut, corners] = line.trim().split(' box ');
  const [name, ...words] = cut.split(/\s+/);
  const numbers = words.map(Number);
  const box = corners?.split(/\s+/).map(Number);
  if (name === 'level') return { level: numbers[0], box };
  if (name === 'splats') return { maxSplats: numbers[0], box };
  if (name === 'pixel_size') return { pixelSize: numbers.length === 1 ? numbers[0] : numbers, box };
  throw new Error(`not a cut: ${line}`);
}
