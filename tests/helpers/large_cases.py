# SPDX-License-Identifier: Apache-2.0
"""Helpers of the tests of large, which several files share."""

from dataclasses import dataclass, replace

import numpy as np

from csplat import Context, EncodeOptions, encode_with_report
from csplat.encoder import LevelNode
from csplat.scene import join_blocks

WHOLE = 600  # splats per bucket
COUNT = 6 * WHOLE
FAST = EncodeOptions(
    preset="fast", sh_degree=1, sh_coding="codebook", codebook_size=32, bucket_splats=WHOLE
)  # fmt: skip


def encode_large(scene, target, options, *, levels=None, workers=1, **context):
    asked = Context(threads=1, workers=workers, **context)
    return encode_with_report(scene, options, out=target, levels=levels, context=asked).report


@dataclass(frozen=True)
class EveryFourth:
    """Levels of every fourth splat: a node for each bucket, and one above all of them; errors are the levels."""

    whole_splats: int = WHOLE

    def settings(self, count):
        return {"splats": f"every fourth of {count}"}

    def seconds(self, count, workers):
        return 1e-5 * count / workers

    def of_scene(self, sample, count):
        assert 0 < len(sample) <= count == COUNT
        return self

    def build_part(self, splats, context, coding):  # noqa: ARG002 - of the protocol
        assert context.threads == 1
        coarse = replace(splats.select(np.arange(0, len(splats), 4)), extra={}, means_double=None)
        return [LevelNode(0, 1, rows=np.arange(len(splats))), LevelNode(1, None, splats=coarse)]

    def build_top(self, roots, context, coding):  # noqa: ARG002 - of the protocol
        parts = list(roots)
        context.progress("building levels", 1.0)
        scene = join_blocks(parts[0], parts)
        return [0] * len(parts), [LevelNode(2, None, splats=scene.select(np.arange(0, len(scene), 4)))]

    def measure(self, encoded, context):  # noqa: ARG002 - of the protocol
        nodes = [replace(node, error=float(node.level), squares=(0.5,)) for node in encoded.nodes]
        return replace(encoded, nodes=nodes)

    def encode_plan(self, plan, codebooks=None):
        raise NotImplementedError


class Interrupt:
    """Progress that raises an error in a stage."""

    def __init__(self, stage, error=KeyboardInterrupt, after=0):
        self.stage, self.error, self.after = stage, error, after

    def __call__(self, stage, _done):
        if stage == self.stage:
            self.after -= 1
            if self.after < 0:
                raise self.error
