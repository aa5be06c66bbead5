"""Benchmarks, in packages by topic: `python -m csplat_bench.TOPIC`, with `--help`.

codec             throughput, memory and size compared with other programs; quality, decoders
rendering         time of a picture and of its gradients; removal
training          a step of training, stage by stage; lego
viewer            culling, sorting, drawing; arrival, engines, owners
compression       a whole compression of trained scenes, step by step, on held-out photographs
distortion        rate against distortion compared with SPZ and SOG; classes, operating
targets           targets compared with presets and another build
datasets          the scenes that papers report
study             a published study of simple strategies, done again

A second word names a module: `python -m csplat_bench.codec.quality`. `common` is what several of them share.
"""
