"""Benchmarks, in packages by topic: `python -m csplat_bench.TOPIC`, with `--help`.

codec             throughput, memory and size compared with other programs; quality, decoders
rendering         time of a render and of its gradients
training          a step of training, stage by stage; lego
viewer            culling, sorting, drawing; arrival, engines, owners
targets           targets compared with presets and another build
datasets          the scenes that papers report

A second word names a module: `python -m csplat_bench.codec.quality`. `common` is what several of them share.
"""
