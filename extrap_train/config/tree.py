"""What every part of the configuration tree needs."""

from typing import Any

MISSING: Any = "???"  # OmegaConf's mark for "must be given"


def dotted(tree: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """A nested mapping as one of dotted keys."""
    items: dict[str, Any] = {}
    for key, value in tree.items():
        if isinstance(value, dict):
            items |= dotted(value, f"{prefix}{key}.")
        else:
            items[prefix + key] = value
    return items
