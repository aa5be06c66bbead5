"""Index: head, attribute, codebook and extra column records (spec 4.3 to 4.3.3)."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from fractions import Fraction

from csplat import _spec
from csplat_conformance.validator.findings import Findings, Placed
from csplat_conformance.validator.reading import place

#: Bytes of the fields that this version knows.
_LEAST = {
    "head": _spec.INDEX_HEAD_SIZE,
    "attribute": _spec.ATTRIBUTE_RECORD_SIZE,
    "codebook": _spec.CODEBOOK_RECORD_SIZE,
    "extra": _spec.EXTRA_RECORD_SIZE,
    "directory": _spec.DIRECTORY_RECORD_SIZE,
    "tile": _spec.TILE_RECORD_SIZE,
    "layer": _spec.LAYER_RECORD_SIZE,
}
_CRC_SIZE = 4
_STEP_MIN = Fraction(1, 2**1022)
_SINGLE_MIN, _SINGLE_MAX = Fraction(1, 2**126), Fraction(2**128 - 2**104)
_STEP_MAX = Fraction((2**53 - 1) * 2**971)  # the largest finite binary64
_LINES = {"R": 0, "L": 0, "U": 1, "D": 1, "F": 2, "B": 2}

Head = Placed[_spec.IndexHead]
AttributeAt = Placed[_spec.AttributeRecord]
CodebookAt = Placed[_spec.CodebookRecord]


@dataclass
class Index:
    """The contents of the index, as far as it could be read.

    Attributes:
        head: the index head.
        degree: `sh_degree`; `None` if this version does not have that degree.
        attributes: by registry value.
        steps: steps that obey ATT-6, by registry value.
        levels: levels that obey ATT-3 or ATT-4, by registry value.
        codebooks: by id; only codebooks whose kind and sizes are valid.
        codebook_ids: ids of all codebook records.
        extras: bytes of each extra column's values, `None` if the type is unknown.
        complete: whether all records before the directory fit into the index.
        end: offset of the end of the last of them.
    """

    head: Head
    degree: int | None
    attributes: dict[int, AttributeAt] = field(default_factory=dict)
    steps: dict[int, float] = field(default_factory=dict)
    levels: dict[int, int] = field(default_factory=dict)
    codebooks: dict[int, CodebookAt] = field(default_factory=dict)
    codebook_ids: set[int] = field(default_factory=set)
    extras: list[int | None] = field(default_factory=list)
    complete: bool = True
    end: int = 0

    def size_of(self, kind: str) -> int:
        """Return the bytes of the head or of a kind of record, tail included; at least the bytes of its fields."""
        return max(_LEAST[kind], int(getattr(self.head.record, f"{kind}_size")))


def scaled(step: float, exponent: int, *, single: bool = False) -> float | None:
    """Return step × 2^exponent, `None` if it is not finite or subnormal in binary64, or binary32 (TIL-9, LAT-1)."""
    if abs(exponent) > 4096:  # beyond any pair of binary64 values, and not worth such an integer
        return None
    product = Fraction(step) * Fraction(2) ** exponent
    low, high = (_SINGLE_MIN, _SINGLE_MAX) if single else (_STEP_MIN, _STEP_MAX)
    return float(product) if low <= product <= high else None


def read_records(view: memoryview, end: int, findings: Findings) -> Index:
    """Read everything of the index before the directory.

    Args:
        view: the file.
        end: offset of the index's CRC by the header, at most the end of the data.
        findings: receives the violations.
    """
    start = _spec.HEADER_SIZE
    head = place(view, _spec.unpack_index_head, _spec.INDEX_HEAD_OFFSETS, start, "index")
    record = head.record
    index = Index(head, record.sh_degree if record.sh_degree <= _spec.SH_DEGREE_MAX else None)
    kinds = ("attribute", "codebook", "extra", "directory", "tile")
    needed = index.size_of("head") + sum(getattr(record, f"{kind}_count") * index.size_of(kind) for kind in kinds)
    if start + needed > end:
        findings.add("IDX-2", start, "index", f"its counts ask for {needed} bytes at least, it has {end - start}")
    _check_head(findings, head)
    at = start + index.size_of("head")
    at = _read_attributes(view, at, end, index, findings)
    at = _read_codebooks(view, at, end, index, findings)
    index.end = _read_extras(view, at, end, index, findings)
    return index


def _fitting(index: Index, at: int, end: int, count: int, size: int) -> int:
    """Return how many records of a kind fit into the index; after the first kind that does not fit, none do."""
    fitting = min(count, max(0, (end - at) // size)) if index.complete else 0
    index.complete &= fitting == count
    return fitting


def _check_head(findings: Findings, head: Head) -> None:
    record = head.record
    findings.reserved(head)
    for kind, least in _LEAST.items():
        size = getattr(record, f"{kind}_size")
        if size < least:
            findings.of("IDX-8", head, f"{kind}_size", f"{size}, wanted {least} at least")
    if record.sh_degree > _spec.SH_DEGREE_MAX:
        findings.of("IDX-3", head, "sh_degree", f"{record.sh_degree}, wanted {_spec.SH_DEGREE_MAX} at most")
    unlisted = record.scene_flags & 0x0F & ~sum(_spec.SCENE_FLAG_NAMES)
    if unlisted:
        findings.of("RES-1", head, "scene_flags", f"bits {unlisted:#04x} are reserved")
    letters = [_spec.DIRECTION_LETTER.get(axis) for axis in record.axes]
    if any(record.axes) and {_LINES.get(letter or "") for letter in letters} != {0, 1, 2}:
        findings.of("IDX-4", head, "axes", f"{list(record.axes)}, wanted zeros or directions along three lines")
    if not 0.0 <= record.unit_metres < math.inf:
        findings.of("IDX-5", head, "unit_metres", f"{record.unit_metres}, wanted 0, or positive and finite")
    for axis, value in enumerate(record.origin):
        if not math.isfinite(value):
            findings.of(
                "IDX-6", head, "origin", f"component {axis} is {value}, wanted a finite number", within=8 * axis
            )


# Attribute records ---------------------------------------------------------------------------------


def _read_attributes(view: memoryview, at: int, end: int, index: Index, findings: Findings) -> int:
    count = index.head.record.attribute_count
    bands = 0 if index.degree is None else index.degree
    wanted = [value for value, layer in _spec.ATTRIBUTE_LAYER.items() if layer <= bands]
    if index.degree is not None and count != len(wanted):
        findings.of("ATT-1", index.head, "attribute_count", f"{count}, wanted {len(wanted)} for SH degree {bands}")
    for i in range(_fitting(index, at, end, count, index.size_of("attribute"))):
        attribute = view[at]
        name = f"attribute[{_spec.ATTRIBUTE_NAMES.get(attribute, attribute)}]"
        placed = place(view, _spec.unpack_attribute_record, _spec.ATTRIBUTE_RECORD_OFFSETS, at, name)
        findings.reserved(placed)
        if count == len(wanted) and index.degree is not None and attribute != wanted[i]:
            findings.of("ATT-1", placed, "attribute", f"{attribute}, wanted {wanted[i]} in place {i}")
        if attribute in _spec.ATTRIBUTE_NAMES and attribute not in index.attributes:
            index.attributes[attribute] = placed
            _check_attribute(findings, placed, index)
        at += index.size_of("attribute")
    return at


def _check_attribute(findings: Findings, placed: AttributeAt, index: Index) -> None:
    record = placed.record
    legal = _spec.ATTRIBUTE_MAPPINGS[record.attribute]
    if _spec.MAPPING_NAMES.get(record.mapping) not in legal:
        findings.of("ATT-2", placed, "mapping", f"{record.mapping}, wanted {' or '.join(legal) or 'none'}")
    if record.chroma_shift > _spec.CHROMA_SHIFT_MAX:
        findings.of("ATT-8", placed, "chroma_shift", f"{record.chroma_shift}, wanted {_spec.CHROMA_SHIFT_MAX} at most")
    if record.chroma_shift and record.mapping != _spec.MAPPING_YCOCG:
        findings.of("ATT-9", placed, "chroma_shift", f"{record.chroma_shift}, wanted 0 without YCOCG")
    kind = _spec.ATTRIBUTE_KIND[record.attribute]
    if kind == "lattice":
        _check_lattice(findings, placed, index)
    elif kind == "levels":
        _check_levels(findings, placed, index)


def _check_levels(findings: Findings, placed: AttributeAt, index: Index) -> None:
    record = placed.record
    clause, low, high = "ATT-4", _spec.QUAT_LEVELS_MIN, _spec.QUAT_LEVELS_MAX
    if record.attribute == _spec.ATTRIBUTE_OPACITIES:
        clause, low, high = "ATT-3", 1, _spec.OPACITY_LEVELS_MAX
    if low <= record.levels <= high:
        index.levels[record.attribute] = record.levels
    else:
        findings.of(clause, placed, "levels", f"{record.levels}, wanted {low} to {high}")
    if record.step != 0.0 or math.copysign(1.0, record.step) < 0.0:
        findings.of("ATT-7", placed, "step", f"{record.step} for an attribute of levels, wanted +0")


def _check_lattice(findings: Findings, placed: AttributeAt, index: Index) -> None:
    record = placed.record
    if record.levels:
        findings.of("ATT-5", placed, "levels", f"{record.levels} for a lattice, wanted 0")
    if not 2.0**-1022 <= record.step < math.inf:
        findings.of("ATT-6", placed, "step", f"{record.step}, wanted positive, finite and at least 2^-1022")
    elif record.attribute != _spec.ATTRIBUTE_MEANS and not _is_single(Fraction(record.step)):
        findings.of("ATT-10", placed, "step", f"{record.step}, wanted a binary32 value of at least 2^-126")
    else:
        index.steps[record.attribute] = record.step


def _is_single(step: Fraction) -> bool:
    """Return True for a normal binary32 value: at most 24 bits from the first 1 to the last."""
    if not _SINGLE_MIN <= step <= _SINGLE_MAX:
        return False
    odd = step.numerator  # a binary fraction: either over a power of two, or whole
    return (odd // (odd & -odd)).bit_length() <= 24


# Codebook records ----------------------------------------------------------------------------------


def _read_codebooks(view: memoryview, at: int, end: int, index: Index, findings: Findings) -> int:
    last = -1
    for _ in range(_fitting(index, at, end, index.head.record.codebook_count, index.size_of("codebook"))):
        identity = int.from_bytes(view[at : at + 2], "little")
        name = f"codebook[{identity}]"
        placed = place(view, _spec.unpack_codebook_record, _spec.CODEBOOK_RECORD_OFFSETS, at, name)
        findings.reserved(placed)
        if identity <= last:
            findings.of("CBR-1", placed, "codebook_id", f"{identity} after {last}, wanted ascending ids")
        last = identity
        index.codebook_ids.add(identity)
        if _is_sound_codebook(findings, placed, index):
            index.codebooks.setdefault(identity, placed)
        at += index.size_of("codebook")
    return at


def _is_sound_codebook(findings: Findings, placed: CodebookAt, index: Index) -> bool:
    record = placed.record
    before = len(findings.violations)
    first, last = record.band_first, record.band_last
    if record.kind not in _spec.CODEBOOK_KIND_NAMES:
        findings.of("RES-2", placed, "kind", f"{record.kind} is no kind that this version uses")
    elif record.kind == _spec.CODEBOOK_KIND_SH:
        highest = _spec.SH_DEGREE_MAX if index.degree is None else index.degree
        if not 1 <= first <= last <= highest:
            findings.of("CBR-2", placed, "band_first", f"bands {first} to {last} in a scene of degree {highest}")
    elif first or last:
        findings.of("CBR-2", placed, "band_first", f"bands {first} to {last} of a kind without bands, wanted 0")
    if not 1 <= record.size <= _spec.CODEBOOK_ENTRIES_MAX:
        findings.of("CBR-4", placed, "size", f"{record.size} entries, wanted 1 to {_spec.CODEBOOK_ENTRIES_MAX}")
    return len(findings.violations) == before


# Extra column records ------------------------------------------------------------------------------


def _read_extras(view: memoryview, at: int, end: int, index: Index, findings: Findings) -> int:
    names: set[str] = set()
    for i in range(_fitting(index, at, end, index.head.record.extra_count, index.size_of("extra"))):
        placed = place(view, _spec.unpack_extra_record, _spec.EXTRA_RECORD_OFFSETS, at, f"extra[{i}]")
        record = placed.record
        if record.dtype < _spec.ANCILLARY_ID_MIN and record.dtype not in _spec.EXTRA_DTYPE_NAMES:
            findings.of("RES-2", placed, "dtype", f"{record.dtype} is no type of the registry")
        if not 1 <= record.name_size <= _spec.EXTRA_NAME_MAX:
            findings.of("EXR-1", placed, "name_size", f"{record.name_size}, wanted 1 to {_spec.EXTRA_NAME_MAX}")
        else:
            _check_name(findings, placed, names)
        index.extras.append(_spec.EXTRA_DTYPE_BYTES.get(record.dtype))
        at += index.size_of("extra")
    return at


def _check_name(findings: Findings, placed: Placed[_spec.ExtraRecord], names: set[str]) -> None:
    raw = placed.record.name[: placed.record.name_size]
    rest = placed.record.name[placed.record.name_size :]
    if any(rest):
        findings.of("EXR-3", placed, "name", "bytes behind the name are not 0", within=len(raw))
    try:
        name = raw.decode("utf-8")
    except UnicodeDecodeError as error:
        findings.of("EXR-2", placed, "name", f"byte {error.start} is not UTF-8", within=error.start)
        return
    if any(ord(character) < 0x20 or ord(character) == 0x7F for character in name):
        findings.of("EXR-2", placed, "name", f"a control character in {name!r}")
    if name in names:
        findings.of("EXR-2", placed, "name", f"a second column is called {name!r}")
    names.add(name)
