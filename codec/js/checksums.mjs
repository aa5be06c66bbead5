// SPDX-License-Identifier: Apache-2.0
// CRC-32 (spec section 2).

/** Size of a CRC-32 in bytes. */
export const CRC_SIZE = 4;

/** @type {Uint32Array | null} eight tables of 256 entries, built on first use */
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
 * Return the CRC-32 of ISO 3309 and RFC 1952, computed eight bytes at a time ("slicing by eight", Intel 2006).
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
