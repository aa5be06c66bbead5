"""Decorators for the kernels of training: those of the renderer."""

from __future__ import annotations

from csplat_render.jit import kernel, parallel_kernel, relaxed_kernel

__all__ = ["kernel", "parallel_kernel", "relaxed_kernel"]
