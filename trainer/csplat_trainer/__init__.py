"""Training of Gaussian splats on the CPU: data sets, loss, optimisation, and a torch wrapper of the renderer.

Nothing is imported here: `csplat_trainer.loop` trains with numba alone; torch is wanted by
`autograd`, `perceptual` and `cuda`.
"""
