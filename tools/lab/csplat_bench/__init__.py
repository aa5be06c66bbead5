# SPDX-License-Identifier: Apache-2.0
"""Benchmarks: suites in TOML, one runner, results as JSON.

    python -m csplat_bench list                          # all suites
    python -m csplat_bench run codec --scenes lego60k    # measures what is missing in out/bench/codec.json
    python -m csplat_bench table out/bench/codec.json
    python -m csplat_bench plot out/bench/codec.json
    python -m csplat_bench pages                         # tables and plots of the documentation, from results/

A suite (`suites/NAME.toml`) names scenes, cases, and the subject that measures a case on a scene: a function that is
registered in `subjects.py`. Every subject is one module.
"""
