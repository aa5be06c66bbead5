"""A study of compiled kernels: a step of the refit of splats in C++, compared with the one that numba compiles.

    python -m native_step check     # images, gradients and steps, and odd inputs
    python -m native_step hashes    # the same bits for any number of threads, instruction set and compiler
    python -m native_step bench     # time of a step

README.md describes the study.
"""
