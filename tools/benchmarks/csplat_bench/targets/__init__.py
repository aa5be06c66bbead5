"""Benchmarks of targets, compared with presets, fixed shares of the splats, and another build."""
