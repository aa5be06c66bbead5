"""SOG: splat attributes as lossless WebPs with a meta.json, in a folder or zip; streamed SOG has several, in levels."""

from __future__ import annotations

from csplat.formats.format import Format
from csplat.formats.sog.sog_reader import open_sog
from csplat.formats.sog.sog_writer import write_sog

FORMAT = Format(
    name="sog",
    open=open_sog,
    open_level=open_sog,
    write=write_sog,
    carries=frozenset({"antialiased", "flat"}),
)
