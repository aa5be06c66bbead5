"""Prepare scenes for the viewer: check a .csplat file, or encode a PLY."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from csplat._spec import ERROR_TRAILING, ERROR_TRUNCATED
from csplat.decoder import SceneHeader, decode, read_header
from csplat.encoder import EncodeOptions, PresetName, encode_with_report
from csplat.errors import CsplatError, FormatError
from csplat.lint import Finding
from csplat.model import UNSPECIFIED
from csplat.types import Progress
from csplat.upright import Direction
from csplat_render.camera_files import load_cameras
from csplat_render.virtual_cameras import estimate_up
from csplat_tools.files.convert import read_source
from csplat_tools.files.facts import SceneOverrides
from csplat_tools.files.streams import STANDARD_STREAM, is_csplat, local_path, mapped_csplat

_NONE = SceneOverrides()
_SPLATS_LOOKED_AT = 2_000_000  # larger files are not decoded only to estimate the up direction


@dataclass(frozen=True)
class ViewScene:
    """A scene that the viewer can show.

    Attributes:
        name: name of the file that the page shows; ends in `.csplat`.
        content: path of the file, or its bytes.
        size_bytes: size of the file.
        header: header of the file.
        seems_up: estimated up direction, if the scene does not specify one.
        findings: findings of lint in the PLY.
        encoded_from: size of the PLY in bytes; 0 if the scene was a .csplat file already.
    """

    name: str
    content: Path | bytes
    size_bytes: int
    header: SceneHeader
    seems_up: Direction | None = None
    findings: tuple[Finding, ...] = ()
    encoded_from: int = 0

    def read(self) -> bytes:
        """Return the bytes of the file."""
        return self.content if isinstance(self.content, bytes) else self.content.read_bytes()


@contextmanager
def open_scene(path: str, *, preset: PresetName, progress: Progress | None = None) -> Iterator[ViewScene]:
    """Prepare a scene: check the header of a .csplat file, or encode a file of another format.

    Args:
        path: the file, or `-`.
        preset: preset of the encoder.
        progress: progress callback of reading and encoding.

    Yields:
        The scene; a copy of standard input exists as long as the context.

    Raises:
        CsplatError: the file is not valid.
        OSError: the file cannot be read.
    """
    with local_path(path) as local:
        stem = "scene" if path == STANDARD_STREAM else Path(path).stem or "scene"
        yield _checked(local, stem) if is_csplat(local) else _encoded(local, stem, preset, progress)


def view_wishes(
    camera: str | None,
    facts: SceneOverrides = _NONE,
    report: list[str] | None = None,
    origin: Sequence[float] = (0.0, 0.0, 0.0),
) -> dict[str, str]:
    """Translate options into parameters of the page.

    Args:
        camera: a camera file, see `load_cameras`. The page begins with the first camera and steps through all of them.
        facts: overrides of the scene's axes and up direction.
        report: receives lines on how the camera file of another program was understood.
        origin: the scene's origin.

    Returns:
        Parameters of the page.

    Raises:
        InputError: the camera file holds no cameras.
    """
    wishes = {}
    if camera is not None:
        entries = [one.to_json() for one in load_cameras(camera, report, origin)]
        wishes["camera"] = json.dumps(entries, separators=(",", ":"))
    if facts.coordinate_system is not None:
        wishes["axes"] = facts.coordinate_system
    if facts.up is not None:
        wishes["up"] = _words(facts.up)
    return wishes


def seeming_wishes(up: Direction | None) -> dict[str, str]:
    """Return the page's parameters for an estimated up direction, which has the lowest priority there."""
    return {} if up is None else {"seems": _words(up)}


def _words(up: Direction) -> str:
    return ",".join(f"{value:g}" for value in up)


def _checked(path: Path, stem: str) -> ViewScene:
    with mapped_csplat(str(path)) as data:
        header, size = read_header(data), len(data)
    if size != header.file_size:
        code, at, clause, detail = (
            (ERROR_TRUNCATED, size, "HDR-5", "the file ends early")
            if size < header.file_size
            else (ERROR_TRAILING, header.file_size, "HDR-6", "bytes follow the end of the file")
        )
        raise FormatError(code, at, clause, detail, found=f"{size} bytes", wanted=f"{header.file_size} bytes")
    return ViewScene(f"{stem}.csplat", path, size, header, _seems_up(path, header))


def _seems_up(path: Path, header: SceneHeader) -> Direction | None:
    if header.splat_count > _SPLATS_LOOKED_AT or header.coordinate_system != UNSPECIFIED:
        return None
    try:
        return estimate_up(decode(path, sh_degree=0))
    except CsplatError:
        return None  # the page shows the intact part, and reports the error


def _encoded(path: Path, stem: str, preset: PresetName, progress: Progress | None) -> ViewScene:
    source = read_source(str(path), progress=progress)
    data = encode_with_report(source.model, EncodeOptions(preset=preset), progress=progress).data
    header, up = read_header(data), estimate_up(source.model)
    return ViewScene(f"{stem}.csplat", data, len(data), header, up, source.findings, source.size_bytes)
