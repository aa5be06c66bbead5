# SPDX-License-Identifier: Apache-2.0
"""Read splats from glTF: accessors of KHR_gaussian_splatting, a .csplat file (`spec/gltf.md`), or SPZ under any name
that its extension has had.

Everything that splats do not use (meshes, materials, their compression) is left out, even what required extensions
specify, and listed (`gltf_remainder`).

The SPZ extension specifies that positions are unpacked along LUF; CesiumJS and its tilesets use them as stored. The
bounds of POSITION, which glTF requires, tell the two cases apart.

Colours in linear light are fitted to sRGB. The transfer function of sRGB (IEC 61966-2-1) turns SH into functions that
are no longer SH of finite degree, so the nearest SH of the same degree are fitted by least squares. At degree 0 the
result is exact except for negative light. Splats blended in linear light look different from splats blended in sRGB;
colours cannot correct that.
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

from csplat.editing.transform import (
    axes_rotation,
    rotate_scene,
    sphere_lattice,
    stretch_scene,
    translate_scene,
)
from csplat.errors import InputError, counted
from csplat.formats.common import RangeStatistics, classify_opacities, classify_scales, log_scales
from csplat.formats.gltf.csplat_payload import (
    COMPRESSION,
    attribute_types,
    check_primitive,
    open_payload,
    payload_bounds,
    payload_matrix,
    payload_view,
)
from csplat.formats.gltf.gltf_document import (
    AXES,
    EXTENSION,
    INSTANCING,
    VISIBILITY,
    Accessor,
    GltfDocument,
    JsonPath,
    PlacedPrimitive,
    attribute_name,
    open_document,
    sh_names,
)
from csplat.formats.gltf.gltf_remainder import ReadPrimitive, list_remainder
from csplat.formats.spz import ANTIALIASED, SpzArrays, decode_block, decode_means, read_spz_file
from csplat.lint import Finding, list_names, other_contents, too_many_bands, trailing_bytes
from csplat.model import MAX_SH_DEGREE, SplatModel, normalise_quats, splat_dtype
from csplat.ply.columns import RowStatistics, alpha_of_logits, count_huge_rows, list_findings
from csplat.ply.comments import CommentMetadata, parse_comments
from csplat.scene import BLOCK_SPLATS, Scene, join_blocks
from csplat.scene_metadata import LINEAR, SRGB, SceneMetadata
from csplat.spherical_harmonics import SH_C0, evaluate_sh
from csplat.splat_file import SplatFile
from csplat.types import F32, F64

#: Names of the extension that packs splats as SPZ, and of its predecessors.
_SPZ = (
    "KHR_gaussian_splatting_compression_spz_2",
    "KHR_gaussian_splatting_compression_spz",
    "KHR_spz_gaussian_splats_compression",
    "KHR_spz_compression",
)
_WROTE_LOGS = re.compile(r"splat-transform v?([01]\.|2\.[0-3](\.|$))")  # fixed in its pull request 268
#: Extensions of primitives that do not affect splats: materials and feature ids.
_HARMLESS = {"KHR_materials_variants", "EXT_mesh_features", "EXT_structural_metadata", "KHR_mesh_quantization"}
_LARGE = 1e6  # huge values are only counted in primitives with a value above this
_FAR = 4096.0  # scene units; a larger translation becomes the origin: float32 resolves it to 0.0005 at best
_ALIKE = 0.1  # fraction of the scene's extent by which equivalent bounds may differ
_STRETCHES = (1e-30, 1e30)  # range of the largest singular value of a node's transform: beyond, products may
_SINGULAR = 1e-9  # a transform whose singular values have a smaller ratio is singular
_SAMPLE = 4096  # number of splats on which the error of fitted colours is measured
_COLOUR_ERROR = 2.0 / 255.0  # largest error of colours of points: they are bytes, rounded up or down
_SHOWN_NAME = 60  # characters of a program's name in messages
_UNPACKED_RATIO = 1032  # maximum expansion by deflate; exceeded if several views share their bytes


@dataclass(frozen=True)
class _Splats:
    """The splats of a primitive, in its coordinates.

    Attributes:
        count: N.
        empty: a model without splats; it may have fewer SH bands than the scene.
        parts: yields rows and a function that decodes them to a model, for all splats in order.
        metadata: a model without splats with the origin and metadata of a .csplat file; `None` for other primitives.
    """

    count: int
    empty: SplatModel
    parts: Callable[[], Iterator[tuple[slice, Callable[[], SplatModel]]]]
    metadata: SplatModel | None = None

    @classmethod
    def of_rows(cls, decode: Callable[[slice], SplatModel], count: int) -> _Splats:
        """Return the splats that a function decodes from any rows."""

        def parts() -> Iterator[tuple[slice, Callable[[], SplatModel]]]:
            for start in range(0, count, BLOCK_SPLATS):
                rows = slice(start, min(start + BLOCK_SPLATS, count))
                yield rows, partial(decode, rows)

        return cls(count, decode(slice(0, 0)), parts)


@dataclass(frozen=True)
class _Instance:
    """The splats of a primitive, placed by a node.

    Attributes:
        splats: the splats.
        linear: [3, 3], linear part of the node's transform.
        translation: [3], translation of the node.
    """

    splats: _Splats
    linear: F64
    translation: F64


@dataclass
class _GltfReading:
    """The state of reading a file: unpacked data, statistics of rows, findings.

    Attributes:
        required: extensions that the file requires.
        sh_degree: the highest degree to read; `None`: all, up to 4.
        scales, opacities: statistics of the finite rows of all primitives.
        statistics: counts of rows for findings.
        infinite: number of rows with infinite opacity, which is valid for logits only.
        are_logs, are_logits: scales are logarithms, opacities are logits; known after all primitives.
        antialiased: the flag of each SPZ.
        linear_samples: functions that decode some splats of each primitive with linear colours.
        packed: SPZ by index of their buffer views.
        files: .csplat files by index of their buffer views.
        primitives: the primitives of splats, with the attributes that are read.
        unread: contents that are left out, in a few words each.
    """

    file: GltfDocument
    required: list[str]
    sh_degree: int | None
    findings: list[Finding] = field(default_factory=list)
    scales: RangeStatistics = field(default_factory=RangeStatistics)
    opacities: RangeStatistics = field(default_factory=lambda: RangeStatistics(high=1.0))
    statistics: RowStatistics = field(default_factory=RowStatistics)
    infinite: int = 0
    are_logs: bool = False
    are_logits: bool = False
    antialiased: list[bool] = field(default_factory=list)
    linear_samples: list[Callable[[], SplatModel]] = field(default_factory=list)
    packed: dict[int, SpzArrays] = field(default_factory=dict)
    files: dict[int, SplatFile] = field(default_factory=dict)
    primitives: list[ReadPrimitive] = field(default_factory=list)
    unread: list[str] = field(default_factory=list)
    count: int = 0
    unpacked_bytes: int = 0

    def instances(self, placed: PlacedPrimitive) -> Iterator[_Instance]:
        """Yield each instance of a primitive; nothing if the primitive has no splats."""
        json_path = (*placed.json_path, "extensions")
        extensions = self.file.get(placed.primitive, placed.json_path, "extensions", dict, {})
        extension = self.file.get(extensions, json_path, EXTENSION, dict, {})
        within = self.file.get(extension, (*json_path, EXTENSION), "extensions", dict, {})
        packed = next((name for name in _SPZ if name in within or name in extensions), "")
        if EXTENSION not in extensions and not packed:
            return
        unknown = [name for name in within if name not in {COMPRESSION, *_SPZ}]
        unknown += [name for name in extensions if name in self.required and name not in {EXTENSION, *_SPZ, *_HARMLESS}]
        if unknown:
            raise self.file.error(json_path, f"the splats use {', '.join(map(str, unknown))}, which is not supported")
        has_file = COMPRESSION in within
        self._check(placed, extension, (*json_path, EXTENSION), packed=bool(packed) and not has_file)
        bad = infinite = 0
        attributes = self.file.get(placed.primitive, placed.json_path, "attributes", dict, {})
        names = {name for name in attributes if name == "POSITION" or name.startswith(f"{EXTENSION}:")}
        if has_file:
            splats = self._payload(placed)
            header = self.files[payload_view(self.file, placed)].header
            names = set(attribute_types(header))
        elif packed:
            inner = (*json_path, packed) if packed in extensions else (*json_path, EXTENSION, "extensions", packed)
            holder = within if packed in within else extensions
            view = self.file.integer(self.file.get(holder, inner[:-1], packed, dict), inner, "bufferView")
            splats = _Splats.of_rows(*self._packed_block(placed, view, draft="kernel" not in extension))
        else:
            block, count, (bad, infinite), plain_names = self._plain_block(placed)
            splats = _Splats.of_rows(block, count)
            names = plain_names if self.sh_degree is None else names  # which has bands that are left out on request
        count = splats.count
        names |= {name for name in ("COLOR_0", "NORMAL") if name in attributes and self._holds_nothing(placed, name)}
        self.primitives.append(ReadPrimitive(placed, frozenset(names)))
        if extension.get("colorSpace") == LINEAR:
            self.linear_samples.append(partial(_sample, splats))
            splats = _in_srgb(splats)
        for matrix in self.file.instances(placed):
            self.count += count
            self.statistics.nonfinite += bad
            self.infinite += infinite
            # A small file could reference a mesh very often.
            unpacked = sum(arrays.count for arrays in self.packed.values())
            if self.count > self.file.size() + unpacked + sum(one.count for one in self.files.values()):
                shown = f"shows at least {counted(self.count, 'splat')}, more than it has bytes"
                raise InputError(f"{self.file.path.name} {shown}")
            linear, translation = matrix[:3, :3], matrix[:3, 3]
            with np.errstate(all="ignore"):
                lengths = np.linalg.svd(linear)[1] if np.isfinite(matrix).all() else np.zeros(3)
            largest = lengths.max()
            if not _STRETCHES[0] < largest < _STRETCHES[1] or lengths.min() < _SINGULAR * largest:
                raise self.file.error(placed.json_path, "the transform of its node is singular or exceeds float32")
            yield _Instance(splats, linear, translation)

    def _report(self, finding: Finding) -> None:
        """Add a finding; findings with the same text about several primitives are added up."""
        for index, known in enumerate(self.findings):
            if known.text == finding.text:
                self.findings[index] = replace(known, count=known.count + finding.count)
                return
        self.findings.append(finding)

    def _check(self, placed: PlacedPrimitive, extension: dict[str, Any], json_path: JsonPath, *, packed: bool) -> None:
        """Refuse unknown kernels, colour spaces and projections; drafts with SPZ may omit them."""
        absent = {None} if packed else set()
        known = {"kernel": {"ellipse"} | absent, "colorSpace": {SRGB, LINEAR} | absent}
        attributes = self.file.get(placed.primitive, placed.json_path, "attributes", dict, {})
        if not packed and "kernel" not in extension and f"{EXTENSION}:OPACITY" not in attributes:
            draft = f"an early draft of {EXTENSION} (2025) without kernel and with opacities in COLOR_0"
            raise self.file.error(json_path, f"{draft}: export it again with a newer version of the program")
        for key, values in (*known.items(), ("projection", {"perspective", None})):
            value = self.file.get(extension, json_path, key, str)
            if value not in values:
                expected = " or ".join(sorted(allowed for allowed in values if allowed))
                raise self.file.error((*json_path, key), f"found {value!r}, expected {expected}")

    def _plain_block(
        self, placed: PlacedPrimitive
    ) -> tuple[Callable[[slice], SplatModel], int, tuple[int, int], set[str]]:
        """Check a primitive with plain accessors.

        Returns:
            A function that decodes rows; the number of rows; the numbers of rows that `_survey` returns; and the names
            of the attributes that are read.
        """
        file, json_path = self.file, (*placed.json_path, "attributes")
        attributes = file.get(placed.primitive, placed.json_path, "attributes", dict, {})

        def array(name: str, width: int) -> Accessor:
            key = attribute_name(name)
            if key not in attributes:
                raise file.error(json_path, f"there is no {key}")
            return file.accessor(attributes[key], width)

        widths = {"POSITION": 3, "ROTATION": 4, "SCALE": 3, "OPACITY": 1, **dict.fromkeys(sh_names(0), 3)}
        degree = 0
        while degree < MAX_SH_DEGREE and any(f"{EXTENSION}:{name}" in attributes for name in sh_names(degree + 1)):
            degree += 1
            widths |= dict.fromkeys(sh_names(degree), 3)
        arrays = {name: array(name, width) for name, width in widths.items()}
        count = len(arrays["POSITION"].rows)
        for name, accessor in arrays.items():
            if len(accessor.rows) != count:
                raise file.error(json_path, f"{name} has {len(accessor.rows)} rows, POSITION {count}")
        if any(f"{EXTENSION}:{name}" in attributes for name in sh_names(degree + 1)) and self.sh_degree is None:
            raise file.error(json_path, too_many_bands(degree + 1))
        return (
            partial(_decode_block, self, arrays, degree),
            count,
            self._survey(arrays, count),
            set(map(attribute_name, arrays)),
        )

    def _holds_nothing(self, placed: PlacedPrimitive, name: str) -> bool:
        """Return True for normals that are the same for all splats, and for the colours of points that follow from SH.

        KHR_gaussian_splatting lets writers add COLOR_0 for programs that draw points: light, or values of sRGB.
        """
        attributes = placed.primitive["attributes"]
        try:
            kind = self.file.item("accessors", attributes[name]).get("type")
            rows = self.file.accessor(attributes[name], 4 if kind == "VEC4" else 3)
            if name == "NORMAL":
                return np.array_equal(rows.rows, np.broadcast_to(rows.rows[:1], rows.rows.shape), equal_nan=True)
            needed = [attribute_name(source) for source in ("SH_DEGREE_0_COEF_0", "OPACITY")]
            sh0, opacities = (
                self.file.accessor(attributes[one], width) for one, width in zip(needed, (3, 1), strict=True)
            )
        except (InputError, KeyError):
            return False
        shown = dict.fromkeys(("display", "light", "alpha", "logit", "opaque"), True)
        for start in range(0, min(len(rows.rows), len(sh0.rows), len(opacities.rows)), BLOCK_SPLATS):
            part = slice(start, start + BLOCK_SPLATS)
            colours = np.clip(sh0.values(part) * np.float32(SH_C0) + np.float32(0.5), 0, 1)
            values, alphas = rows.values(part), opacities.values(part)[:, 0]
            alpha = values[:, 3] if values.shape[1] == 4 else np.ones_like(alphas)
            with np.errstate(over="ignore", invalid="ignore"):
                candidates = {
                    "display": np.abs(values[:, :3] - colours),
                    "light": np.minimum(
                        np.abs(_srgb(np.maximum(values[:, :3], 0)) - colours), np.abs(values[:, :3] - _light(colours))
                    ),
                    "alpha": np.abs(alpha - alphas),
                    "logit": np.abs(alpha - alpha_of_logits(alphas)),
                    "opaque": np.abs(alpha - 1),
                }
            shown = {name: shown[name] and not (error > _COLOUR_ERROR).any() for name, error in candidates.items()}
        return (shown["display"] or shown["light"]) and (shown["alpha"] or shown["logit"] or shown["opaque"])

    def _survey(self, arrays: dict[str, Accessor], count: int) -> tuple[int, int]:
        """Update the statistics with the rows of a primitive.

        Returns:
            The number of rows with NaN or with infinity outside the opacity; and the number of other rows with an
            infinite opacity.
        """
        bad = infinite = 0
        for start in range(0, count, BLOCK_SPLATS):
            rows = slice(start, start + BLOCK_SPLATS)
            good, largest = _finite_rows(arrays, rows)
            values = {name: arrays[name].values(rows) for name in ("SCALE", "OPACITY")}
            quats = arrays["ROTATION"].rows[rows]
            if good is not None:
                values, quats = {name: value[good] for name, value in values.items()}, quats[good]
                bad += len(good) - len(quats)
                unbounded = np.isinf(values["OPACITY"])
                infinite += int(np.count_nonzero(unbounded))
                values["OPACITY"][unbounded] = np.nan  # `RangeStatistics` ignores NaN
            self.scales.add(values["SCALE"], self.count + start)
            self.opacities.add(values["OPACITY"], self.count + start)
            zero = np.logical_and.reduce([quats[:, part] == 0 for part in range(4)])
            self.statistics.zero_quats += int(np.count_nonzero(zero))
            if largest > _LARGE:
                self.statistics.huge += self._huge(arrays, rows, good)
        return bad, infinite

    def _huge(self, arrays: dict[str, Accessor], rows: slice, good: NDArray[np.bool_] | None) -> int:
        """Count the rows with huge scales or coefficients; `good` [n] masks the rows to check, `None`: all."""
        kept = slice(None) if good is None else good
        scales = log_scales(arrays["SCALE"].values(rows)[kept])
        return count_huge_rows(
            scales, *(accessor.values(rows)[kept] for name, accessor in arrays.items() if name.startswith("SH_"))
        )

    def _payload(self, placed: PlacedPrimitive) -> _Splats:
        """Return the splats of a primitive that are a .csplat file in a buffer view, which is opened once.

        Raises:
            FormatError, UnsupportedError, LimitError: as in `csplat.open` of a .csplat file.
            InputError: the primitive violates a clause of `spec/gltf.md`.
        """
        view = payload_view(self.file, placed)
        if view not in self.files:
            self.files[view] = open_payload(self.file, view)
            self.antialiased.append(self.files[view].metadata.antialiased)
        opened = self.files[view]
        check_primitive(self.file, placed, opened.header, payload_bounds(opened))
        matrix = payload_matrix(opened.header.coordinate_system)
        plain = SceneMetadata(
            antialiased=opened.metadata.antialiased, flat=opened.metadata.flat, semantics=opened.metadata.semantics
        )

        def turned(model: SplatModel) -> SplatModel:
            return rotate_scene(replace(model, origin=(0.0, 0.0, 0.0), metadata=plain), matrix)

        def parts() -> Iterator[tuple[slice, Callable[[], SplatModel]]]:
            start = 0
            for model in opened.models():
                yield slice(start, start + len(model)), partial(turned, model)
                start += len(model)

        return _Splats(opened.count, turned(opened.empty()), parts, rotate_scene(opened.empty(), matrix))

    def _packed_block(
        self, placed: PlacedPrimitive, view: int, *, draft: bool
    ) -> tuple[Callable[[slice], SplatModel], int]:
        """Read a primitive whose splats are an SPZ in a buffer view, which is unpacked once.

        Args:
            placed: the primitive.
            view: index of the buffer view.
            draft: the extension is a draft, whose positions may be stored along other axes.

        Returns:
            A function that decodes rows, and the number of rows.

        Raises:
            InputError: the SPZ is invalid, or all SPZ together unpack to too many bytes.
        """
        file = self.file
        if view not in self.packed:
            data, _ = file.view(view)
            name = f"{file.path.name}, bufferViews/{view}"
            packed = read_spz_file(io.BytesIO(data), name, len(data))
            self.unpacked_bytes += sum(part.nbytes for part in packed.parts)
            if self.unpacked_bytes > _UNPACKED_RATIO * file.size():
                raise InputError(f"{file.path.name}: its SPZ share their bytes and unpack to too many splats")
            self.packed[view] = packed
            for finding in packed.findings:
                self._report(finding)
            self.antialiased.append(bool(packed.flags & ANTIALIASED))
        packed = self.packed[view]
        degree = packed.degree if self.sh_degree is None else min(packed.degree, self.sh_degree)
        attributes = file.get(placed.primitive, placed.json_path, "attributes", dict, {})
        positions = file.item("accessors", attributes["POSITION"]) if "POSITION" in attributes else {}
        count = positions.get("count", packed.count)
        if count != packed.count:
            raise file.error((*placed.json_path, "attributes", "POSITION"), f"{count} rows, its SPZ has {packed.count}")
        rotation = axes_rotation(packed.axes, AXES)
        stored, by = self._lies_as_stored(packed, positions, rotation, draft=draft)
        if stored:
            text = f"SPZ whose stored positions already use the axes of glTF, {by}: not rotated to {AXES}"
            self._report(Finding("spz-axes", packed.count, text, "note"))

        def block(rows: slice) -> SplatModel:
            model = decode_block(packed, rows, degree)
            return replace(
                model if stored else rotate_scene(model, rotation), metadata=SceneMetadata(coordinate_system=AXES)
            )

        return block, packed.count

    def _lies_as_stored(
        self, packed: SpzArrays, positions: dict[str, Any], rotation: F64, *, draft: bool
    ) -> tuple[bool, str]:
        """Return True if positions are stored along glTF's axes; and the evidence for messages.

        The bounds of the accessor `positions` decide if they fit either reading, otherwise `draft` does.
        """
        bounds = [positions.get(name) for name in ("min", "max")]
        numbers = [number for bound in bounds if isinstance(bound, list) for number in bound]
        if len(numbers) == 6 and packed.count and all(type(number) in (int, float) for number in numbers):
            declared = np.array(numbers, np.float64).reshape(2, 3)
            low, high = np.full(3, np.inf), np.full(3, -np.inf)
            for start in range(0, packed.count, BLOCK_SPLATS):
                means = decode_means(packed, slice(start, start + BLOCK_SPLATS))
                low, high = np.minimum(low, means.min(axis=0)), np.maximum(high, means.max(axis=0))
            as_stored = np.stack([low, high])
            rotated = np.sort(as_stored @ rotation.T, axis=0)
            error_stored, error_rotated = (float(np.abs(box - declared).max()) for box in (as_stored, rotated))
            nearest = min(error_stored, error_rotated)
            if nearest <= _ALIKE * float((high - low).max()) and error_stored != error_rotated:
                return error_stored < error_rotated, "according to the bounds of POSITION"
        return draft, "as CesiumJS reads such drafts"


@contextmanager
def open_gltf(path: Path, sh_degree: int | None = None) -> Iterator[Scene]:
    """Open a file (`Format.open`, `Format.open_bands`)."""
    file = open_document(path)
    reading = _GltfReading(
        file, [str(name) for name in file.get(file.root, (), "extensionsRequired", list, [])], sh_degree
    )
    instances = [instance for placed in file.placed_primitives() for instance in reading.instances(placed)]
    if not instances:
        raise InputError(f"{path.name} shows no splats: no mesh of its scene has {EXTENSION}")
    _conclude(reading)
    try:
        empty = _describe_scene(reading, instances)
    except InputError as error:
        raise InputError(f"{path.name}: {error}") from None
    reading.findings += other_contents(reading.unread)

    def blocks() -> Iterator[SplatModel]:
        for instance in instances:
            for rows, decode in instance.splats.parts():
                try:
                    block = decode()
                    if len(block):
                        yield _place_block(_pad_bands(block, empty.sh_degree), instance, empty)
                except InputError as error:
                    raise InputError(f"{path.name}, splats {rows.start} to {rows.stop - 1}: {error}") from None

    yield Scene.like(empty, reading.count - reading.statistics.nonfinite, blocks, reading.findings)


def _describe_scene(reading: _GltfReading, instances: list[_Instance]) -> SplatModel:
    """Return a model without splats that has everything else of the scene.

    The metadata of a .csplat file is that of the scene if nothing else is shown.

    Raises:
        InputError: the metadata is not valid.
    """
    comments = _read_comments(reading.file)
    first, metadata = instances[0], comments.metadata
    payload = first.splats.metadata
    origin = np.array(comments.origin or (0.0, 0.0, 0.0))
    has_origin = payload is not None and any(payload.origin)  # which the node has, too (GLT-10)
    if comments.origin is None and (has_origin or np.abs(first.translation).max() >= _FAR):
        origin = first.translation
    x, y, z = origin.tolist()
    empty = _pad_bands(first.splats.empty, max(one.splats.empty.sh_degree for one in instances))
    columns = [_columns(one.splats.empty) for one in instances]
    if any(one != columns[0] for one in columns):
        names = sorted({name for one in columns for name, _, _ in one})
        reading.unread.append(f"extra columns {list_names(names)}, which differ between its primitives")
        empty = replace(empty, extra={})
    semantics = {name: semantic for name, _, semantic in columns[0] if semantic and empty.extra}
    metadata = replace(metadata, semantics=semantics)
    is_payload = payload is not None and len(instances) == 1
    if payload is not None and is_payload:
        placed = stretch_scene(payload, first.linear)
        dx, dy, dz = (first.translation - origin).tolist()
        metadata = translate_scene(placed, (dx, dy, dz)).metadata
        metadata = replace(metadata, unit_metres=None if metadata.unit_metres is None else 1.0)
    elif any(opened.metadata.entries or opened.metadata.cameras for opened in reading.files.values()):
        reading.unread.append("metadata of its .csplat files")
    metadata = _with_copyright(reading, metadata)
    reading.unread += list_remainder(
        reading.file,
        reading.primitives,
        [EXTENSION, COMPRESSION, *_SPZ, INSTANCING, VISIBILITY],
        comments=not is_payload,
    )
    antialiased = metadata.antialiased or (bool(reading.antialiased) and all(reading.antialiased))
    metadata = replace(metadata, coordinate_system=AXES, antialiased=antialiased)
    if metadata.colour_space == LINEAR:
        metadata = replace(metadata, colour_space=SRGB)  # `_in_srgb`
    return replace(empty, origin=(x, y, z), metadata=metadata)


def _conclude(reading: _GltfReading) -> None:
    """Set `are_logs` and `are_logits` by the values of all primitives, which were read before, and add the findings.

    Raises:
        InputError: a sample of linear colours has values that a model refuses.
    """
    generator = reading.file.root["asset"].get("generator")
    writer = generator[:_SHOWN_NAME] if isinstance(generator, str) else ""
    reading.are_logs, scale_findings = classify_scales(reading.scales, "SCALE", strict=True, writer=writer)
    if _WROTE_LOGS.match(writer) and not reading.are_logs and not scale_findings:
        text = f"SCALE: {writer} wrote logarithms, but none is negative: read as standard deviations, as glTF specifies"
        scale_findings = [Finding("unclear-scales", reading.count, text, "note")]
    reading.are_logits, opacity_findings = classify_opacities(reading.opacities, "OPACITY")
    for index, length in reading.file.short.items():
        text = f"buffers/{index}: {length}; the part that splats use is complete"
        reading.findings.append(Finding("short-buffer", 1, text, "note"))
    if reading.are_logits:
        reading.statistics.infinite_logits = reading.infinite
    else:
        reading.statistics.nonfinite += reading.infinite
    reading.findings += [*scale_findings, *opacity_findings, *list_findings(reading.statistics, reading.count)]
    reading.findings += trailing_bytes(reading.file.tail)
    if others := reading.file.other_scenes():
        more = len(reading.file.root["scenes"]) - 1
        lost = (counted(more, "other scene"),)
        reading.findings.append(Finding("other-scenes", more, others, "note", lost=lost))
    if reading.linear_samples and all(finding.repairable for finding in reading.findings):
        try:
            error = max(
                (measure_srgb_error(model) for model in (sample() for sample in reading.linear_samples) if len(model)),
                default=0.0,
            )
        except InputError as failure:
            raise InputError(f"{reading.file.path.name}: {failure}") from None
        text = f"colours are linear ({LINEAR}): fitted to sRGB, rms error {error:.2f} of 255 steps"
        text += "; overlapping splats blend in linear light there, and in sRGB here"
        reading.findings.append(Finding("linear-colours", reading.count, text, "repair"))


def _finite_rows(arrays: dict[str, Accessor], rows: slice) -> tuple[NDArray[np.bool_] | None, float]:
    """Find the rows without NaN and infinity; opacities may be infinite.

    Returns:
        [n] True for finite rows, or `None` if all values are finite; and the largest magnitude of all values except
        positions, infinite if a value is not finite.
    """
    largest, odd = 0.0, []
    for name, accessor in arrays.items():
        values = accessor.rows[rows]
        if values.dtype.kind == "f" and values.size:
            with np.errstate(invalid="ignore"):
                most = max(abs(float(values.min())), abs(float(values.max())))  # NaN if any value is NaN
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


def _decode_block(reading: _GltfReading, arrays: dict[str, Accessor], degree: int, rows: slice) -> SplatModel:
    """Return a model of some splats in the coordinates of their primitive, without rows that are not finite."""
    values = {name: accessor.values(rows) for name, accessor in arrays.items()}
    good, _ = _finite_rows(arrays, rows) if reading.statistics.nonfinite else (None, 0.0)
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
        scales = log_scales(scales)
    return SplatModel(
        means=values["POSITION"],
        quats=normalise_quats(quats),
        scales=scales,
        opacities=alpha_of_logits(opacities) if reading.are_logits else np.clip(opacities, 0.0, 1.0),
        sh0=values["SH_DEGREE_0_COEF_0"],
        shN=shN,
    )


def _in_srgb(splats: _Splats) -> _Splats:
    """Return splats of linear colours with SH that are fitted to sRGB when they are decoded."""

    def parts() -> Iterator[tuple[slice, Callable[[], SplatModel]]]:
        for rows, decode in splats.parts():
            yield rows, partial(_decode_in_srgb, decode)

    return replace(splats, parts=parts)


def _decode_in_srgb(decode: Callable[[], SplatModel]) -> SplatModel:
    """Decode splats of linear colours, and fit their SH to sRGB."""
    return fit_srgb(decode())


def _sample(splats: _Splats) -> SplatModel:
    """Return about `_SAMPLE` splats, spread over all blocks."""
    every = max(1, splats.count // _SAMPLE)
    blocks = (decode() for _, decode in splats.parts())
    return join_blocks(splats.empty, [block.select(slice(None, None, every)) for block in blocks])


def _pad_bands(block: SplatModel, degree: int) -> SplatModel:
    """Append zeros for missing bands up to a degree."""
    missing = (degree + 1) ** 2 - 1 - block.shN.shape[1]
    return replace(block, shN=np.pad(block.shN, ((0, 0), (0, missing), (0, 0)))) if missing else block


def _place_block(block: SplatModel, instance: _Instance, empty: SplatModel) -> SplatModel:
    """Transform some splats from their primitive to the scene, with the origin and metadata of `empty`."""
    if not np.array_equal(instance.linear, np.eye(3)):
        block = stretch_scene(block, instance.linear)
    offset = instance.translation - np.array(empty.origin)
    if offset.any():
        with np.errstate(over="ignore"):
            block = replace(block, means=(block.means.astype(np.float64) + offset).astype(np.float32))
    extra = block.extra if empty.extra else {}
    return replace(block, origin=empty.origin, metadata=empty.metadata, extra=extra)


def _columns(empty: SplatModel) -> list[tuple[str, np.dtype[Any], str]]:
    """Return name, type and semantic of the extra columns of a model."""
    semantics = empty.metadata.semantics
    return [(name, splat_dtype(column), semantics.get(name, "")) for name, column in empty.extra.items()]


def _read_comments(file: GltfDocument) -> CommentMetadata:
    """Read the metadata that our writer adds to the asset.

    Raises:
        InputError: the metadata is not a list of strings, or a string is not a valid comment.
    """
    extras = file.root["asset"].get("extras")
    lines = extras.get("csplat", []) if isinstance(extras, dict) else []
    if not isinstance(lines, list) or not all(isinstance(line, str) for line in lines):
        raise InputError("asset/extras/csplat is not a list of strings")
    return parse_comments(lines)


def _with_copyright(reading: _GltfReading, metadata: SceneMetadata) -> SceneMetadata:
    """Return the metadata with the copyright of the asset, which every program shows, as its licence."""
    holder, licence = reading.file.root["asset"].get("copyright"), metadata.licence
    if not isinstance(holder, str) or holder == licence:
        return metadata
    if licence is not None and licence != holder.encode("ascii", "replace").decode("ascii"):
        reading.unread.append(f"the licence {list_names([licence])}, which asset copyright contradicts")
    return metadata.with_entries(licence=holder)


_DIRECTIONS = 96  # six per coefficient of degree 3; 1,000 would change the colours of a scene by 0.01 of 255 steps
_ROWS = 4096  # splats whose colours are fitted at a time


def fit_srgb(model: SplatModel) -> SplatModel:
    """Convert SH of linear light to the SH of sRGB that fit best."""
    fitted = [coefficients for coefficients, _, _ in _fit_blocks(model)]
    sh = np.concatenate([np.zeros((0, model.shN.shape[1] + 1, 3), np.float32), *fitted])
    return replace(model, sh0=np.ascontiguousarray(sh[:, 0]), shN=np.ascontiguousarray(sh[:, 1:]))


def measure_srgb_error(model: SplatModel) -> float:
    """Return the rms error of `fit_srgb` over splats, directions and channels, in steps of 1/255."""
    squares, count = 0.0, 0
    for _, fitted, exact in _fit_blocks(model):
        squares += float(np.square(np.clip(fitted, 0, 1) - np.clip(exact, 0, 1), dtype=np.float64).sum())
        count += fitted.size
    return 255.0 * float(np.sqrt(squares / count)) if count else 0.0


def _fit_blocks(model: SplatModel) -> Iterator[tuple[F32, F32, F32]]:
    """Yield coefficients [n, K, 3] of some splats, with their fitted and exact colours [n, D, 3]."""
    directions = sphere_lattice(_DIRECTIONS)
    wide = evaluate_sh(model.sh_degree, directions)
    wide[:, 0] = np.float32(SH_C0)  # the same constant as in `sh0` of the other formats
    inverse, basis = np.linalg.pinv(wide).astype(np.float32), wide.astype(np.float32)
    for start in range(0, len(model), _ROWS):
        rows = slice(start, start + _ROWS)
        with np.errstate(over="ignore", invalid="ignore"):  # `SplatModel` refuses values beyond float32
            linear = basis @ np.concatenate([model.sh0[rows, None], model.shN[rows]], axis=1) + np.float32(0.5)
            exact = _srgb(np.maximum(linear, 0))
            coefficients = inverse @ (exact - np.float32(0.5))
            fitted = basis @ coefficients + np.float32(0.5)
        yield coefficients, fitted, exact


def _light(colours: F32) -> F32:
    """Invert `_srgb`."""
    light: F32 = np.where(
        colours <= np.float32(0.04045),
        colours / np.float32(12.92),
        ((colours + np.float32(0.055)) / np.float32(1.055)) ** np.float32(2.4),
    )
    return light


def _srgb(linear: F32) -> F32:
    """Convert linear values >= 0 to sRGB (IEC 61966-2-1), elementwise."""
    high = np.float32(1.055) * linear ** np.float32(1 / 2.4) - np.float32(0.055)
    colours: F32 = np.where(linear <= np.float32(0.0031308), np.float32(12.92) * linear, high)
    return colours
