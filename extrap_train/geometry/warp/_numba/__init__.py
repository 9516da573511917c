"""The warp's steps in compiled loops for the CPU, each named as its torch twin."""
