"""Benchmarks of rendering, gradients, and the removal of splats."""
