"""Forms in which a scene can be sent, all from the same PLY, and the programs that write them."""

from __future__ import annotations

import json
import subprocess
import zipfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from csplat.encoder import EncodeOptions, PresetName, encode
from csplat.formats import write
from csplat.ply import read_ply
from csplat_bench.common.scenes import Scene

_LEVELS = ("25%", "6%")  # shares of the splats in the levels below the finest

#: Writes a scene into an empty folder, returns the file that viewers open; the words are splat-transform's command.
Writer = Callable[[Scene, Path, Sequence[str]], Path]


@dataclass(frozen=True)
class Form:
    """A way to write a scene down.

    Attributes:
        title: title in the table.
        axes_of: the format whose axes its files have, as `csplat formats` names it.
        write: makes the files.
        foreign: whether splat-transform is needed for it.
    """

    title: str
    axes_of: str
    write: Writer
    foreign: bool = False


def size_of(folder: Path) -> int:
    """Bytes of all files."""
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


def _csplat(preset: PresetName) -> Writer:
    def written(scene: Scene, folder: Path, _: Sequence[str]) -> Path:
        path = folder / f"{scene.name}.csplat"
        path.write_bytes(encode(read_ply(scene.path), EncodeOptions(preset=preset)))
        return path

    return written


def _converted(format: str) -> Writer:
    def written(scene: Scene, folder: Path, _: Sequence[str]) -> Path:
        path = folder / f"{scene.name}.{format}"
        write(path, read_ply(scene.path), format)
        return path

    return written


def _transformed(scene: Scene, folder: Path, transform: Sequence[str]) -> Path:
    path = folder / f"{scene.name}.spz"
    _run(transform, "--spz-version", "3", scene.path, path)
    return path


def _levels(scene: Scene, folder: Path, transform: Sequence[str]) -> Path:
    """Streamed SOG of one chunk, as splat-transform lays it out, but that each level is what `csplat convert` writes.

    Its own coding of SH takes hours on a CPU.
    """
    sources = [scene.path]
    for share in _LEVELS:
        sources.append(folder / f"{share}.ply")
        _run(transform, "-g", "cpu", scene.path, sources[-1], "-d", share)
    models = [read_ply(source) for source in sources]
    for level, model in enumerate(models):
        bundle = folder / "level.sog"
        write(bundle, model, "sog")
        with zipfile.ZipFile(bundle) as files:
            files.extractall(folder / f"{level}_0")
        bundle.unlink()
    for source in sources[1:]:
        source.unlink()
    means = models[0].means
    counts = [len(model) for model in models]
    meta = {
        "version": 1, "asset": {"generator": "csplat_bench"}, "count": sum(counts), "counts": counts,
        "lodLevels": len(counts), "lodErrors": False, "filenames": [f"{i}_0/meta.json" for i in range(len(counts))],
        "tree": {
            "bound": {"min": means.min(0).tolist(), "max": means.max(0).tolist()},
            "lods": {str(i): {"file": i, "offset": 0, "count": count} for i, count in enumerate(counts)},
        },
    }  # fmt: skip
    path = folder / "lod-meta.json"
    path.write_text(json.dumps(meta))
    return path


def _run(transform: Sequence[str], *words: object) -> None:
    subprocess.run([*transform, "-q", "-w", *map(str, words)], check=True, capture_output=True)


#: By the names that options have.
FORMS = {
    "balanced": Form(".csplat, balanced", "csplat", _csplat("balanced")),
    "small": Form(".csplat, small", "csplat", _csplat("small")),
    "spz": Form("SPZ 3 of csplat", "spz", _converted("spz")),
    "spz-default": Form("SPZ 3 of splat-transform", "ply", _transformed, foreign=True),
    "sog": Form("SOG", "sog", _converted("sog")),
    "sog-levels": Form("streamed SOG", "sog", _levels, foreign=True),
}
