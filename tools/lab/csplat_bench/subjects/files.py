# SPDX-License-Identifier: Apache-2.0
"""Files of a scene: bytes, quality, time and memory of encoders, ours and those of others.

Options: `metrics`, names of `metrics.METRICS`; `views`, as in `Scene.scorer`. Default: given.
A case is an encoder (`encoders`). `all_splats = false` marks one that prunes, `kind` groups those that differ in
nothing but their target.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from csplat.errors import InputError
from csplat_bench.encoders import make_file
from csplat_bench.metrics import METRICS, Reference
from csplat_bench.protocol import Measure, Setup
from csplat_bench.scenes import find_scene
from csplat_bench.suites import Case


@contextmanager
def measure_files(setup: Setup, name: str, _: Sequence[Case]) -> Iterator[Measure]:
    """Yield the function that makes and measures a file."""
    metrics = setup.options.get("metrics", [])
    unknown = set(metrics) - set(METRICS)
    if unknown:
        raise InputError(f"unknown metrics {', '.join(sorted(unknown))}, expected some of {', '.join(METRICS)}")
    scene = find_scene(name, setup.data, setup.work)
    reference, known = Reference(scene, setup.options.get("views", "given")), set[str]()

    def measure(case: Case) -> Mapping[str, Any]:
        with tempfile.TemporaryDirectory(prefix="csplat-bench-") as folder:
            made = make_file(setup, scene, case, Path(folder))
            values = {
                "splats": scene.splat_count, "sh_degree": scene.sh_degree, "ply_bytes": scene.size_bytes,
                "size_bytes": made.path.stat().st_size, "all_splats": case.get("all_splats", True),
                "kind": case.get("kind", case.name), **made.values,
            }  # fmt: skip
            for one in case.get("metrics", metrics):
                function, of_time = METRICS[one]
                if of_time or case.name not in known:
                    values |= function(made, reference, case)
        known.add(case.name)
        return values

    yield measure
