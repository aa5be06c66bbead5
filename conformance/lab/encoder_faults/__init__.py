# SPDX-License-Identifier: CC0-1.0
"""Faulty encoders: csplat's encoder with one planted fault at a time, to test the conformance suite.

Usage:
    python -m encoder_faults --table                      # every fault, with the level and clause that catch it
    python -m encoder_faults --table --groups behaviour  # the faults of one module
    python -m encoder_faults FAULT in.ply out.csplat      # encode with one fault, as the conformance suite does

Each fault is a mistake that the author of another encoder could make: in reading the PLY and preparing the scene
(`reading`), in converting values to integers, in bytes of the file, and in the errors and counts that it declares
(`encoding`), or in the way the program ends and in the files it leaves behind (`behaviour`). Some are harmless choices,
which the suite must not report.
"""
