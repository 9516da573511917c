"""Captures on disk to `FrameSequence`s: CO3D, `transforms.json` folders, COLMAP models.

Everything read here comes from outside: paths never leave the data set's root, sizes are compared
before anything of that size is allocated, and what cannot be used raises `InputError` in one line.
"""
