// SPDX-License-Identifier: Apache-2.0
// The tiles that are drawn: those chosen for a view and, for a moment, those that they replace, which fade out meanwhile.

import { chooseTiles } from './level_cut.mjs';

/** Steps of a fade: at step k, new tiles are drawn with k shares of their opacity, old ones with the others. */
export const FADE_STEPS = 8;

/** Time between steps, milliseconds. Where drawing takes longer, steps are left out. */
export const STEP_MS = 40;

/** Makes two versions of an opaque splat, of shares that add up to one, together as opaque as one, averaged over its area. */
export const FADE_EXCESS = 0.34;

/**
 * Return the opacity of a splat that fades.
 *
 * @param {number} alpha
 * @param {number} shares 0 to FADE_STEPS
 */
export function fadedAlpha(alpha, shares) {
  const share = shares / FADE_STEPS;
  return alpha * share * (1 + FADE_EXCESS * alpha * (1 - share));
}

/** The tiles of a scene that are drawn. */
export class ShownTiles {
  /** @param {import('./tile_stream.mjs').TileStream} stream */
  constructor(stream) {
    this.stream = stream;
    /** Shares of each tile that is drawn; replaced, not changed. @type {Map<number, number>} */
    this.shares = new Map();
    /** Tiles that replace others, and these, of the last change. @type {number[]} */
    this.entering = [];
    /** @type {number[]} */
    this.leaving = [];
    /** Of the fade; 0 without one. */
    this.step = 0;
    this.steppedAt = -Infinity;
    /** Nodes that finer ones are drawn for. @type {Set<number>} */
    this.refined = new Set();
    /** Whether the tiles cover the whole scene. */
    this.isWhole = false;
    const nodeOf = new Uint32Array(stream.all.length);
    for (const { index, firstTile, tileCount } of stream.nodes) nodeOf.fill(index, firstTile, firstTile + tileCount);
    this.nodeOf = nodeOf;
  }

  get isFading() {
    return this.step > 0;
  }

  /** Number of splats that are drawn. */
  get splatCount() {
    return this.#splatsOf(this.shares.keys());
  }

  /**
   * Choose again, unless a fade has to go on. What is not in view does not fade, nor does anything if the budget has no room
   * for both versions, or before the whole scene is drawn.
   *
   * @param {(tile: number) => boolean} isHere
   * @param {number} now milliseconds
   * @param {number} [least] error, in pixels, up to which nodes stay
   */
  update(isHere, now, least) {
    const { stream, isWhole: wasWhole } = this;
    const { nodes, looks, budget, hasLevels } = stream;
    const areHere = [...this.shares.keys()].every(isHere);
    if (this.isFading && areHere) {
      this.#advance(Math.round((now - this.steppedAt) / STEP_MS), now);
      if (this.isFading) return;
    }
    const { shares: before } = this;
    const most = hasLevels ? budget : Infinity;
    const { tiles, isWhole, refined } = chooseTiles(nodes, isHere, looks, most, this.refined, least);
    this.isWhole = isWhole;
    this.refined = refined;
    if (tiles.length === before.size && tiles.every((tile) => before.has(tile))) return;
    this.shares = new Map(tiles.map((tile) => [tile, FADE_STEPS]));
    const isSeen = (/** @type {number} */ tile) => looks.isSeen[this.nodeOf[tile]];
    this.entering = tiles.filter((tile) => !before.has(tile) && isSeen(tile));
    this.leaving = [...before.keys()].filter((tile) => !this.shares.has(tile) && isSeen(tile));
    const hasRoom = this.#splatsOf(tiles) + this.#splatsOf(this.leaving) <= budget;
    this.step = 0;
    if (hasLevels && wasWhole && areHere && hasRoom && this.entering.length * this.leaving.length > 0)
      this.#advance(1, now);
  }

  /**
   * @param {number} steps
   * @param {number} now milliseconds
   */
  #advance(steps, now) {
    if (steps < 1) return;
    this.step = Math.min(FADE_STEPS, this.step + steps);
    this.steppedAt = now;
    this.shares = new Map(this.shares);
    for (const tile of this.entering) this.shares.set(tile, this.step);
    for (const tile of this.leaving) this.shares.set(tile, FADE_STEPS - this.step);
    if (this.step < FADE_STEPS) return;
    for (const tile of this.leaving) this.shares.delete(tile);
    this.step = 0;
  }

  /** @param {Iterable<number>} tiles */
  #splatsOf(tiles) {
    let sum = 0;
    for (const tile of tiles) sum += this.stream.all[tile].splatCount;
    return sum;
  }
}
