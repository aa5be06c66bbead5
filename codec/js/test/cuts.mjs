/**
 * Return the options of `cut` for a cut of the conformance suite.
 *
 * @param {string} line such as `level 1`, `pixel_size 0.5`, `pixel_size 0.5 0.25`, `splats 100`
 */
export function cutOptions(line) {
  const [name, ...words] = line.trim().split(/\s+/);
  const numbers = words.map(Number);
  if (name === 'level') return { level: numbers[0] };
  if (name === 'splats') return { maxSplats: numbers[0] };
  if (name === 'pixel_size') return { pixelSize: numbers.length === 1 ? numbers[0] : numbers };
  throw new Error(`not a cut: ${line}`);
}
