"""Category diffusion models that complete 3D scenes from a few posed photos."""
