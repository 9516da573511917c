"""What a method's images follow from besides its options: its weights and its code.

A method that is not ours says so in a process of its own, as it makes its images: nothing that its
module does when it is imported reaches the process that holds the truths and scores.
"""

import hashlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from pydantic import TypeAdapter, ValidationError

from benchmarks.methods.base import Method, Unavailable
from benchmarks.run.cells import one_line
from benchmarks.run.identity import making_code
from benchmarks.run.run_method import build_method, weight_paths
from extrap_train.config import MethodConfig
from extrap_train.errors import InputError
from extrap_train.jobs import Died
from extrap_train.jobs.isolated import IsolatedLauncher
from extrap_train.store.digests import file_digest

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
