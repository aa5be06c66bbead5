"""Read splats of glTF: as accessors of KHR_gaussian_splatting, or as SPZ inside of it, by whichever name.

What else a file has, meshes, materials and what packs them, means nothing for splats and refuses nothing, required or
not: only what the splats themselves use has to be understood.

The extension's text unpacks SPZ along LUF; CesiumJS and the tilesets for it take positions as they are stored.
The bounds of POSITION, which every glTF has, tell the two apart.
"""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.errors import InputError, counted
from csplat.formats.activations import Spread, read_opacities_as, read_scales_as
from csplat.formats.gltf_file import Accessor, GltfFile, Place, Placed, opened
from csplat.formats.linear_colours import srgb_error, srgb_of_linear
from csplat.formats.spz import decoded, means_of
from csplat.formats.spz_file import ANTIALIASED, Packed, read_packed
from csplat.lint import Finding, too_many_bands, trailing_bytes
from csplat.model import SplatModel, normalise_quats
from csplat.ply.columns import RowStatistics, alpha_of_logits, count_huge_rows, list_findings
from csplat.ply.comments import CommentMetadata, parse_comments
from csplat.scene import BLOCK, Scene
from csplat.turning import axes_rotation, stretched, turned
from csplat.types import F64

#: Left, up, front.
AXES = "LUF"
EXTENSION = "KHR_gaussian_splatting"
COLOURS = "srgb_rec709_display"
_LINEAR = "lin_rec709_display"
#: Names of the extension that packs splats as SPZ, and of those that came before it.
_SPZ = (
    "KHR_gaussian_splatting_compression_spz_2",
    "KHR_gaussian_splatting_compression_spz",
    "KHR_spz_gaussian_splats_compression",
    "KHR_spz_compression",
)
_WROTE_LOGS = re.compile(r"splat-transform v?([01]\.|2\.[0-3](\.|$))")  # mended in its pull request 268
#: Extensions of primitives that do not affect splats: materials, and numbers of features.
_HARMLESS = {"KHR_materials_variants", "EXT_mesh_features", "EXT_structural_metadata", "KHR_mesh_quantization"}
_THINNEST = np.float32(np.finfo(np.float32).tiny)  # value that a scale of 0 is read as: its logarithm is finite
_LARGE = 1e6  # from here on it is worth while to look for huge values
_FAR = 4096.0  # a translation as large as that stays an origin: float32 would have less than half a thousandth left
_ALIKE = 0.1  # fraction of the extent of a scene by which equivalent bounds may differ
_SAMPLE = 4096  # splats whose colours are measured
_UNPACKED_RATIO = 1032  # expansion by deflate, at most: several views may name the same bytes


@dataclass(frozen=True)
class _Part:
    """Splats of a primitive as a node shows them.

    Attributes:
        block: makes a model of some of them, along the axes of the primitive; its SH may have fewer bands than the
            scene.
        count: N.
        linear: linear part of the node's transform, for directions and lengths, [3, 3].
        translation: position of the node, [3].
    """

    block: Callable[[slice], SplatModel]
    count: int
    linear: F64
    translation: F64


@dataclass
class _Reading:
    """State of reading a file. Owns the unpacked data and the findings to report.

    Attributes:
        scales, opacities: statistics of all primitives, of the rows that are finite.
        counts: what was noticed in rows.
        infinite: rows whose opacity is infinite, which is a logit or nothing.
        sh_degree: the highest degree to read; `None`: all, up to three bands.
        are_logs, are_logits: whether scales are logarithms and opacities logits, once that is known.
        antialiased: the flag of each SPZ.
        light: a sample of each primitive with linear colours.
    """

    file: GltfFile
    required: list[str]
    sh_degree: int | None
    findings: list[Finding] = field(default_factory=list)
    scales: Spread = field(default_factory=Spread)
    opacities: Spread = field(default_factory=lambda: Spread(high=1.0))
    counts: RowStatistics = field(default_factory=RowStatistics)
    infinite: int = 0
    are_logs: bool = False
    are_logits: bool = False
    antialiased: list[bool] = field(default_factory=list)
    light: list[Callable[[], SplatModel]] = field(default_factory=list)
    packed: dict[int, Packed] = field(default_factory=dict)
    count: int = 0
    unpacked_bytes: int = 0

    def parts(self, placed: Placed) -> Iterator[_Part]:
        """Give the parts of a primitive, one for each instance; none of one without splats."""
        place = (*placed.place, "extensions")
        extensions = self.file.get(placed.primitive, placed.place, "extensions", dict, {})
        said = self.file.get(extensions, place, EXTENSION, dict, {})
        within = self.file.get(said, (*place, EXTENSION), "extensions", dict, {})
        packed = next((one for one in _SPZ if one in within or one in extensions), "")
        if EXTENSION not in extensions and not packed:
            return
        unknown = [name for name in within if name not in _SPZ]
        unknown += [one for one in extensions if one in self.required and one not in {EXTENSION, *_SPZ, *_HARMLESS}]
        if unknown:
            raise self.file.wrong(place, f"{', '.join(map(str, unknown))} is not understood, and the splats use it")
        self._check(placed, said, (*place, EXTENSION), packed=bool(packed))
        if packed:
            inner = (*place, packed) if packed in extensions else (*place, EXTENSION, "extensions", packed)
            holder = within if packed in within else extensions
            view = self.file.whole(self.file.get(holder, inner[:-1], packed, dict), inner, "bufferView")
            block, count = self._packed_block(placed, view, draft="kernel" not in said)
            bad = infinite = 0
        else:
            block, count, (bad, infinite) = self._plain_block(placed)
        if said.get("colorSpace") == _LINEAR:
            self.light.append(partial(block, slice(0, count, max(1, count // _SAMPLE))))
            block = partial(_in_srgb, block)
        for matrix in self.file.instances(placed):
            self.count += count
            self.counts.nonfinite += bad
            self.infinite += infinite
            # Nodes may show one mesh many times.
            if self.count > self.file.size() + sum(one.count for one in self.packed.values()):
                shown = f"shows {counted(self.count, 'splat')} or more, which is more than it has bytes"
                raise InputError(f"{self.file.path.name} {shown}")
            linear, translation = matrix[:3, :3], matrix[:3, 3]
            with np.errstate(all="ignore"):
                lengths = np.linalg.svd(linear)[1] if np.isfinite(matrix).all() else np.zeros(3)
            if not 1e-30 < lengths.max() < 1e30 or lengths.min() < 1e-9 * lengths.max():
                raise self.file.wrong(placed.place, "the node that shows it flattens it, or leaves float32")
            yield _Part(block, count, linear, translation)

    def _say(self, finding: Finding) -> None:
        """Add a finding, or add to the count of one with the same text about other primitives."""
        for index, one in enumerate(self.findings):
            if one.text == finding.text:
                self.findings[index] = replace(one, count=one.count + finding.count)
                return
        self.findings.append(finding)

    def _check(self, placed: Placed, said: dict[str, Any], place: Place, *, packed: bool) -> None:
        """Refuse splats of another kernel, colour or projection; drafts with SPZ named none of them."""
        absent = {None} if packed else set()
        known = {"kernel": {"ellipse"} | absent, "colorSpace": {COLOURS, _LINEAR} | absent}
        attributes = self.file.get(placed.primitive, placed.place, "attributes", dict, {})
        if not packed and "kernel" not in said and f"{EXTENSION}:OPACITY" not in attributes:
            draft = f"an early draft of {EXTENSION} (2025), which has no kernel, and opacities in COLOR_0"
            raise self.file.wrong(place, f"{draft}: export it again with a newer version of the program")
        for key, values in (*known.items(), ("projection", {"perspective", None})):
            found = self.file.get(said, place, key, str)
            if found not in values:
                wanted = " or ".join(str(one) for one in sorted(one for one in values if one))
                raise self.file.wrong((*place, key), f"found {found!r}, which is not understood, wanted {wanted}")

    def _plain_block(self, placed: Placed) -> tuple[Callable[[slice], SplatModel], int, tuple[int, int]]:
        file, place = self.file, (*placed.place, "attributes")
        attributes = file.get(placed.primitive, placed.place, "attributes", dict, {})

        def array(name: str, width: int) -> Accessor:
            key = name if name == "POSITION" else f"{EXTENSION}:{name}"
            if key not in attributes:
                raise file.wrong(place, f"there is no {key}")
            return file.accessor(attributes[key], width)

        widths = {"POSITION": 3, "ROTATION": 4, "SCALE": 3, "OPACITY": 1, **dict.fromkeys(sh_names(0), 3)}
        degree = 0
        while degree < 3 and any(f"{EXTENSION}:{name}" in attributes for name in sh_names(degree + 1)):
            degree += 1
            widths |= dict.fromkeys(sh_names(degree), 3)
        arrays = {name: array(name, width) for name, width in widths.items()}
        count = len(arrays["POSITION"].rows)
        for name, accessor in arrays.items():
            if len(accessor.rows) != count:
                raise file.wrong(place, f"{name} has {len(accessor.rows)} rows, POSITION {count}")
        if any(f"{EXTENSION}:{name}" in attributes for name in sh_names(4)) and self.sh_degree is None:
            raise file.wrong(place, too_many_bands(4))
        return partial(_block, self, arrays, degree), count, self._survey(arrays, count)

    def _survey(self, arrays: dict[str, Accessor], count: int) -> tuple[int, int]:
        """Look at the values that the extension forbids.

        Returns:
            Rows with a NaN or an infinity other than an opacity; of the others those with an infinite opacity.
        """
        bad = infinite = 0
        for start in range(0, count, BLOCK):
            rows = slice(start, start + BLOCK)
            good, largest = _finite_rows(arrays, rows)
            values = {name: arrays[name].values(rows) for name in ("SCALE", "OPACITY")}
            quats = arrays["ROTATION"].rows[rows]
            if good is not None:
                values, quats = {name: value[good] for name, value in values.items()}, quats[good]
                bad += len(good) - len(quats)
                unbounded = np.isinf(values["OPACITY"])
                infinite += int(np.count_nonzero(unbounded))
                values["OPACITY"][unbounded] = np.nan  # not counted as a value
            self.scales.add(values["SCALE"], self.count + start)
            self.opacities.add(values["OPACITY"], self.count + start)
            zero = np.logical_and.reduce([quats[:, part] == 0 for part in range(4)])
            self.counts.zero_quats += int(np.count_nonzero(zero))
            if largest > _LARGE:
                self.counts.huge += self._huge(arrays, rows, good)
        return bad, infinite

    def _huge(self, arrays: dict[str, Accessor], rows: slice, good: NDArray[np.bool_] | None) -> int:
        kept = slice(None) if good is None else good
        scales = np.log(np.maximum(np.abs(arrays["SCALE"].values(rows)[kept]), _THINNEST))
        return count_huge_rows(
            scales, *(one.values(rows)[kept] for name, one in arrays.items() if name.startswith("SH_"))
        )

    def _packed_block(self, placed: Placed, view: int, *, draft: bool) -> tuple[Callable[[slice], SplatModel], int]:
        file = self.file
        if view not in self.packed:
            data, _ = file.view(view)
            name = f"{file.path.name}, bufferViews/{view}"
            packed = read_packed(io.BytesIO(data), name, len(data), any_degree=self.sh_degree is not None)
            self.unpacked_bytes += sum(one.nbytes for one in packed.parts)
            if self.unpacked_bytes > _UNPACKED_RATIO * file.size():
                raise InputError(f"{file.path.name}: several SPZ in it share their bytes, and unpack to too many")
            self.packed[view] = packed
            self.antialiased.append(bool(packed.flags & ANTIALIASED))
        packed = self.packed[view]
        degree = packed.degree if self.sh_degree is None else min(packed.degree, self.sh_degree)
        attributes = file.get(placed.primitive, placed.place, "attributes", dict, {})
        said = file.item("accessors", attributes["POSITION"]) if "POSITION" in attributes else {}
        count = said.get("count", packed.count)
        if count != packed.count:
            raise file.wrong((*placed.place, "attributes", "POSITION"), f"{count} rows, its SPZ has {packed.count}")
        rotation = axes_rotation(packed.axes, AXES)
        stored, by = self._lies_as_stored(packed, said, rotation, draft=draft)
        if stored:
            text = f"SPZ whose positions lie along the axes of glTF as they are stored, {by}: not turned to {AXES}"
            self._say(Finding("spz-axes", packed.count, text, "note"))

        def block(rows: slice) -> SplatModel:
            model = decoded(packed, rows, degree)
            return replace(model if stored else turned(model, rotation), coordinate_system=AXES, antialiased=False)

        return block, packed.count

    def _lies_as_stored(self, packed: Packed, said: dict[str, Any], rotation: F64, *, draft: bool) -> tuple[bool, str]:
        """Return True if positions are stored along glTF's axes, and the source of that answer."""
        bounds = [said.get(name) for name in ("min", "max")]
        numbers = [one for each in bounds if isinstance(each, list) for one in each]
        if len(numbers) == 6 and packed.count and all(type(one) in (int, float) for one in numbers):
            wanted = np.array(numbers, np.float64).reshape(2, 3)
            low, high = np.full(3, np.inf), np.full(3, -np.inf)
            for start in range(0, packed.count, BLOCK):
                means = means_of(packed, slice(start, start + BLOCK))
                low, high = np.minimum(low, means.min(axis=0)), np.maximum(high, means.max(axis=0))
            both = np.stack([low, high])
            there = np.sort(both @ rotation.T, axis=0)
            off = [float(np.abs(one - wanted).max()) for one in (both, there)]
            if min(off) <= _ALIKE * float((high - low).max()) and off[0] != off[1]:
                return off[0] < off[1], "as the bounds of POSITION say"
        return draft, "as CesiumJS takes such drafts"


@contextmanager
def open_gltf(path: Path, sh_degree: int | None = None) -> Iterator[Scene]:
    """Open a file as `csplat.formats.format.Reader` and `BandReader` do."""
    file = opened(path)
    reading = _Reading(file, [str(one) for one in file.get(file.root, (), "extensionsRequired", list, [])], sh_degree)
    parts = [part for placed in file.placed() for part in reading.parts(placed)]
    if not parts:
        raise InputError(f"{path.name} shows no splats: no mesh of its scene has {EXTENSION}")
    _conclude(reading)
    try:
        said = _said(file)
        origin = np.array(said.origin or (0.0, 0.0, 0.0))
        if said.origin is None and np.abs(parts[0].translation).max() >= _FAR:
            origin = parts[0].translation
        x, y, z = origin.tolist()
        degree = max(part.block(slice(0, 0)).sh_degree for part in parts)
        nothing = _with_bands(parts[0].block(slice(0, 0)), degree)
        fields = {**said.fields(), "coordinate_system": AXES}
        if reading.antialiased and all(reading.antialiased):
            fields["antialiased"] = True
        facts = replace(nothing, origin=(x, y, z), **fields)
    except InputError as error:
        raise InputError(f"{path.name}: {error}") from None

    def blocks() -> Iterator[SplatModel]:
        for part in parts:
            for start in range(0, part.count, BLOCK):
                rows = slice(start, min(start + BLOCK, part.count))
                try:
                    block = part.block(rows)
                    if len(block):
                        yield _placed(_with_bands(block, degree), part, facts)
                except InputError as error:
                    raise InputError(f"{path.name}, splats {rows.start} to {rows.stop - 1}: {error}") from None

    yield Scene(reading.count - reading.counts.nonfinite, facts, blocks, reading.findings)


def _conclude(reading: _Reading) -> None:
    """Decide what the values of all primitives are, and add the findings about them."""
    generator = reading.file.root["asset"].get("generator")
    writer = generator[:60] if isinstance(generator, str) else ""
    reading.are_logs, found = read_scales_as(reading.scales, "SCALE", strict=True, writer=writer)
    written = _WROTE_LOGS.match(writer)
    if written and not reading.are_logs and not found:
        text = f"SCALE: {writer} wrote logarithms, and none is negative: read as standard deviations, as glTF has them"
        found = [Finding("unclear-scales", reading.count, text, "note")]
    reading.are_logits, more = read_opacities_as(reading.opacities, "OPACITY")
    for index, length in reading.file.short.items():
        text = f"buffers/{index}: {length}; all that the splats use is there"
        reading.findings.append(Finding("short-buffer", 1, text, "note"))
    if reading.are_logits:
        reading.counts.infinite_logits = reading.infinite
    else:
        reading.counts.nonfinite += reading.infinite
    reading.findings += [*found, *more, *list_findings(reading.counts, reading.count)]
    reading.findings += trailing_bytes(reading.file.tail)
    if others := reading.file.other_scenes():
        reading.findings.append(Finding("other-scenes", len(reading.file.root["scenes"]) - 1, others, "note"))
    if reading.light and all(one.repairable for one in reading.findings):
        try:
            error = max(
                (srgb_error(model) for model in (sample() for sample in reading.light) if len(model)), default=0.0
            )
        except InputError as wrong:
            raise InputError(f"{reading.file.path.name}: {wrong}") from None
        text = f"colours are linear ({_LINEAR}): fitted to sRGB, {error:.2f} of 255 steps off (rms)"
        text += "; splats in front of one another blend in linear light there, and in sRGB here"
        reading.findings.append(Finding("linear-colours", reading.count, text, "repair"))


def sh_names(degree: int) -> list[str]:
    """Name the coefficients of a band, as attributes have them behind the prefix."""
    return [f"SH_DEGREE_{degree}_COEF_{index}" for index in range(2 * degree + 1)]


def _finite_rows(arrays: dict[str, Accessor], rows: slice) -> tuple[NDArray[np.bool_] | None, float]:
    """Find the rows without NaN and infinities; an opacity may be infinite.

    Returns:
        [n] True where a row is finite; `None`: all are, opacities too. And the largest of all magnitudes but of
        positions, NaN or infinite if not all are finite.
    """
    largest, odd = 0.0, []
    for name, accessor in arrays.items():
        values = accessor.rows[rows]
        if values.dtype.kind == "f" and values.size:
            with np.errstate(invalid="ignore"):
                most = max(abs(float(values.min())), abs(float(values.max())))  # both are NaN where one value is
            if not np.isfinite(most):
                odd.append((name, values))
            elif name != "POSITION":
                largest = max(largest, most)
    if not odd:
        return None, largest
    good = np.ones(len(arrays["POSITION"].rows[rows]), bool)
    for name, values in odd:
        good &= (~np.isnan(values) if name == "OPACITY" else np.isfinite(values)).all(axis=1)
    return good, np.inf


def _block(reading: _Reading, arrays: dict[str, Accessor], degree: int, rows: slice) -> SplatModel:
    """Make a model of some splats as their primitive has them."""
    values = {name: accessor.values(rows) for name, accessor in arrays.items()}
    good, _ = _finite_rows(arrays, rows) if reading.counts.nonfinite else (None, 0.0)
    if good is not None:
        if not reading.are_logits:
            good &= np.isfinite(values["OPACITY"][:, 0])
        values = {name: value[good] for name, value in values.items()}
    quats = values["ROTATION"][:, [3, 0, 1, 2]]
    shN = np.zeros((len(quats), (degree + 1) ** 2 - 1, 3), np.float32)
    names = [name for band in range(1, degree + 1) for name in sh_names(band)]
    for index, name in enumerate(names):
        shN[:, index] = values[name]
    scales, opacities = values["SCALE"], values["OPACITY"][:, 0]
    if not reading.are_logs:
        scales = np.log(np.maximum(scales, _THINNEST))
    return SplatModel(
        means=values["POSITION"],
        quats=normalise_quats(quats),
        scales=scales,
        opacities=alpha_of_logits(opacities) if reading.are_logits else np.clip(opacities, 0.0, 1.0),
        sh0=values["SH_DEGREE_0_COEF_0"],
        shN=shN,
    )


def _in_srgb(block: Callable[[slice], SplatModel], rows: slice) -> SplatModel:
    return srgb_of_linear(block(rows))


def _with_bands(block: SplatModel, degree: int) -> SplatModel:
    """Add zeros for the bands up to a degree."""
    missing = (degree + 1) ** 2 - 1 - block.shN.shape[1]
    return replace(block, shN=np.pad(block.shN, ((0, 0), (0, missing), (0, 0)))) if missing else block


def _placed(block: SplatModel, part: _Part, facts: SplatModel) -> SplatModel:
    """Move some splats to their place in the scene."""
    if not np.array_equal(part.linear, np.eye(3)):
        block = stretched(block, part.linear)
    offset = part.translation - np.array(facts.origin)
    if offset.any():
        with np.errstate(over="ignore"):
            block = replace(block, means=(block.means.astype(np.float64) + offset).astype(np.float32))
    fields = ("origin", "coordinate_system", "unit_metres", "antialiased", "flat", "metadata")
    return replace(block, **{name: getattr(facts, name) for name in fields})


def _said(file: GltfFile) -> CommentMetadata:
    """Read the file's metadata about the scene beyond its splats."""
    extras = file.root["asset"].get("extras")
    lines = extras.get("csplat", []) if isinstance(extras, dict) else []
    if not isinstance(lines, list) or not all(isinstance(line, str) for line in lines):
        raise InputError("asset/extras/csplat: wanted lines of text")
    said = parse_comments(lines)
    holder = file.root["asset"].get("copyright")
    if isinstance(holder, str):
        said.metadata.setdefault("licence", holder)
    return said
