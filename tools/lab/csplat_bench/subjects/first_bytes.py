# SPDX-License-Identifier: Apache-2.0
"""The first bytes of a file: what a viewer can show of them, next to the finished scene.

A case has `levels`, true if the file has levels of detail, and `share`, the fraction of the file that has arrived; or
`first = true`: as many bytes as the coarsest version of the whole scene takes, without SH bands. A node is drawn until
layer 0 of all of its children is there, each tile with the SH bands that are there. PSNR is pooled over the views of
`csplat compare`, against renders of the finished file.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np

import csplat
from csplat import _spec
from csplat.decoder import Node, SceneHeader, decode
from csplat.model import SplatModel
from csplat.scene import join_blocks
from csplat.splat_file import SplatFile
from csplat_bench.protocol import Measure, Setup
from csplat_bench.scenes import find_scene
from csplat_bench.suites import Case
from csplat_render.metrics import psnr_of_mse
from csplat_render.rasteriser import Rasteriser
from csplat_tools.level_builder import FittedLevelBuilder
from csplat_tools.views import comparison_cameras


@contextmanager
def measure_first_bytes(setup: Setup, name: str, _: Sequence[Case]) -> Iterator[Measure]:
    """Yield the function that draws the beginning of a file."""
    model = csplat.read(find_scene(name, setup.data, setup.work).path)
    files = {False: csplat.encode(model), True: csplat.encode(model, levels=FittedLevelBuilder())}
    cameras = comparison_cameras(model)
    rasteriser = Rasteriser()

    def render(splats: SplatModel) -> list[Any]:
        return [
            rasteriser.forward(splats, one, antialiased=splats.metadata.antialiased).rgb.clip(0.0, 1.0)
            for one in cameras
        ]

    finished = {levels: render(decode(data)) for levels, data in files.items()}

    def measure(case: Case) -> Mapping[str, Any]:
        data = files[case["levels"]]
        with SplatFile.open(data) as file:
            header, nodes = file.header, file.nodes
        size = first_whole(nodes) if case.get("first") else round(case["share"] * len(data))
        shown = show(data, header, nodes, size)
        images = render(shown)
        pairs = zip(images, finished[case["levels"]], strict=True)
        error = float(np.mean([np.mean((image - wanted) ** 2, dtype=np.float64) for image, wanted in pairs]))
        return {
            "splats": len(model), "file_bytes": len(data), "bytes": size, "shown": len(shown),
            "psnr": psnr_of_mse(error),
        }  # fmt: skip

    yield measure


def first_whole(nodes: Sequence[Node]) -> int:
    """Return the bytes up to the end of layer 0 of all roots."""
    roots = [tile for node in nodes if node.parent is None for tile in node.tiles]
    return max(tile.layers[_spec.LAYER_GEOMETRY].offset + tile.layers[_spec.LAYER_GEOMETRY].size for tile in roots)


def show(data: bytes, header: SceneHeader, nodes: Sequence[Node], size: int) -> SplatModel:
    """Return the splats that a viewer draws of the first `size` bytes of a file."""
    books = {
        (one.id, one.layer)
        for one in header.directory
        if one.type == _spec.CHUNK_CODEBOOK and one.offset + one.size <= size
    }
    degrees: dict[int, int] = {}  # highest band of each tile that is here
    for tile in header.all_tiles:
        for layer in range(header.sh_degree + 1):
            chunk = tile.layers.get(layer)
            known = all((book, layer) in books for book in tile.codebook_ids if _covers(header, book, layer))
            if not known or (chunk is not None and chunk.offset + chunk.size > size):
                break
            degrees[tile.index] = layer
    drawn: list[int] = []
    is_here = [all(tile.index in degrees for tile in node.tiles) for node in nodes]
    replaced = [False] * len(nodes)
    for number in reversed(range(len(nodes))):
        node = nodes[number]
        if node.parent is not None and not replaced[node.parent]:
            continue
        if node.children and all(is_here[child] for child in node.children):
            replaced[number] = True
        else:
            drawn += [tile.index for tile in node.tiles if tile.index in degrees]
    parts = [
        _decode(data, [tile for tile in drawn if degrees[tile] == degree], degree, header)
        for degree in range(header.sh_degree + 1)
    ]
    return join_blocks(parts[0].select(slice(0, 0)), parts)


def _covers(header: SceneHeader, book: int, layer: int) -> bool:
    return any(one.codebook_id == book and one.band_first <= layer <= one.band_last for one in header.codebooks)


def _decode(data: bytes, tiles: list[int], degree: int, header: SceneHeader) -> SplatModel:
    """Decode tiles at a degree; the bands above are 0."""
    part = decode(data, tiles=tiles, sh_degree=degree)
    bands = np.zeros((len(part), (header.sh_degree + 1) ** 2 - 1, 3), np.float32)
    bands[:, : part.shN.shape[1]] = part.shN
    return replace(part, shN=bands)
