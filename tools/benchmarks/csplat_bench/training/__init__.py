"""Benchmarks of training: a step, stage by stage; Lego by number of splats."""
