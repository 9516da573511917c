"""What images and scores follow from: the two manifests whose digests name a cell.

The code that a manifest states is a digest of whole folders of sources, because the version of a
checkout does not tell two edited ones apart. Reports have no part in it.
"""

import hashlib
import os
from collections.abc import Iterator, Mapping
from dataclasses import asdict
from functools import lru_cache
from pathlib import Path

from benchmarks.protocol.draws import digest
from benchmarks.protocol.prepared_scene import Scene
from extrap_train.config import MethodConfig, RulesConfig, ScoringConfig
from extrap_train.config.options import dotted
from extrap_train.errors import InputError
from extrap_train.factories import module_file
from extrap_train.metrics import BACKBONES, hub_cache
from extrap_train.store.digests import file_digest
from extrap_train.store.manifest import Manifest

KEY_LENGTH = 20
"""Hexadecimal digits of a cell's key."""
_ROOT = Path(__file__).parents[2]
_MAKING = (
    "extrap_train",
    "benchmarks/methods",
    "benchmarks/protocol/prepared_scene.py",
    "benchmarks/run/run_method.py",
)
_SCORING = (
    "benchmarks/score",
    "benchmarks/protocol/prepared_scene.py",
    "extrap_train/metrics.py",
    "extrap_train/geometry",
    "extrap_train/reconstruction/cloud_metrics.py",
)
_PREPARING = ("benchmarks/protocol", "data_prep", "extrap_train")
_NO_SOURCES = ("site-packages", "dist-packages", "__pycache__")


def cell_key(made_from: Manifest, scored_from: Manifest) -> str:
    """A cell's name."""
    return digest([identity_of(made_from), identity_of(scored_from)])[:KEY_LENGTH]


def identity_of(manifest: Manifest) -> str:
    """Digest of what a manifest's differences are about."""
    return digest([dict(manifest.options), dict(manifest.inputs)])


def making_code(module: str = "") -> str:
    """Digest of the code that makes images, with that of a method's own module."""
    return sources_digest(_MAKING, module)


def preparing_code() -> str:
    """Digest of the code that prepares scenes."""
    return sources_digest(_PREPARING)


def images_manifest(
    config: MethodConfig,
    scene: Scene,
    weights: str,
    code: str,
    rules: RulesConfig,
    device: str,
) -> Manifest:
    """What a method's images of a scene follow from."""
    inputs = {"photographs": scene.data_hash, "weights": weights, "code": code}
    return Manifest.of(image_options(config, rules, device), inputs)


def image_options(config: MethodConfig, rules: RulesConfig, device: str) -> dict[str, object]:
    """The options that a method's images follow from, by dotted key."""
    tree = {"factory": config.factory, "options": config.options, "rules": asdict(rules)}
    return dotted(tree | {"device": device})


def scores_manifest(scoring: ScoringConfig) -> Manifest:
    """What the scores of images follow from; raises InputError where a named file is missing."""
    options = dotted(asdict(scoring) | {"lpips_weights": sorted(scoring.lpips_weights)})
    modules = {name: metric.factory.rpartition(".")[0] for name, metric in scoring.own.items()}
    code = {f"code of {name}": sources_digest((), module) for name, module in modules.items()}
    files = {column: file_digest(file) for column, file in judging_files(scoring).items()}
    return Manifest.of(options, files | code | {"code": sources_digest(_SCORING)})


def judging_files(scoring: ScoringConfig) -> Mapping[str, Path]:
    """By column, the file that judges: the one that is named, there or not, or else the one in
    torch's hub cache. A column without either is left out.
    """
    files = {}
    for column in scoring.judged:
        net = column.removeprefix("lpips_")
        cached = hub_cache() / BACKBONES["vgg" if column == "dists" else net]
        if net in scoring.lpips_weights:
            files[column] = Path(scoring.lpips_weights[net])
        elif cached.is_file():
            files[column] = cached
    return files


@lru_cache
def sources_digest(places: tuple[str, ...], module: str = "") -> str:
    """Digest of the Python files in `places` of this project, and of those of `module`, which may
    come from elsewhere: all below the folder that its import begins at (as with `--config-dir`).
    """
    files = [file for place in places for file in _sources(_ROOT / place)]
    if module and not module.startswith("benchmarks."):
        files += _sources(_import_root(module))
    digests = hashlib.sha256()
    for file in files:
        digests.update(f"{file.name}\0{file_digest(file)}\n".encode())
    return digests.hexdigest()


def _sources(place: Path) -> Iterator[Path]:
    """A file, or all Python files below a folder but those of installed packages."""
    if place.is_file():
        yield place
        return
    for folder, names, files in os.walk(place):
        names[:] = sorted(n for n in names if n not in _NO_SOURCES and not n.startswith("."))
        yield from (Path(folder) / file for file in sorted(files) if file.endswith(".py"))


def _import_root(module: str) -> Path:
    """The folder on the import path that a module is found in, as `root` of root/package/module.py;
    of a module that belongs to an installed package its own file.
    """
    file = module_file(module)
    if file is None:
        raise InputError(f"module {module}: not found; is its folder given with --config-dir?")
    file = file.resolve()
    if any(part in _NO_SOURCES for part in file.parts):
        return file
    return file.parents[module.count(".") + (file.name == "__init__.py")]
