# SPDX-License-Identifier: Apache-2.0
"""Open a GPU through wgpu (Vulkan, Metal, Direct3D 12) and run the compute shaders of `codec/wgsl` on it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from csplat.errors import InputError, missing_package
from csplat_render.conventions import Backend

#: The shaders lie next to this package in a wheel, and in a folder of their own in a checkout.
_FOLDERS = (
    Path(__file__).resolve().parent.parent / "wgsl",
    Path(__file__).resolve().parents[3] / "codec" / "wgsl",
)

#: Source files of each pass; `common.wgsl` precedes them all.
_PASSES = {
    "cull": ("layout", "cull"),
    "compact": ("scan", "compact"),
    "project": ("layout", "project"),
    "sort": ("scan", "sort"),
    "bin": ("scan", "bin"),
    "ranges": ("ranges",),
    "blend": ("blend",),
    "dispatch": ("dispatch",),
    "difference": ("difference",),
}

_HARDWARE = ("DiscreteGPU", "IntegratedGPU", "VirtualGPU")
_KINDS = (*_HARDWARE, "CPU", "Unknown")  # preferred kinds first

_BINDING_MAX = 1 << 30  # bytes; larger buffers are not used even if the GPU allows them
_ALIGNMENT = 16  # bytes; buffers are multiples of a vector of four numbers, and not empty


@dataclass(frozen=True)
class Adapter:
    """A GPU, or software that acts as one.

    Attributes:
        name: name of the device.
        kind: `DiscreteGPU`, `IntegratedGPU`, `VirtualGPU`, `CPU` or `Unknown`, as wgpu reports it.
        backend: `Vulkan`, `Metal`, `D3D12` or `OpenGL`.
    """

    name: str
    kind: str
    backend: str

    @property
    def is_hardware(self) -> bool:
        """True unless software emulates the GPU."""
        return self.kind in _HARDWARE

    def __str__(self) -> str:
        return f"{self.name} ({self.kind}, {self.backend})"


Count = int | tuple[int, int] | tuple[Any, int]


@dataclass(frozen=True, eq=False)
class Call:
    """A pass with its buffers and the number of its workgroups, see `Device.bind`."""

    pipeline: Any
    group: Any
    count: Count


#: Passes with a name.
Stage = tuple[str, list[Call]]


class Device:
    """A GPU with its compiled passes; see `open_device`.

    Attributes:
        adapter: the GPU.
        binding_max: size of the largest buffer that a shader can read, bytes.
        has_timestamps: True if `time` can measure.
    """

    def __init__(self, wgpu: Any, adapter: Any, binding_max: int | None) -> None:
        self.adapter = _describe(adapter)
        limits = adapter.limits
        required = {}
        if binding_max is None:
            names = ("max-buffer-size", "max-storage-buffer-binding-size")
            required = {name: limits[name] for name in names}
        self._wgpu = wgpu
        self.has_timestamps = _TIMESTAMPS in adapter.features
        features = [_TIMESTAMPS] if self.has_timestamps else []
        with self._named_errors():
            self._device = adapter.request_device_sync(required_limits=required, required_features=features)
        largest = min(self._device.limits[name] for name in ("max-buffer-size", "max-storage-buffer-binding-size"))
        self.binding_max = min(binding_max or largest, largest, _BINDING_MAX)
        self._pipelines: dict[tuple[str, str], Any] = {}

    def buffer(self, size_bytes: int, *, uniform: bool = False, indirect: bool = False) -> Any:
        """Return a buffer of zeros for shaders.

        Raises:
            InputError: the GPU has too little memory.
        """
        usage = self._wgpu.BufferUsage
        flags = usage.COPY_DST | usage.COPY_SRC | (usage.UNIFORM if uniform else usage.STORAGE)
        size = max(_ALIGNMENT, -(-size_bytes // _ALIGNMENT) * _ALIGNMENT)
        with self._named_errors():
            return self._device.create_buffer(size=size, usage=flags | (usage.INDIRECT if indirect else 0))

    def upload(self, buffer: Any, array: NDArray[Any]) -> None:
        """Write an array to the beginning of a buffer; its size is a multiple of four bytes.

        Raises:
            InputError: the GPU failed or was lost.
        """
        flat = np.ascontiguousarray(array).reshape(-1).view(np.uint8)
        with self._named_errors():
            for start in range(0, len(flat), _UPLOAD):
                self._device.queue.write_buffer(buffer, start, flat[start : start + _UPLOAD])

    def uploaded(self, array: NDArray[Any], **usage: bool) -> Any:
        """Return a buffer with the content of an array."""
        buffer = self.buffer(array.nbytes, **usage)
        if array.nbytes:
            self.upload(buffer, array)
        return buffer

    def read(self, buffer: Any, size_bytes: int) -> NDArray[np.uint8]:
        """Wait for the GPU, and read the beginning of a buffer.

        Raises:
            InputError: the GPU failed or was lost.
        """
        with self._named_errors():
            return np.frombuffer(self._device.queue.read_buffer(buffer, 0, size_bytes), np.uint8)

    def run(self, calls: Sequence[Call], *, clear: Sequence[Any] = ()) -> None:
        """Run passes one after the other, after the passes of earlier calls. Fill the buffers in `clear` with 0 first.

        Raises:
            InputError: the GPU failed or was lost.
        """
        with self._named_errors():
            encoder = self._encoder(clear)
            _encode_calls(encoder.begin_compute_pass(), calls)
            self._device.queue.submit([encoder.finish()])

    def time(self, stages: Sequence[Stage], *, clear: Sequence[Any] = ()) -> list[float]:
        """Run stages one after the other like `run`, and return the milliseconds of each.

        Raises:
            InputError: the GPU has no timestamps, failed, or was lost.
        """
        if not self.has_timestamps:
            raise InputError(f"{self.adapter} has no timestamps")
        # The interface of wgpu lacks the unit of timestamps, nanoseconds; on some GPUs it is not 1.
        from wgpu.backends.wgpu_native import lib

        count = 2 * len(stages)
        with self._named_errors():
            encoder = self._encoder(clear)
            queries = self._device.create_query_set(type="timestamp", count=count)
            for number, (_, calls) in enumerate(stages):
                writes = {
                    "query_set": queries,
                    "beginning_of_pass_write_index": 2 * number,
                    "end_of_pass_write_index": 2 * number + 1,
                }
                _encode_calls(encoder.begin_compute_pass(timestamp_writes=writes), calls)
            usage = self._wgpu.BufferUsage
            stamps = self._device.create_buffer(size=8 * count, usage=usage.QUERY_RESOLVE | usage.COPY_SRC)
            encoder.resolve_query_set(queries, 0, count, stamps, 0)
            self._device.queue.submit([encoder.finish()])
            unit = lib.wgpuQueueGetTimestampPeriod(self._device.queue._internal)  # noqa: SLF001 - see above
        times = self.read(stamps, 8 * count).view(np.uint64).astype(np.int64).reshape(-1, 2)
        return [float(end - begin) * unit * 1e-6 for begin, end in times]

    def _encoder(self, clear: Sequence[Any]) -> Any:
        """Return a new encoder of commands, whose first commands set the buffers `clear` to 0."""
        encoder = self._device.create_command_encoder()
        for buffer in clear:
            encoder.clear_buffer(buffer)
        return encoder

    def bind(self, name: str, entry: str, count: Count, *buffers: Any) -> Call:
        """Return a pass with its buffers.

        Args:
            name: the pass, see `shader_source`.
            entry: its entry point.
            count: number of workgroups, in one or two dimensions; or a buffer and the offset of three numbers in it.
            buffers: the buffers of the bindings from 0 on; `None` for those that the entry point does not use.

        Raises:
            InputError: the GPU failed or was lost, or a buffer belongs to another GPU.
        """
        entries = [
            {"binding": slot, "resource": {"buffer": buffer, "offset": 0, "size": buffer.size}}
            for slot, buffer in enumerate(buffers)
            if buffer is not None
        ]
        with self._named_errors():
            pipeline = self._pipeline(name, entry)
            group = self._device.create_bind_group(layout=pipeline.get_bind_group_layout(0), entries=entries)
        return Call(pipeline, group, count)

    @contextmanager
    def _named_errors(self) -> Iterator[None]:
        """Raise errors of wgpu within the context as an `InputError` with the GPU's name.

        After any error but a lack of memory, `open_device` opens all GPUs anew.
        """
        try:
            yield
        except self._wgpu.GPUOutOfMemoryError:
            raise InputError(f"{self.adapter} has too little memory") from None
        except (self._wgpu.GPUError, RuntimeError) as error:  # wgpu raises the latter if a buffer cannot be read
            open_device.cache_clear()  # the device may be lost
            last = str(error).strip().rpartition("\n")[2].strip()
            raise InputError(f"{self.adapter} failed: {last or type(error).__name__}") from None

    def _pipeline(self, name: str, entry: str) -> Any:
        """Return the pipeline of an entry point of a pass, see `shader_source`; it is compiled once per device."""
        pipeline = self._pipelines.get((name, entry))
        if pipeline is None:
            module = self._device.create_shader_module(label=name, code=shader_source(name))
            compute = {"module": module, "entry_point": entry}
            pipeline = self._pipelines[name, entry] = self._device.create_compute_pipeline(
                layout="auto", compute=compute
            )
        return pipeline


def _encode_calls(compute: Any, calls: Sequence[Call]) -> None:
    """Add calls to a compute pass in their order, and end it; nothing runs before it is submitted."""
    for call in calls:
        compute.set_pipeline(call.pipeline)
        compute.set_bind_group(0, call.group)
        if isinstance(call.count, int):
            compute.dispatch_workgroups(call.count)
        elif isinstance(call.count[0], int):
            compute.dispatch_workgroups(*call.count)
        else:
            compute.dispatch_workgroups_indirect(*call.count)
    compute.end()


_UPLOAD = 1 << 26  # bytes per write of `Device.upload`
_TIMESTAMPS = "timestamp-query"


def shader_source(name: str) -> str:
    """Return the WGSL of a pass."""
    folder = next(folder for folder in _FOLDERS if folder.is_dir())
    parts = [(folder / f"{part}.wgsl").read_text(encoding="utf-8") for part in ("common", *_PASSES[name])]
    return "\n".join(parts)


def find_device(backend: Backend) -> tuple[Device | None, str]:
    """Return the GPU of a backend; or `None` for the CPU and, for `auto`, the reason.

    Raises:
        InputError: there is no such backend; or no GPU, and the backend requires one.
    """
    if backend not in get_args(Backend):
        raise InputError(f"the backend is {backend!r}, expected one of {', '.join(get_args(Backend))}")
    if backend == "cpu":
        return None, ""
    try:
        return open_device(software=backend == "software"), ""
    except InputError as error:
        if backend != "auto":
            raise InputError(f"{error}: the backend cpu needs none") from None
        return None, str(error)


@cache
def open_device(*, software: bool = False, binding_max: int | None = None) -> Device:
    """Open the fastest GPU of this machine; the same device is returned every time, until it fails.

    Args:
        software: use an adapter that emulates a GPU on the CPU, for tests.
        binding_max: size of the largest buffer, bytes; `None`: what the GPU allows.

    Raises:
        InputError: wgpu is not installed, or there is no such GPU; the message names what was found.
    """
    try:
        import wgpu
    except ModuleNotFoundError as error:
        raise missing_package(error, extra="gpu") from None
    except (ImportError, OSError) as error:
        raise InputError(f"wgpu cannot be loaded: {error}") from None
    adapters = [adapter for adapter in wgpu.gpu.enumerate_adapters_sync() if adapter.info["backend_type"] != "OpenGL"]
    adapters.sort(key=lambda adapter: _KINDS.index(_describe(adapter).kind))
    usable = [adapter for adapter in adapters if _describe(adapter).is_hardware is not software]
    if not usable:
        names = ", ".join(str(_describe(adapter)) for adapter in adapters)
        raise InputError(f"no {'software adapter' if software else 'GPU'} was found{names and f', only {names}'}")
    return Device(wgpu, usable[0], binding_max)


def _describe(adapter: Any) -> Adapter:
    """Return the description of wgpu's adapter; its kind is `Unknown` if this module does not know it."""
    info = adapter.info
    kind = info["adapter_type"]
    return Adapter(info["device"], kind if kind in _KINDS else _KINDS[-1], info["backend_type"])
