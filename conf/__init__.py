"""The configuration tree: one YAML per choice, shipped with the package."""
