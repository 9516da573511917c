"""Scenes of 3D Gaussians: what they are, how they are drawn and differentiated, their PLY files.

`rasterize.py` has the one drawing function, with gsplat's signature and results, on the CPU
(numba) and on CUDA (gsplat itself).
"""
