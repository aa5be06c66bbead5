"""SPZ of version 4, for programs that read no other; `csplat.formats.spz` tells it apart and reads it."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

from csplat.formats import spz

FORMAT = replace(spz.FORMAT, name="spz4", write=partial(spz.write_spz, version=4))
