"""3D Gaussian Splatting (Kerbl et al., 2023), from points that the input views alone give."""

from dataclasses import dataclass

from benchmarks.methods.gaussian_method import GaussianMethod


@dataclass(frozen=True)
class ThreeDgs(GaussianMethod):
    """The published method; it has no schedule for few views, so this is the one for many."""
