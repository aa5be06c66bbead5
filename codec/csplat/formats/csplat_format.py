""".csplat, the format of this project."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from csplat.decoder import open_tiles
from csplat.encoder import EncodeOptions
from csplat.formats.format import Format
from csplat.out_of_core import encode_scene
from csplat.scene_source import SceneSource


@contextmanager
def _open(path: Path) -> Iterator[SceneSource]:
    opened = open_tiles(path)
    yield SceneSource(opened.header.splat_count, opened.metadata_model, opened.models)


def _write(path: Path, scene: SceneSource) -> None:
    with tempfile.TemporaryDirectory(prefix=f".{path.name}.", dir=path.parent) as folder:
        encode_scene(scene, path, EncodeOptions(keep_extra=True), folder=Path(folder) / "work")


FORMAT = Format(
    name="csplat",
    open=_open,
    write=_write,
    splat_bytes=(7.0, 8.0, 9.0, 10.0),
    carries=frozenset(
        {"antialiased", "origin", "coordinate_system", "unit_metres", "flat", "cameras", "extra", "metadata"}
    ),
)
