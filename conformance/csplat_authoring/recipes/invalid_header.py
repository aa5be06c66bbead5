"""Invalid files: the header."""

from __future__ import annotations

from collections.abc import Callable

from csplat import _spec
from csplat_authoring.broken import patched, small
from csplat_authoring.repair import seal
from csplat_authoring.samples import Recipe


def header_recipes() -> list[Recipe]:
    """Return the recipes of this module."""
    base, size = small(), len(small().data)
    crc = base.fields["header.header_crc"]
    flip_crc = {"header.header_crc": b"\0\0\0\0"}
    return [
        _cut("magic", "another first byte", "HDR-1", "E_MAGIC", lambda d: seal(b"\x92" + d[1:]), 0),
        _cut(
            "magic_text_mode",
            "a transfer turned CR LF into LF",
            "HDR-1",
            "E_MAGIC",
            lambda d: d.replace(b"\r\n", b"\n"),
            0,
        ),
        _cut(
            "magic_seven_bits",
            "a transfer cleared the eighth bits",
            "HDR-1",
            "E_MAGIC",
            lambda d: bytes(b & 127 for b in d),
            0,
        ),
        Recipe(
            "invalid/header_crc",
            "the header's CRC alone is wrong",
            ("HDR-3", "HDR-12"),
            lambda: base.patched(flip_crc),
            None,
            "E_CRC",
            crc.offset,
        ),
        _cut("truncated", "the last byte is missing", "HDR-5", "E_TRUNCATED", lambda d: d[:-1], size - 1),
        _cut(
            "truncated_after_header",
            "nothing follows the header",
            "HDR-5",
            "E_TRUNCATED",
            lambda d: d[: _spec.HEADER_SIZE],
            _spec.HEADER_SIZE,
        ),
        _cut("trailing", "one byte after the end", "HDR-6", "E_TRAILING", lambda d: d + b"\0", size),
        Recipe(
            "invalid/file_size_huge",
            "more than any file has",
            ("HDR-5",),
            lambda: base.patched({"header.file_size": 2**64 - 1}),
            None,
            "E_TRUNCATED",
            size,
            ("E_INDEX",),
        ),
        patched(
            "index_size_small",
            "an index without room for its head",
            "HDR-7",
            "E_VALUE",
            base,
            {"header.index_size": _spec.INDEX_HEAD_SIZE + 3},
        ),
        patched("index_size_zero", "no index", "HDR-7", "E_VALUE", base, {"header.index_size": 0}),
        patched(
            "index_size_large", "an index beyond the file", "HDR-7", "E_VALUE", base, {"header.index_size": 2**32 - 1}
        ),
        _cut("short_magic", "twenty bytes, the first eight a magic", "HDR-11", "E_TRUNCATED", lambda d: d[:20], 20),
        _cut("nothing", "no bytes at all", "HDR-11", "E_TRUNCATED", lambda _: b"", 0),
        _cut("short_garbage", "five bytes of something else", "HDR-11", "E_MAGIC", lambda _: b"hello", 0),
    ]


def _cut(name: str, why: str, clause: str, code: str, make: Callable[[bytes], bytes], at: int | None) -> Recipe:
    return Recipe(f"invalid/{name}", why, (clause,), lambda: make(small().data), None, code, at)
