// SPDX-License-Identifier: Apache-2.0
// The textures of the PlayCanvas adapter have the values of the form 'floats'.
import assert from 'node:assert/strict';
import { test } from 'node:test';

import { CsplatReader } from '../decoder.mjs';
import { openScene } from '../engines/scene.mjs';
import { bandImagesOf, imagesOf } from '../engines/playcanvas-textures.mjs';
import { failures, manifest, vector } from './helpers.mjs';

const fit = Math.fround;
const valid = manifest.filter(({ name }) =>
  /^(valid|render).*(rich|combined_tiles|codebook|sparse|opacities|quats|tiles)/.test(name),
);

/** Return all images of a scene. */
function madeOf(header, tiles, size) {
  const base = imagesOf(header, tiles, size);
  if (header.shDegree === 0) return base;
  const layers = Array.from({ length: header.shDegree }, (_, i) => tiles.map(({ sh }) => sh[i]));
  const { images, parameters } = bandImagesOf(header, layers, size);
  return { ...base, images: { ...base.images, ...images }, parameters: { ...base.parameters, ...parameters } };
}

/** Read splats as the shaders do. */
function readerOf({ images, parameters }) {
  const texel = ({ width, height, texels }, x, y = 0) => {
    assert.ok(x < width && y < height, `texel ${x}, ${y} of ${width}, ${height}`);
    return texels.subarray(4 * (y * width + x), 4 * (y * width + x) + 4);
  };
  const at = (image, i) => texel(image, i % image.width, Math.floor(i / image.width));
  const { csShape, csOther, csLows, csSteps } = parameters;
  return {
    mean(i, c) {
      const mean = at(images.csMeans, i);
      const tile = at(images.csTiles, mean[3]);
      return tile[c] + fit(mean[c] * tile[3]);
    },
    scale: (i, c) => (at(images.csShapes, i)[c] + csShape[0]) * csShape[1],
    alpha: (i) => (at(images.csShapes, i)[3] / csShape[2]) ** (csShape[3] ? 2 : 1),
    quat: (i, c) => (at(images.csQuats, i)[c] + csOther[2]) * csOther[3],
    colour: (i, c) => (at(images.csColours, i)[c] + csOther[0]) * csOther[1],
    sh(i, band, m, c) {
      const image = images[`csBand${band}`];
      const line = image.width / (2 * band + 1);
      const row = at(images.csRows, i)[band - 1];
      return (
        (texel(image, (row % line) * (2 * band + 1) + m, Math.floor(row / line))[c] + csLows[band - 1]) *
        csSteps[band - 1]
      );
    },
  };
}

/** Check the textures of a version of a file. */
async function checkVersion(name, maxSplats) {
  const reader = await CsplatReader.open(new Blob([vector(name)]));
  const target = { name: 'test', engine: 'RUB', mirrors: true, shDegree: 3, maxSplats }; // PlayCanvas ends at degree 3
  const scene = await openScene(new Blob([vector(name)]), {}, target);
  const shDegree = scene.degree;
  const header = { ...scene.header, shDegree };
  const tiles = [];
  for await (const tile of scene.tiles()) tiles[tile.index] = tile;
  scene.release();
  const made = madeOf(header, tiles, 64); // many rows of few entries
  const splat = readerOf(made);
  const centers = made.centersOf();
  for (const { index, first, corner, extent, step } of header.tiles) {
    const floats = await reader.readTile(scene.indices[index], { shDegree });
    const near = (found, wanted, off, what) =>
      assert.ok(Math.abs(found - wanted) <= off, `${what}: ${found}, ${wanted}`);
    for (let i = 0; i < floats.count; i++) {
      for (let c = 0; c < 3; c++) {
        const mean = floats.means[3 * i + c];
        assert.equal(centers[3 * (first + i) + c], mean);
        near(splat.mean(first + i, c), mean, (Math.abs(corner[c]) + extent[c]) * step * 2 ** -22, 'mean');
        const value = (found, wanted, what) => near(found, wanted, Math.abs(wanted) * 2 ** -22 + 2 ** -31 * 100, what);
        value(splat.scale(first + i, c), floats.scales[3 * i + c], 'scale');
        value(splat.quat(first + i, c), floats.quats[4 * i + 1 + c], 'quat');
        value(splat.colour(first + i, c), floats.sh0[3 * i + c], 'colour');
        for (let band = 1, k = 0; band <= header.shDegree; band++) {
          for (let m = 0; m <= 2 * band; m++, k++) {
            const terms = (header.shDegree + 1) ** 2 - 1;
            value(splat.sh(first + i, band, m, c), floats.shN[3 * (terms * i + k) + c], 'sh');
          }
        }
      }
      near(splat.alpha(first + i), floats.opacities[i], 1e-7, 'alpha');
    }
  }
}

test('textures have the values of every vector', async () => {
  const failed = await failures(valid, async ({ name }) => {
    await checkVersion(name, Infinity);
    await checkVersion(name, 1); // the coarsest version
  });
  assert.deepEqual(failed, {});
});

test('texels have the narrowest possible type, and tables are stored once', async () => {
  const reader = await CsplatReader.open(new Blob([vector('valid/codebook_sh_1_3')]));
  const tile = await reader.readTile(0, { form: 'packed' });
  const { images } = madeOf(reader.header, [tile], 4096);
  assert.ok(images.csColours.texels instanceof Uint8Array);
  const entries = 1 + tile.sh[0].lookup.table.columns.length / 9 + tile.sh[0].rows.length;
  assert.ok(images.csBand1.width * images.csBand1.height < 3 * entries + images.csBand1.width);
});
