"""The two numbers that define the splat, the same for every implementation."""

DEPTH_SHARPNESS = 200.0
"""β: a surface 5 % behind the nearest one weighs e⁻¹⁰, so it does not bleed through."""
LEAST_KERNEL = 0.2
"""Bilinear values below this do not count: a point must not claim a pixel that it hardly touches, or every
silhouette grows by a pixel."""
