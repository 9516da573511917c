"""What a result on disk was made from, and how two such descriptions differ."""

import json
import subprocess
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

MANIFEST = "manifest.json"
"""The manifest's file in the folder of every result."""

_PACKAGES = ("torch", "lightning", "diffusers", "numba", "numpy")
_MOST_NAMED = 6


@dataclass(frozen=True)
class Split:
    """The captures of one category that a model is trained on, and those held out for testing."""

    source: str
    """`synthetic` or `co3d`: captures of different sources are different, whatever their names."""
    train: tuple[str, ...]
    test: tuple[str, ...]
    seed: int | None = None
    """Of rendered captures: the same name under another seed is another object."""

    def leaked_from(self, seen: "Split") -> list[str]:
        """The captures held out here that were trained on there, within one category."""
        differ = None not in (self.seed, seen.seed) and self.seed != seen.seed
        if differ or self.source != seen.source:
            return []
        return sorted({*self.test} & {*seen.train})

    def _change(self, before: "Split | None") -> str:
        if before is None:
            return "new"
        moved = sorted({*before.test} & {*self.train} | {*before.train} & {*self.test})
        return f"{len(moved)} captures changed sides: {moved[0]}" if moved else "other captures"


@dataclass(frozen=True)
class Manifest:
    """What a result follows from. Code and package versions are recorded and not compared."""

    options: Mapping[str, Any]
    """Values by dotted key, as JSON holds them."""
    inputs: Mapping[str, str]
    """SHA-256 of the content of everything that is read, by a name that a user recognises."""
    split: Mapping[str, Split]
    """By category; empty where nothing is trained."""
    code: str
    packages: Mapping[str, str | None]

    @classmethod
    def of(
        cls,
        options: Mapping[str, Any],
        inputs: Mapping[str, str] | None = None,
        split: Mapping[str, Split] | None = None,
    ) -> "Manifest":
        """A result's manifest, with the versions that run now."""
        plain = json.loads(json.dumps(options))  # tuples become lists, as they will be read back
        packages = {name: package_version(name) for name in _PACKAGES}
        return cls(plain, inputs or {}, split or {}, code_version(), packages)

    def differences(self, before: "Manifest") -> list[str]:
        """Each option, input and category that was another, in words; empty for the same result."""
        was, now = before.options, self.options
        found = [
            f"{key} (was {was.get(key, 'not set')}, now {now.get(key, 'not set')})"
            for key in {**now, **was}
            if was.get(key) != now.get(key)
        ]
        found += [
            f"{name} ({_input_change(before.inputs.get(name), self.inputs.get(name))})"
            for name in {**self.inputs, **before.inputs}
            if before.inputs.get(name) != self.inputs.get(name)
        ]
        found += [
            f"split of {category} ({split._change(before.split.get(category))})"
            for category, split in self.split.items()
            if split != before.split.get(category)
        ]
        more = len(found) - _MOST_NAMED
        return found if more <= 1 else [*found[:_MOST_NAMED], f"and {more} more"]

    def leaked_from(self, seen: "Manifest") -> dict[str, list[str]]:
        """The captures held out here that `seen` was trained on, by category."""
        found = {
            category: self.split[category].leaked_from(seen.split[category])
            for category in self.split.keys() & seen.split.keys()
        }
        return {category: names for category, names in sorted(found.items()) if names}


def _input_change(before: str | None, now: str | None) -> str:
    if before is None:
        return "new"
    return "no longer read" if now is None else "other content"


@cache
def package_version(name: str) -> str | None:
    """The version of an installed package; None if it is not installed."""
    try:
        return version(name)
    except PackageNotFoundError:
        return None


@cache
def code_version() -> str:
    """This package's version and, in a git checkout of it, the commit."""
    installed = package_version("extrap-train") or "unknown"
    checkout = Path(__file__).parents[2]
    if not (checkout / ".git").exists():
        return installed
    command = ["git", "-C", str(checkout), "describe", "--always", "--dirty", "--abbrev=12"]
    try:
        said = subprocess.run(command, capture_output=True, text=True, check=True, timeout=10)
    except (OSError, subprocess.SubprocessError):  # no git, or a checkout of somebody else
        return installed
    return f"{installed}+{said.stdout.strip()}"
