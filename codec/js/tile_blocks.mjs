// SPDX-License-Identifier: Apache-2.0
// Decodes the blocks of one tile's layers to integers and checks them (spec 5.2, 6.4, 7.1, 7.2, 7.4).

import { readCodebookBlock } from './codebooks.mjs';
import {
  checkCoding,
  checkFinite,
  columnCount,
  everySplat,
  liftColours,
  readBlockHead,
  readValues,
} from './codings.mjs';
import { fault } from './errors.mjs';
import { ldexp } from './lattice.mjs';
import { Payload } from './payload.mjs';
import * as spec from './spec.mjs';
import { readStream } from './streams.mjs';

const { ERROR_BOX, ERROR_INDEX, ERROR_STREAM } = spec;
const { TILE_HEAD_OFFSETS: AT_HEAD, TILE_RECORD_OFFSETS: AT_RECORD } = spec;

/**
 * @typedef {import('./decoder.d.ts').Header} Header
 * @typedef {import('./decoder.d.ts').TileRecord} TileRecord
 * @typedef {import('./decoder.d.ts').LayerRecord} LayerRecord
 * @typedef {import('./decoder.d.ts').AttributeRecord} AttributeRecord
 * @typedef {import('./decoder.d.ts').CodebookRecord} CodebookRecord
 * @typedef {import('./decoder.d.ts').ExtraRecord} ExtraRecord
 * @typedef {import('./codings.mjs').Block} Block
 * @typedef {import('./codebooks.mjs').Indices} Indices
 * @typedef {import('./codebooks.mjs').Table} Table
 * @typedef {import('./inflate.mjs').Inflate} Inflate
 * @typedef {import('./streams.mjs').Elements} Elements
 *
 * The parts of a tile that a block's decoder uses.
 *
 * @typedef {object} TileContext
 * @property {number} splatCount
 * @property {Inflate} inflate
 * @property {Map<number, Indices>} indices indices of the codebooks used so far in the tile
 * @property {(attribute: AttributeRecord, n: number) => Float64Array} columns returns an array for integers of n splats
 * @property {(attribute: AttributeRecord) => Float64Array} sums returns a second array, for entries and their sums
 * @property {(id: number) => CodebookRecord | undefined} codebook returns a codebook that the tile lists
 * @property {(id: number, layer: number) => Promise<Table>} table
 * @property {(layer: number) => Promise<void>} needLayer ensures that the layer, if the tile has it, is decoded
 *
 * The parts that all tiles share.
 *
 * @typedef {object} SceneContext
 * @property {Header} header
 * @property {Map<number, CodebookRecord>} codebooks by id
 * @property {Inflate} inflate
 * @property {TileContext['table']} table
 * @property {(key: number, length: number) => Float64Array} scratch returns an array with arbitrary content, valid until
 *   the layer is done
 *
 * The result of decoding a layer.
 *
 * @typedef {{layer: number, blocks: Block[], extra?: Elements}} Layer
 */

/** Decodes the layers of one tile and keeps the data of earlier layers that later ones need. */
export class Tile {
  /**
   * @param {SceneContext} scene
   * @param {TileRecord} record
   * @param {TileContext['needLayer']} needLayer
   */
  constructor(scene, record, needLayer) {
    this.scene = scene;
    this.header = scene.header;
    this.record = record;
    this.splatCount = record.splatCount;
    this.inflate = scene.inflate;
    this.table = scene.table;
    this.needLayer = needLayer;
    /** @type {Map<number, Indices>} */
    this.indices = new Map();
  }

  /**
   * @param {AttributeRecord} attribute
   * @param {number} n
   */
  columns(attribute, n) {
    return this.scene.scratch(attribute.id, columnCount(attribute) * n);
  }

  /** @param {AttributeRecord} attribute */
  sums(attribute) {
    return this.scene.scratch(-attribute.id, columnCount(attribute) * this.splatCount);
  }

  /** @param {number} id */
  codebook(id) {
    return this.record.tables.includes(id) ? this.scene.codebooks.get(id) : undefined;
  }

  /**
   * Decode one layer. The blocks have their final integers: R, G, B, and the lattice of the file.
   *
   * @param {Uint8Array<ArrayBuffer>} bytes payload of the TILE chunk
   * @param {LayerRecord} place
   * @param {boolean} integers whether all integers are required; if not, colours may stay in tables
   * @returns {Promise<Layer>}
   */
  async readLayer(bytes, { layer, offset }, integers) {
    const payload = new Payload(bytes, offset + spec.CHUNK_HEADER_SIZE, 'TLE-3');
    const { fields, offset: at } = payload.read(
      spec.unpackTileHead,
      spec.TILE_HEAD_SIZE,
      spec.TILE_HEAD_RESERVED,
      'the head of a tile',
    );
    if (fields.layer !== layer)
      throw fault(ERROR_INDEX, at + AT_HEAD.layer, 'TLE-1', `layer ${fields.layer} instead of ${layer}`);
    const attributes = this.attributesOf(layer);
    const column = this.header.extras.find((one) => one.layer === layer);
    const wanted = column ? 1 : attributes.length;
    if (fields.block_count !== wanted) {
      throw fault(ERROR_STREAM, at + AT_HEAD.block_count, 'TLE-2', `${fields.block_count} blocks instead of ${wanted}`);
    }
    const blocks = [];
    for (const attribute of attributes) blocks.push(this.finish(await this.readBlock(payload, attribute, integers)));
    const extra = column && (await this.readRaw(payload, column));
    payload.finish();
    return { layer, blocks, extra };
  }

  /** @param {number} layer */
  attributesOf(layer) {
    const sh0 = spec.ATTRIBUTE_SH0;
    if (layer === spec.LAYER_GEOMETRY) return this.header.attributes.slice(0, sh0);
    return this.header.attributes.filter(({ id }) => id === sh0 + layer);
  }

  /**
   * @param {Payload} payload at the block's head
   * @param {AttributeRecord} attribute the attribute required here
   * @param {boolean} integers
   * @returns {Promise<Block>}
   */
  async readBlock(payload, attribute, integers) {
    const head = readBlockHead(payload);
    if (head.attribute !== attribute.id) {
      throw fault(ERROR_STREAM, head.offset, 'TLE-2', `attribute ${head.attribute} instead of ${attribute.name}`);
    }
    checkCoding(head);
    if (head.coding === spec.CODING_CODEBOOK) return readCodebookBlock(this, payload, attribute, integers);
    const block = await readValues(this, payload, attribute, head.coding, this.splatCount, false);
    return integers && block.present !== undefined ? everySplat(block, this.splatCount) : block;
  }

  /**
   * @param {Payload} payload at the block's head
   * @param {ExtraRecord} column
   */
  async readRaw(payload, { components, bytes }) {
    const head = readBlockHead(payload);
    if (head.attribute !== spec.ATTRIBUTE_EXTRA) {
      throw fault(ERROR_STREAM, head.offset, 'TLE-2', `attribute ${head.attribute} in the layer of an extra column`);
    }
    checkCoding(head);
    const widthMax = spec.CODING_WIDTH_MAX[spec.CODING_RAW];
    const stream = await readStream(payload, components * this.splatCount, widthMax, this.inflate);
    if (stream.width !== bytes) {
      const what = `elements of ${stream.width} bytes, the type has ${bytes}`;
      throw fault(ERROR_STREAM, stream.offset, 'RAW-2', what);
    }
    return stream;
  }

  /**
   * Convert a block's integers to the lattice of the file, in place, and check them.
   *
   * @param {Block} block
   * @returns {Block}
   */
  finish(block) {
    const { id, step } = block.attribute;
    if (id === spec.ATTRIBUTE_MEANS) {
      this.placeMeans(block); // their values are finite: the box is, by MEA-1
    } else if (step !== 0) {
      liftColours(block);
      const s = ldexp(step, block.exponent);
      checkFinite(block, s);
      if (id === spec.ATTRIBUTE_SCALES) this.checkMaxScale(block.columns, s);
    }
    return block;
  }

  /**
   * Check TIL-10, then add the corner: n = corner + q (spec 7.4).
   *
   * @param {Block} block
   */
  placeMeans(block) {
    const { corner, extent, exponent, recordOffset } = this.record;
    const n = this.splatCount;
    for (let axis = 0; axis < 3; axis++) {
      const column = block.columns.subarray(axis * n, (axis + 1) * n);
      let least = Infinity;
      let most = -Infinity;
      for (let i = 0; i < n; i++) {
        least = Math.min(least, column[i]);
        most = Math.max(most, column[i]);
      }
      // "The means' integers q MUST have on each axis the minimum 0 and the maximum extent."
      if (least !== 0 || most !== extent[axis]) {
        const what = `axis ${axis}: integers from ${least} to ${most}, the record has 0 to ${extent[axis]}`;
        throw fault(ERROR_BOX, recordOffset + AT_RECORD.corner, 'TIL-10', what);
      }
      const first = corner[axis];
      for (let i = 0; i < n; i++) column[i] += first; // at most 2^53 by TIL-7
    }
    block.exponent = exponent;
    block.bound = spec.INTEGER_MAX;
  }

  /**
   * Check the maximum scale of the tile record (TIL-11).
   *
   * @param {Float64Array} integers integers of the scales
   * @param {number} step
   */
  checkMaxScale(integers, step) {
    let largest = -Infinity;
    for (let i = 0; i < integers.length; i++) largest = Math.max(largest, integers[i]);
    const value = Math.fround(largest * step);
    const { maxScale, recordOffset } = this.record;
    if (!Object.is(value, maxScale)) {
      throw fault(
        ERROR_BOX,
        recordOffset + AT_RECORD.max_scale,
        'TIL-11',
        `the largest scale is ${value}, the record has ${maxScale}`,
      );
    }
  }
}
