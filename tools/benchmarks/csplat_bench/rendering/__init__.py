"""Benchmarks of rendering and gradients."""
