// CRC-32 (spec section 2) and SHA-256 (FIPS 180-4).

/** Bytes of a CRC-32. */
export const CRC_SIZE = 4;

/** @type {Uint32Array | null} eight tables of 256, made at the first use */
let crcTables = null;

function makeCrcTables() {
  const tables = new Uint32Array(8 * 256);
  for (let value = 0; value < 256; value++) {
    let crc = value;
    for (let bit = 0; bit < 8; bit++) crc = crc & 1 ? (crc >>> 1) ^ 0xedb88320 : crc >>> 1;
    tables[value] = crc;
  }
  for (let at = 256; at < tables.length; at++) {
    const before = tables[at - 256];
    tables[at] = (before >>> 8) ^ tables[before & 255];
  }
  return tables;
}

/**
 * CRC-32 of ISO 3309 and RFC 1952, eight bytes at a time ("slicing by eight", Intel 2006).
 *
 * @param {Uint8Array} bytes
 * @returns {number} 0 .. 2^32 − 1
 */
export function crc32(bytes) {
  const t = (crcTables ??= makeCrcTables());
  let crc = -1;
  let i = 0;
  for (const end = bytes.length - 7; i < end; i += 8) {
    crc ^= bytes[i] | (bytes[i + 1] << 8) | (bytes[i + 2] << 16) | (bytes[i + 3] << 24);
    crc =
      t[1792 + (crc & 255)] ^
      t[1536 + ((crc >>> 8) & 255)] ^
      t[1280 + ((crc >>> 16) & 255)] ^
      t[1024 + (crc >>> 24)] ^
      t[768 + bytes[i + 4]] ^
      t[512 + bytes[i + 5]] ^
      t[256 + bytes[i + 6]] ^
      t[bytes[i + 7]];
  }
  for (; i < bytes.length; i++) crc = (crc >>> 8) ^ t[(crc ^ bytes[i]) & 255];
  return ~crc >>> 0;
}

/**
 * SHA-256 by the platform where it has one, otherwise (pages without TLS) in plain JavaScript.
 *
 * @param {Uint8Array<ArrayBuffer>} bytes
 * @returns {Promise<Uint8Array>}
 */
export async function sha256(bytes) {
  const subtle = globalThis.crypto?.subtle;
  return subtle ? new Uint8Array(await subtle.digest('SHA-256', bytes)) : sha256Plain(bytes);
}

/** @type {{k: Int32Array, h: Int32Array} | null} */
let shaConstants = null;

/** The first bits of the fractional parts of cube and square roots of the first primes (FIPS 180-4, 4.2.2, 5.3.3). */
function makeShaConstants() {
  const primes = /** @type {bigint[]} */ ([]);
  for (let n = 2n; primes.length < 64; n++) if (primes.every((prime) => n % prime)) primes.push(n);
  /** @type {(value: bigint, power: number) => bigint} */
  const root = (value, power) => {
    let low = 0n;
    for (let bit = 1n << 40n; bit; bit >>= 1n) if ((low + bit) ** BigInt(power) <= value) low += bit;
    return low;
  };
  const k = Int32Array.from(primes, (prime) => Number(BigInt.asIntN(32, root(prime << 96n, 3))));
  const h = Int32Array.from(primes.slice(0, 8), (prime) => Number(BigInt.asIntN(32, root(prime << 64n, 2))));
  return { k, h };
}

/**
 * @param {Uint8Array} bytes
 * @returns {Uint8Array}
 */
export function sha256Plain(bytes) {
  const { k, h } = (shaConstants ??= makeShaConstants());
  const state = h.slice();
  const words = new Int32Array(64);
  const whole = bytes.length & ~63; // below 2^31: larger files have no single buffer here
  const tail = new Uint8Array(bytes.length - whole < 56 ? 64 : 128);
  tail.set(bytes.subarray(whole));
  tail[bytes.length - whole] = 128;
  new DataView(tail.buffer).setBigUint64(tail.length - 8, BigInt(bytes.length) * 8n);
  for (let at = 0; at < whole; at += 64) shaBlock(state, words, k, bytes, at);
  for (let at = 0; at < tail.length; at += 64) shaBlock(state, words, k, tail, at);
  const digest = new DataView(new ArrayBuffer(32));
  state.forEach((word, i) => digest.setInt32(4 * i, word));
  return new Uint8Array(digest.buffer);
}

/**
 * @param {Int32Array} state
 * @param {Int32Array} w
 * @param {Int32Array} k
 * @param {Uint8Array} bytes
 * @param {number} at
 */
function shaBlock(state, w, k, bytes, at) {
  for (let i = 0; i < 16; i++, at += 4) {
    w[i] = (bytes[at] << 24) | (bytes[at + 1] << 16) | (bytes[at + 2] << 8) | bytes[at + 3];
  }
  for (let i = 16; i < 64; i++) {
    const x = w[i - 15],
      y = w[i - 2];
    const s0 = ((x >>> 7) | (x << 25)) ^ ((x >>> 18) | (x << 14)) ^ (x >>> 3);
    const s1 = ((y >>> 17) | (y << 15)) ^ ((y >>> 19) | (y << 13)) ^ (y >>> 10);
    w[i] = (w[i - 16] + s0 + w[i - 7] + s1) | 0;
  }
  let [a, b, c, d, e, f, g, h] = state;
  for (let i = 0; i < 64; i++) {
    const s1 = ((e >>> 6) | (e << 26)) ^ ((e >>> 11) | (e << 21)) ^ ((e >>> 25) | (e << 7));
    const t1 = (h + s1 + ((e & f) ^ (~e & g)) + k[i] + w[i]) | 0;
    const s0 = ((a >>> 2) | (a << 30)) ^ ((a >>> 13) | (a << 19)) ^ ((a >>> 22) | (a << 10));
    const t2 = (s0 + ((a & b) ^ (a & c) ^ (b & c))) | 0;
    h = g;
    g = f;
    f = e;
    e = (d + t1) | 0;
    d = c;
    c = b;
    b = a;
    a = (t1 + t2) | 0;
  }
  state[0] += a;
  state[1] += b;
  state[2] += c;
  state[3] += d;
  state[4] += e;
  state[5] += f;
  state[6] += g;
  state[7] += h;
}
