"""Contents of a file besides its splats: scene fields, metadata, options, declared errors (spec 4.3, 5.4, 5.5)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from csplat import _spec
from csplat.encoder.codebook import Books
from csplat.encoder.colour import ShTables
from csplat.encoder.container import FileChunk, SceneFields, json_payload
from csplat.encoder.measure import ErrorSums
from csplat.encoder.options import EncodeOptions
from csplat.encoder.plan import Plan
from csplat.encoder.shape_tables import ShapeTables
from csplat.errors import InputError
from csplat.model import UNSPECIFIED, SplatModel

if TYPE_CHECKING:
    from csplat.encoder.draft import Draft, Origin


_EXTRA_COLUMNS_MAX = 255  # TLE-2: block_count is a byte
_COLOURS = tuple(_spec.MEASURE_NAMES[id] for id in range(_spec.MEASURE_SH0, _spec.MEASURE_SH0 + 4))
_SHAPES = tuple(_spec.MEASURE_NAMES[id] for id in (_spec.MEASURE_COVARIANCE, _spec.MEASURE_OPACITIES))


def chosen_settings(draft: Draft, tables: ShTables) -> dict[str, Any]:
    """Return what was asked and what followed, JSON-compatible; it becomes the OPTS chunk."""
    plan, options = draft.plan, draft.options
    return {
        "asked": options.chosen(),
        "encoder": _versions(plan),
        "position_step": plan.lattice.step,
        "position_bits": plan.lattice.bits,
        "means_coding": "morton" if plan.morton else "axis",
        "scale_step": plan.scale_step,
        "opacity_levels": plan.opacity_levels,
        "quat_levels": plan.quat_levels,
        "sh0_step": plan.sh0_step,
        "sh_step": plan.sh_step,
        "sh_degree": plan.sh_degree,
        "sh_coding": plan.sh_coding,
        "chroma_shift": plan.chroma_shift,
        "adaptive": plan.adaptive if plan.sh_coding == "scalar" else 0.0,
        "codebook_size": 0 if tables.book is None else tables.book.size,
        **_of_shapes(draft.shapes),
        **({} if draft.grades is None else {"grades": draft.grades.as_json()}),
        "deflate_level": plan.coding.level,
        "deflate": plan.coding.library,
        "seed": options.seed,
    }


def _of_shapes(shapes: ShapeTables | None) -> dict[str, Any]:
    if shapes is None:
        return {}
    return {"shape_codebook_size": shapes.size, "shape_escape_fraction": float(shapes.escaped.mean())}


def extra_columns(model: SplatModel, options: EncodeOptions) -> list[_spec.ExtraRecord]:
    """Return the records of the extra columns that are carried; none unless asked."""
    records: list[_spec.ExtraRecord] = []
    if not options.keep_extra:
        return records
    if len(model.extra) > _EXTRA_COLUMNS_MAX:
        raise InputError(f"{len(model.extra)} extra columns, a file has at most {_EXTRA_COLUMNS_MAX}")
    ids = {name: id for id, name in _spec.EXTRA_DTYPE_NAMES.items()}
    for name, column in model.extra.items():
        text = name.encode()
        kind = f"{column.dtype.kind}{8 * column.dtype.itemsize}"
        if kind not in ids:
            raise InputError(f"extra column {name!r} has dtype {column.dtype}, wanted one of {', '.join(ids)}")
        if not 1 <= len(text) <= _spec.EXTRA_NAME_MAX or any(ord(c) < 32 or ord(c) == 127 for c in name):
            raise InputError(f"extra column {name!r}: a name has 1 to {_spec.EXTRA_NAME_MAX} bytes, no control codes")
        records.append(_spec.ExtraRecord(ids[kind], len(text), text.ljust(_spec.EXTRA_NAME_MAX, b"\0")))
    return records


def stated_errors(errors: ErrorSums, origin: Origin) -> dict[str, tuple[float, float]]:
    """Return (max, rms) by measure, without the measures of refitted values, whose errors mean nothing."""
    stated = errors.stated()
    if not origin.refitted:
        return stated
    fitted = (*_COLOURS, *_SHAPES) if origin.adjusted else _COLOURS
    return {name: pair for name, pair in stated.items() if name not in fitted}


def file_chunks(draft: Draft, errors: ErrorSums, settings: dict[str, Any]) -> list[FileChunk]:
    """Return the chunks of the whole file: metadata, cameras, options, stated errors."""
    model, coding, chunks = draft.model, draft.plan.coding, []
    try:
        if model.metadata:
            chunks.append(FileChunk(_spec.CHUNK_METADATA, json_payload(dict(model.metadata), coding)))
        if model.cameras is not None:
            chunks.append(FileChunk(_spec.CHUNK_CAMERAS, json_payload(list(model.cameras), coding)))
    except (TypeError, ValueError) as problem:
        raise InputError(f"metadata or cameras are not JSON: {problem}") from None
    chunks.append(FileChunk(_spec.CHUNK_OPTIONS, json_payload(settings, coding)))
    chunks.append(FileChunk(_spec.CHUNK_STATED_ERRORS, _stated_errors(draft, errors)))
    return chunks


def file_scene(draft: Draft, books: Books, chunks: Sequence[FileChunk]) -> SceneFields:
    """Gather the scene fields of header and index."""
    model, plan = draft.model, draft.plan
    directions = {letter: id for id, letter in _spec.DIRECTION_LETTER.items()}
    letters = ("", "", "") if model.coordinate_system == UNSPECIFIED else tuple(model.coordinate_system)
    flags = model.antialiased * _spec.SCENE_FLAG_ANTIALIASED | model.flat * _spec.SCENE_FLAG_FLAT
    return SceneFields(
        sh_degree=plan.sh_degree,
        scene_flags=flags,
        axes=bytes(directions[letter] for letter in letters),
        unit_metres=model.unit_metres or 0.0,
        origin=model.origin,
        attributes=plan.attribute_records(),
        extras=draft.extras,
        codebooks=books.records,
        chunks=[*chunks, *books.chunks],
    )


def _stated_errors(draft: Draft, errors: ErrorSums) -> bytes:
    model, origin = draft.model, draft.origin
    ids = {name: id for id, name in _spec.MEASURE_NAMES.items()}
    bounds = sorted((ids[name], *pair) for name, pair in stated_errors(errors, origin).items())
    count, flags = origin.source_count, origin.refitted * _spec.ERROR_FLAG_REFITTED
    head = _spec.StatedErrorsHead(count, count - errors.count, model.sh_degree, flags, len(bounds))
    records = [_spec.pack_stated_error_record(_spec.StatedErrorRecord(id, 0, 0, 0, *pair)) for id, *pair in bounds]
    return _spec.pack_stated_errors_head(head) + b"".join(records)


def _versions(plan: Plan) -> str:
    from importlib.metadata import PackageNotFoundError, version  # a tenth of the time that importing the encoder takes

    try:
        own = version("csplat")
    except PackageNotFoundError:
        own = "unpackaged"
    return f"csplat {own}, numpy {np.__version__}, {plan.coding.library}"
