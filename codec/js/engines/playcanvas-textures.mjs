// SPDX-License-Identifier: Apache-2.0
// Stores a file's integers in textures for PlayCanvas, in the narrowest format that the scene allows. Independent of the
// engine, for testing.

/**
 * @typedef {import('../decoder.d.ts').AttributeRecord} AttributeRecord
 * @typedef {import('../decoder.d.ts').Header} Header
 * @typedef {import('../decoder.d.ts').Packed} Packed
 * @typedef {import('../decoder.d.ts').PackedColumns} PackedColumns
 * @typedef {import('../decoder.d.ts').PackedTile} PackedTile
 * @typedef {Uint8Array | Uint16Array | Uint32Array | Float32Array} Texels four elements per texel
 * @typedef {{width: number, height: number, texels: Texels}} Image
 * @typedef {{low: number, step: number, bits: number}} Lattice value = (low + texel) * step
 */

/**
 * Return the images of geometry and base colours.
 *
 * @param {Header} header
 * @param {PackedTile[]} tiles all tiles
 * @param {number} maxSize maximum texture size
 */
export function imagesOf(header, tiles, maxSize) {
  const count = header.splatCount;
  const image = (/** @type {number} */ bits) => imageOf(count, bits);
  const of = (/** @type {'scales' | 'sh0'} */ name) => latticeOf(tiles.map((tile) => tile[name]));
  const opacity = /** @type {AttributeRecord} */ (header.attributes.find(({ name }) => name === 'opacities'));
  const quat = /** @type {AttributeRecord} */ (header.attributes.find(({ name }) => name === 'quats'));
  const [scales, colours] = [of('scales'), of('sh0')];
  const quats = latticeOf(tiles.map((tile) => ({ ...tile.quats, step: 1 })));
  const widest = Math.max(tiles.length, ...header.tiles.flatMap(({ extent }) => extent));
  /** @type {Record<string, Image>} */
  const images = {
    csMeans: image(bitsFor(widest)),
    csShapes: image(Math.max(scales.bits, bitsFor(opacity.levels))),
    csQuats: image(quats.bits),
    csColours: image(colours.bits),
    csTiles: tileTable(tiles, maxSize),
  };
  for (const { index, first } of header.tiles) {
    const tile = tiles[index];
    putElements(tile.means, images.csMeans.texels, first);
    for (let i = first; i < first + tile.count; i++) images.csMeans.texels[4 * i + 3] = index;
    putElements(tile.scales, images.csShapes.texels, first, scales);
    for (let i = 0; i < tile.count; i++) {
      images.csShapes.texels[4 * (first + i) + 3] = tile.opacities.offsets[0] + tile.opacities.columns[i];
    }
    putElements({ ...tile.quats, step: 1 }, images.csQuats.texels, first, quats);
    putElements(tile.sh0, images.csColours.texels, first, colours);
  }
  const parameters = {
    csShape: [scales.low, scales.step, opacity.levels, opacity.mapping === 'square' ? 1 : 0],
    csOther: [colours.low, colours.step, quats.low, 1 / (quat.levels * Math.SQRT2)],
    csLows: [0, 0, 0, header.flat ? 1 : 0],
    csSteps: [0, 0, 0, 0],
  };
  const { texels } = images.csMeans;
  const lattices = header.tiles.map(({ index, first }) => {
    const { count, means: { offsets, step } } = tiles[index]; // prettier-ignore
    return { first, end: first + count, offsets, step };
  });
  return { images, parameters, centersOf: () => centersOf(texels, lattices) };
}

/**
 * Return the means, for engines that sort on the CPU.
 *
 * @param {Texels} texels of the means
 * @param {{first: number, end: number, offsets: number[], step: number}[]} lattices of each tile, in order
 */
function centersOf(texels, lattices) {
  const centers = new Float32Array(3 * (lattices.at(-1)?.end ?? 0));
  for (const { first, end, offsets, step } of lattices) {
    for (let i = first; i < end; i++) {
      for (let c = 0; c < 3; c++) centers[3 * i + c] = (offsets[c] + texels[4 * i + c]) * step;
    }
  }
  return centers;
}

/**
 * Return the images of SH bands, with their parameters, which replace some of those of `imagesOf`.
 *
 * @param {Header} header
 * @param {(Packed | null | undefined)[][]} layers for each band, the bands of all tiles
 * @param {number} maxSize maximum texture size
 */
export function bandImagesOf(header, layers, maxSize) {
  const bands = layers.map((tiles, i) => bandOf(header, tiles, i + 1, maxSize));
  /** @type {Record<string, Image>} */
  const images = {};
  for (const [i, band] of bands.entries()) images[`csBand${i + 1}`] = band.image;
  images.csRows = imageOf(header.splatCount, bitsFor(Math.max(...bands.map(({ size }) => size))));
  const { texels } = images.csRows;
  for (const [band, { index }] of bands.entries())
    for (let i = 0; i < index.length; i++) texels[4 * i + band] = index[i];
  const lattice = (/** @type {number} */ i) => bands[i]?.lattice ?? { low: 0, step: 0 };
  const parameters = {
    csLows: [lattice(0).low, lattice(1).low, lattice(2).low, header.flat ? 1 : 0],
    csSteps: [lattice(0).step, lattice(1).step, lattice(2).step, 0],
  };
  return { images, parameters };
}

/**
 * Return an image with one texel per splat.
 *
 * @param {number} count
 * @param {number} bits
 * @returns {Image}
 */
function imageOf(count, bits) {
  const width = Math.max(1, Math.ceil(Math.sqrt(count)));
  const height = Math.max(1, Math.ceil(count / width));
  return { width, height, texels: arrayOf(bits, 4 * width * height) };
}

/**
 * Return an image with the corner and step of each tile.
 *
 * @param {PackedTile[]} tiles
 * @param {number} maxSize
 * @returns {Image}
 */
function tileTable(tiles, maxSize) {
  const width = Math.max(1, Math.min(tiles.length, maxSize));
  const height = Math.max(1, Math.ceil(tiles.length / width));
  const texels = new Float32Array(4 * width * height);
  for (const [i, { means }] of tiles.entries())
    texels.set([...means.offsets.map((offset) => offset * means.step), means.step], 4 * i);
  return { width, height, texels };
}

/**
 * Return the images of an SH band: a table of rows, in which codebook entries occur once, and each splat's row.
 *
 * @param {Header} header
 * @param {(Packed | null | undefined)[]} bands the bands of all tiles
 * @param {number} layer
 * @param {number} maxSize
 */
function bandOf(header, bands, layer, maxSize) {
  const terms = 2 * layer + 1;
  const tables = new Set(bands.flatMap((band) => (band?.lookup ? [band.lookup.table] : [])));
  const direct = bands.flatMap((band) => band ?? []);
  const lattice = latticeOf([...tables, ...direct], true);
  const sizeOf = (/** @type {PackedColumns} */ { columns }) => columns.length / (3 * terms);
  const size = 1 + [...tables, ...direct].reduce((sum, one) => sum + sizeOf(one), 0); // row 0 is 0
  const perLine = Math.max(1, Math.min(Math.floor(maxSize / terms), Math.ceil(Math.sqrt(size / terms))));
  const image = { width: terms * perLine, height: Math.ceil(size / perLine), texels: arrayOf(lattice.bits, 0) };
  image.texels = arrayOf(lattice.bits, 4 * image.width * image.height);
  image.texels.fill(-lattice.low, 0, 4 * terms);
  let used = 1;
  const add = (/** @type {PackedColumns} */ packed) => {
    const n = sizeOf(packed);
    for (let c = 0; c < 3 * terms; c++) {
      const place = 4 * (c % terms) + Math.floor(c / terms); // columns are ordered by channel
      const offset = packed.offsets[c];
      const factor = packed.step / lattice.step;
      for (let i = 0; i < n; i++) {
        image.texels[4 * terms * (used + i) + place] =
          Math.round((offset + packed.columns[c * n + i]) * factor) - lattice.low;
      }
    }
    used += n;
    return used - n;
  };
  const firstOf = new Map([...tables].map((table) => [table, add(table)]));
  const index = new Uint32Array(header.splatCount);
  for (const { index: tile, first } of header.tiles) {
    const band = bands[tile];
    if (!band) continue;
    if (band.lookup) {
      const start = /** @type {number} */ (firstOf.get(band.lookup.table));
      for (const [i, row] of band.lookup.index.entries()) index[first + i] = start + row;
    }
    const start = add(band);
    const n = sizeOf(band);
    for (let i = 0; i < n; i++) index[first + (band.rows ? band.rows[i] : i)] = start + i;
  }
  return { image, index, size, lattice };
}

/**
 * Return one offset and step for columns of one attribute, whose steps differ by powers of two, and the bits of the texels.
 *
 * @param {PackedColumns[]} all
 * @param {boolean} [zero] whether 0 is among the values
 * @returns {Lattice}
 */
function latticeOf(all, zero = false) {
  let step = Math.min(...all.map((packed) => packed.step));
  if (step === Infinity) step = 1;
  let [low, high] = zero ? [0, 0] : [Infinity, -Infinity];
  for (const { columns, offsets, step: own } of all) {
    const n = columns.length / offsets.length;
    for (let c = 0; c < offsets.length; c++) {
      for (let i = c * n; i < (c + 1) * n; i++) {
        const integer = ((offsets[c] + columns[i]) * own) / step;
        if (integer < low) low = integer;
        if (integer > high) high = integer;
      }
    }
  }
  if (low > high) low = high = 0;
  for (; high - low >= 2 ** 32 - 2; step *= 2) {
    low = Math.floor(low / 2); // larger differences do not fit a texel
    high = Math.ceil(high / 2);
  }
  return { low, step, bits: bitsFor(high - low) };
}

/**
 * Write three columns to texels; without a lattice, write the elements unchanged.
 *
 * @param {PackedColumns} packed
 * @param {Texels} texels
 * @param {number} first
 * @param {Lattice} [lattice]
 */
function putElements({ columns, offsets, step }, texels, first, lattice) {
  const n = columns.length / 3;
  const factor = lattice ? step / lattice.step : 1;
  for (let c = 0; c < 3; c++) {
    const [start, low] = lattice ? [offsets[c], lattice.low] : [0, 0];
    for (let i = 0; i < n; i++) texels[4 * (first + i) + c] = Math.round((start + columns[c * n + i]) * factor) - low;
  }
}

/** @param {number} most */
const bitsFor = (most) => (most < 2 ** 8 ? 8 : most < 2 ** 16 ? 16 : 32);

/**
 * @param {number} bits
 * @param {number} length
 */
function arrayOf(bits, length) {
  return bits === 8 ? new Uint8Array(length) : bits === 16 ? new Uint16Array(length) : new Uint32Array(length);
}
