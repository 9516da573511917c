"""What images and scores follow from: the two manifests whose digests name a cell.

The code that a manifest states is a digest of whole folders of sources, because the version of a
checkout does not tell two edited ones apart. Reports have no part in it.

A method that is not ours says what its images follow from in a process of its own, as it makes
them: nothing that its module does when it is imported reaches the process that holds the truths.
"""

import hashlib
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path

from pydantic import TypeAdapter, ValidationError

from benchmarks.methods.base import Method, Unavailable
from benchmarks.protocol.prepared_scene import Scene
from benchmarks.run.cells import one_line
from benchmarks.run.run_method import build_method, weight_paths
from extrap_train.config import MethodConfig, RulesConfig, ScoringConfig
from extrap_train.config.options import dotted
from extrap_train.errors import InputError
from extrap_train.factories import module_file
from extrap_train.jobs import Died
from extrap_train.jobs.isolated import IsolatedLauncher
from extrap_train.metrics import BACKBONES, hub_cache
from extrap_train.store.digests import file_digest, json_digest
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
    return json_digest([identity_of(made_from), identity_of(scored_from)])[:KEY_LENGTH]


def identity_of(manifest: Manifest) -> str:
    """Digest of what a manifest's differences are about."""
    return json_digest([dict(manifest.options), dict(manifest.inputs)])


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


MISSING_WEIGHTS = "missing: "
"""Prefix of the reason that stands instead of the digest of weights that nobody knows."""
_OURS = "benchmarks."


@dataclass(frozen=True)
class MethodContent:
    """Digests that name a method's cells."""

    weights: Mapping[str, str]
    """By category; `MISSING_WEIGHTS` and the reason where there is none."""
    code: str


_CONTENTS = TypeAdapter(MethodContent)
_REFUSED = b"refused: "
"""What an answer begins with that says why the table cannot be made as it was asked for."""


def method_contents(
    configs: Sequence[MethodConfig], categories: Iterable[str], isolated: IsolatedLauncher
) -> dict[str, MethodContent]:
    """By name, the content of each method for some categories; InputError for options or a factory
    that do not fit. A method whose own code fails here fails again when its images are made.
    """
    wanted = tuple(sorted(categories))
    found = {config.name: _describe(config, wanted) for config in configs if is_ours(config)}
    asked = [(config, wanted) for config in configs if not is_ours(config)]
    for index, answer in [*isolated.run(_describe_apart, asked)]:  # all end before one is refused
        found[asked[index][0].name] = _read_answer(answer, wanted)
    return found


def is_ours(config: MethodConfig) -> bool:
    """Whether a method comes with the project, so that it may be imported anywhere."""
    return config.factory.startswith(_OURS)


def _describe(config: MethodConfig, categories: Sequence[str]) -> MethodContent:
    method = build_method(config)
    try:
        weights = {category: _weights_digest(method, category) for category in categories}
    except InputError as error:
        raise InputError(f"method {config.name}: {error}") from None
    return MethodContent(weights, making_code(type(method).__module__))


def _failed(reason: str, categories: Sequence[str]) -> MethodContent:
    return MethodContent(dict.fromkeys(categories, MISSING_WEIGHTS + reason), making_code())


def _describe_apart(asked: tuple[MethodConfig, tuple[str, ...]]) -> bytes:
    """The same in a process of its own: what the method's code raises is a part of the answer."""
    config, categories = asked
    try:
        found = _describe(config, categories)
    except InputError as error:
        return _REFUSED + str(error).encode(errors="replace")
    except BaseException as error:  # SystemExit and KeyboardInterrupt are its own, too
        found = _failed(one_line(f"{type(error).__name__}: {error}"), categories)
    return _CONTENTS.dump_json(found)


def _read_answer(answer: bytes | Died, categories: Sequence[str]) -> MethodContent:
    if isinstance(answer, Died):
        return _failed(answer.reason, categories)
    if answer.startswith(_REFUSED):
        raise InputError(one_line(answer.removeprefix(_REFUSED).decode(errors="replace"), 2000))
    try:
        found = _CONTENTS.validate_json(answer, strict=True)
    except ValidationError:
        return _failed("what it says of its weights cannot be read", categories)
    if found.weights.keys() != {*categories}:
        return _failed("what it says of its weights cannot be read", categories)
    return found


def _weights_digest(method: Method, category: str) -> str:
    """Digest of a method's weight files, in their order; where they lie does not matter."""
    try:
        files = weight_paths(method, category)
    except Unavailable as error:
        return f"{MISSING_WEIGHTS}{error}"  # once they are there, the cell is another
    return hashlib.sha256("".join(map(file_digest, files)).encode()).hexdigest()
