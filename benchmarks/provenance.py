"""What a result was made with, beside its hashes."""

import platform
from importlib.metadata import PackageNotFoundError, version

_PACKAGES = ("torch", "numpy", "numba", "diffusers", "scikit-image", "lpips", "torchmetrics")


def versions() -> dict[str, str]:
    """Python, the machine and the packages that decide numbers."""
    found = {"python": platform.python_version(), "machine": platform.machine()}
    for name in _PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "missing"
    return found
