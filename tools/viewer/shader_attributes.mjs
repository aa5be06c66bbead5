// SPDX-License-Identifier: Apache-2.0
// Layout constants of the textures, and the shader code that reads attributes from them. texels.mjs describes the layout.

/** Texels per row of the textures that are addressed by one number. */
export const ROW_TEXELS = 2048;

/** Texels of a tile's row in the table of tiles: 3 for geometry, then 2 for each SH band. @param {number} shDegree */
export const tileTexels = (shDegree) => 3 + 2 * shDegree;

/** Records per row, one quad of an instance each. */
export const RECORD_COLUMNS = 512;

/** How a tile stores an SH band. */
export const BAND_NONE = 0;
export const BAND_ROWS = 1;
export const BAND_CODEBOOK = 2;

/** Position, in the first word of a tile's constants, of the shares of its optical depth that are not drawn. */
export const FADE_SHIFT = 25;

/**
 * Return the eight words of a tile's constants for an SH band, in both back ends.
 *
 * @param {import('./texels.mjs').BandTexels} band
 * @param {{at: number, rows: import('./texels.mjs').Rows} | null | undefined} table of its codebook
 * @param {number} rowsAt where its rows are
 * @param {number} [indexAt] where its indices are
 */
export function bandConstants({ rows, codebook }, table, rowsAt, indexAt = 0) {
  const words = new Uint32Array(8);
  const floats = new Float32Array(words.buffer);
  const rowBits = (rows ? rows.bits : 1) << 16;
  if (codebook && table) {
    const { rows: entries, at } = table;
    const bits = (codebook.indexBits << 2) | (entries.bits << 8) | rowBits;
    words.set([BAND_CODEBOOK | bits, indexAt, at, rowsAt]);
    floats.set([entries.offset, rows?.offset ?? 0, entries.step], 4);
    words[7] = codebook.size;
  } else {
    words.set([BAND_ROWS | rowBits, 0, 0, rowsAt]);
    floats.set([0, rows?.offset ?? 0, rows?.step ?? 0], 4);
  }
  return words;
}

/** Reads the fields of a splat in order. */
export const READ_GEOMETRY = `
uniform usampler2D uFirst; // first texel of each splat
uniform usampler2D uStore; // everything else, as words
uniform usampler2D uTiles; // constants of tiles
uniform uint uTileTexels; // texels of a tile
uniform sampler2D uPlaces; // per tile: corner in camera coordinates, step
uniform usampler2D uBlocks; // tile of each block of slots

ivec2 place(uint i) {
  return ivec2(i % ${ROW_TEXELS}u, i / ${ROW_TEXELS}u);
}

// A word of the store; a texel is fetched when a new one begins, and for the first word of a run.
uvec4 gTexel;
uint storeWord(uint at, bool isFirst) {
  if (isFirst || (at & 3u) == 0u) gTexel = texelFetch(uStore, place(at >> 2), 0);
  return gTexel[at & 3u];
}

uvec4 gFirst; // words of the first texel
uint gWord; // index of the splat's next word
uint gMore; // word of the store that continues the first texel
uint gBuffer; // remaining bits of the last word
uint gBuffered;

// The next field, of 1 to 32 bits.
uint field(uint bits) {
  uint value = gBuffer;
  if (gBuffered < bits) {
    uint word = gWord < 4u ? gFirst[gWord] : storeWord(gMore + gWord - 4u, gWord == 4u);
    gWord++;
    value |= word << gBuffered;
    uint used = bits - gBuffered;
    gBuffer = used < 32u ? word >> used : 0u;
    gBuffered = 32u - used;
  } else {
    gBuffer = gBuffer >> bits;
    gBuffered -= bits;
  }
  return bits < 32u ? value & ((1u << bits) - 1u) : value;
}

vec3 field3(uint bits) {
  float a = float(field(bits));
  float b = float(field(bits));
  return vec3(a, b, float(field(bits)));
}

// Values of three columns: offset + field × step, or binary32 patterns.
vec3 values(uint bits, uvec4 lattice) {
  uint a = field(bits);
  uint b = field(bits);
  uvec3 n = uvec3(a, b, field(bits));
  if (bits == 32u) return uintBitsToFloat(n);
  return uintBitsToFloat(lattice.xyz) + vec3(n) * uintBitsToFloat(lattice.w);
}
`;

/** Reads the coefficients of a band in order. */
export const READ_BANDS = `
uint rNext; // word of the store
bool rIsFirst;
uint rWord;
uint rFields; // remaining fields of the word
uint rBits;
float rOffset;
float rStep;

void openRow(uint word, uint bits, float offset, float step) {
  rNext = word;
  rIsFirst = true;
  rBits = bits;
  rOffset = offset;
  rStep = step;
  rFields = 0u;
}

float coefficient() {
  if (rFields == 0u) {
    rWord = storeWord(rNext, rIsFirst);
    rNext++;
    rIsFirst = false;
    rFields = 32u / rBits;
  }
  rFields--;
  if (rBits == 32u) return uintBitsToFloat(rWord);
  uint n = rWord & ((1u << rBits) - 1u);
  rWord = rWord >> rBits;
  return (float(n) + rOffset) * rStep;
}

vec3 coefficient3() {
  float r = coefficient();
  float g = coefficient();
  return vec3(r, g, coefficient());
}

uint rowWords(uint columns, uint bits) {
  uint perWord = 32u / bits;
  return (columns + perWord - 1u) / perWord;
}

// Go to a splat's coefficients of a band; return false if its tile has none.
bool openBand(uint tile, uint local, uint band) {
  uint row = tile * uTileTexels + 1u + 2u * band;
  uvec4 head = texelFetch(uTiles, place(row), 0); // kind and bits, index, table, rows
  uint kind = head.x & 3u;
  if (kind == ${BAND_NONE}u) return false;
  uvec4 more = texelFetch(uTiles, place(row + 1u), 0); // offset of the table, of the rows, step, entries
  uint columns = 3u * (2u * band + 1u);
  uint rowBits = (head.x >> 16) & 63u;
  uint at = local;
  if (kind == ${BAND_CODEBOOK}u) {
    uint bits = (head.x >> 2) & 63u;
    uint perWord = 32u / bits;
    uint index = storeWord(4u * head.y + local / perWord, true) >> (bits * (local % perWord));
    if (bits < 32u) index &= (1u << bits) - 1u;
    if (index < more.w) {
      uint tableBits = (head.x >> 8) & 63u;
      uint table = 4u * head.z + index * rowWords(columns, tableBits);
      openRow(table, tableBits, uintBitsToFloat(more.x), uintBitsToFloat(more.z));
      return true;
    }
    at = index - more.w;
  }
  openRow(4u * head.w + at * rowWords(columns, rowBits), rowBits, uintBitsToFloat(more.y), uintBitsToFloat(more.z));
  return true;
}
`;

/** Spherical harmonics with the order and signs of csplat_render/projection.py. */
export const COLOUR = `
uniform int uDegree;

vec3 band1(vec3 d) {
  vec3 sum = -0.4886025119029199 * d.y * coefficient3();
  sum += 0.4886025119029199 * d.z * coefficient3();
  sum += -0.4886025119029199 * d.x * coefficient3();
  return sum;
}

vec3 band2(vec3 d) {
  vec3 s = d * d;
  vec3 sum = 1.0925484305920792 * d.x * d.y * coefficient3();
  sum += -1.0925484305920792 * d.y * d.z * coefficient3();
  sum += 0.31539156525252005 * (2.0 * s.z - s.x - s.y) * coefficient3();
  sum += -1.0925484305920792 * d.x * d.z * coefficient3();
  sum += 0.5462742152960396 * (s.x - s.y) * coefficient3();
  return sum;
}

vec3 band3(vec3 d) {
  vec3 s = d * d;
  vec3 sum = -0.5900435899266435 * d.y * (3.0 * s.x - s.y) * coefficient3();
  sum += 2.890611442640554 * d.x * d.y * d.z * coefficient3();
  sum += -0.4570457994644658 * d.y * (4.0 * s.z - s.x - s.y) * coefficient3();
  sum += 0.3731763325901154 * d.z * (2.0 * s.z - 3.0 * s.x - 3.0 * s.y) * coefficient3();
  sum += -0.4570457994644658 * d.x * (4.0 * s.z - s.x - s.y) * coefficient3();
  sum += 1.445305721320277 * d.z * (s.x - s.y) * coefficient3();
  sum += -0.5900435899266435 * d.x * (s.x - 3.0 * s.y) * coefficient3();
  return sum;
}

vec3 band4(vec3 d) {
  vec3 s = d * d;
  vec3 sum = 2.5033429417967046 * d.x * d.y * (s.x - s.y) * coefficient3();
  sum += -1.7701307697799304 * d.y * d.z * (3.0 * s.x - s.y) * coefficient3();
  sum += 0.9461746957575601 * d.x * d.y * (7.0 * s.z - 1.0) * coefficient3();
  sum += -0.6690465435572892 * d.y * d.z * (7.0 * s.z - 3.0) * coefficient3();
  sum += 0.10578554691520431 * (s.z * (35.0 * s.z - 30.0) + 3.0) * coefficient3();
  sum += -0.6690465435572892 * d.x * d.z * (7.0 * s.z - 3.0) * coefficient3();
  sum += 0.47308734787878004 * (s.x - s.y) * (7.0 * s.z - 1.0) * coefficient3();
  sum += -1.7701307697799304 * d.x * d.z * (s.x - 3.0 * s.y) * coefficient3();
  sum += 0.6258357354491761 * (s.x * (s.x - 3.0 * s.y) - s.y * (3.0 * s.x - s.y)) * coefficient3();
  return sum;
}

vec3 colourOf(uint tile, uint local, vec3 sh0, vec3 d) {
  vec3 sum = 0.5 + 0.28209479177387814 * sh0;
  if (uDegree >= 1 && openBand(tile, local, 1u)) sum += band1(d);
  if (uDegree >= 2 && openBand(tile, local, 2u)) sum += band2(d);
  if (uDegree >= 3 && openBand(tile, local, 3u)) sum += band3(d);
  if (uDegree >= 4 && openBand(tile, local, 4u)) sum += band4(d);
  return clamp(sum, 0.0, 60000.0); // records store it in half precision
}
`;
