# SPDX-License-Identifier: Apache-2.0
"""Subjects of measurement: one module for each, registered here by the name that suites use."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from csplat_bench.protocol import Setup, Subject
from csplat_bench.subjects.arrival import measure_arrival
from csplat_bench.subjects.batch_runs import measure_batches
from csplat_bench.subjects.browsers import measure_browsers
from csplat_bench.subjects.captures import measure_capture, scene_keys
from csplat_bench.subjects.decoder_agreement import compare_decoders
from csplat_bench.subjects.decoders import measure_decoders
from csplat_bench.subjects.encoder_inputs import input_names, measure_input
from csplat_bench.subjects.engine_images import measure_images
from csplat_bench.subjects.engine_loaders import measure_loaders
from csplat_bench.subjects.file_parts import measure_parts
from csplat_bench.subjects.files import measure_files
from csplat_bench.subjects.first_bytes import measure_first_bytes
from csplat_bench.subjects.gpu_rendering import measure_gpu
from csplat_bench.subjects.kernel_times import measure_kernels
from csplat_bench.subjects.large_scenes import measure_commands
from csplat_bench.subjects.level_quality import measure_levels
from csplat_bench.subjects.photographs import measure_photographs
from csplat_bench.subjects.rendering import measure_rendering
from csplat_bench.subjects.training_steps import measure_training
from csplat_bench.subjects.viewer_drawing import measure_drawing

SUBJECTS: dict[str, Subject] = {
    "arrival": measure_arrival,
    "batch_runs": measure_batches,
    "browsers": measure_browsers,
    "captures": measure_capture,
    "decoder_agreement": compare_decoders,
    "decoders": measure_decoders,
    "encoder_inputs": measure_input,
    "engine_images": measure_images,
    "engine_loaders": measure_loaders,
    "file_parts": measure_parts,
    "files": measure_files,
    "first_bytes": measure_first_bytes,
    "gpu_rendering": measure_gpu,
    "kernel_times": measure_kernels,
    "large_scenes": measure_commands,
    "level_quality": measure_levels,
    "photographs": measure_photographs,
    "rendering": measure_rendering,
    "training_steps": measure_training,
    "viewer_drawing": measure_drawing,
}

#: Subjects that find their scenes by patterns.
SCENE_FINDERS: dict[str, Callable[[Setup, Sequence[str]], list[str]]] = {
    "captures": scene_keys,
    "encoder_inputs": input_names,
}
