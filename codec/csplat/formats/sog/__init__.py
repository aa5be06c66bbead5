# SPDX-License-Identifier: Apache-2.0
"""SOG: splat attributes as lossless WebPs with a meta.json, in a folder or zip; streamed SOG has several, in levels."""

from __future__ import annotations

from csplat.formats.format import Format
from csplat.formats.sog.sog_reader import open_sog
from csplat.formats.sog.sog_writer import write_sog
from csplat.formats.sog.streamed_writer import LEVELS_NAME, write_streamed_sog

FORMAT = Format(
    name="sog",
    open=open_sog,
    open_level=open_sog,
    write=write_sog,
    write_levels=write_streamed_sog,
    levels_name=LEVELS_NAME,
    carries=frozenset({"antialiased", "flat"}),
)
