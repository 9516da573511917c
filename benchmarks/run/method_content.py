"""What a method's images follow from besides its options: its weights and its code.

A method that is not ours says so in a process of its own, as it makes its images: nothing that its
module does when it is imported reaches the process that holds the truths and scores.
"""

import hashlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

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
"""What stands in place of the digest of weights that nobody knows, before the reason."""
_OURS = "benchmarks."


@dataclass(frozen=True)
class MethodContent:
    """Digests that name a method's cells."""

    weights: Mapping[str, str]
    """By category; `MISSING_WEIGHTS` and the reason where there is none."""
    code: str


@dataclass(frozen=True)
class _Answer:
    weights: dict[str, str] = field(default_factory=dict)
    code: str = ""
    refused: str = ""
    """Why the table cannot be made as it was asked for."""
    failed: str = ""
    """How the method's own code ended."""


_ANSWERS = TypeAdapter(_Answer)


def method_contents(
    configs: Sequence[MethodConfig], categories: Iterable[str], isolated: IsolatedLauncher
) -> dict[str, MethodContent]:
    """By name, the content of each method for some categories; InputError for options or a factory
    that do not fit. A method whose own code fails here fails again when its images are made.
    """
    wanted = tuple(sorted(categories))
    asked = [(config, wanted) for config in configs if not is_ours(config)]
    ours = [config for config in configs if is_ours(config)]
    answers = {config.name: _describe(build_method(config), wanted) for config in ours}
    for index, result in isolated.run(_describe_apart, asked):
        answers[asked[index][0].name] = _read_answer(result)
    refusals = [answer.refused for answer in answers.values() if answer.refused]
    if refusals:
        raise InputError(refusals[0])
    return {config.name: _content(answers[config.name], wanted) for config in configs}


def is_ours(config: MethodConfig) -> bool:
    """Whether a method comes with the project, so that it may be imported anywhere."""
    return config.factory.startswith(_OURS)


def _content(answer: _Answer, categories: Sequence[str]) -> MethodContent:
    if not answer.failed:
        return MethodContent(answer.weights, answer.code)
    return MethodContent(dict.fromkeys(categories, MISSING_WEIGHTS + answer.failed), making_code())


def _describe(method: Method, categories: Sequence[str]) -> _Answer:
    weights = {category: _weights_digest(method, category) for category in categories}
    return _Answer(weights, making_code(type(method).__module__))


def _describe_apart(asked: tuple[MethodConfig, tuple[str, ...]]) -> bytes:
    """The same in a process of its own: what the method's code raises is a part of the answer."""
    config, categories = asked
    try:
        answer = _describe(build_method(config), categories)
    except InputError as error:
        answer = _Answer(refused=str(error))
    except BaseException as error:  # SystemExit and KeyboardInterrupt are its own, too
        answer = _Answer(failed=one_line(f"{type(error).__name__}: {error}"))
    return _ANSWERS.dump_json(answer)


def _read_answer(result: bytes | Died) -> _Answer:
    if isinstance(result, Died):
        return _Answer(failed=result.reason)
    try:
        return _ANSWERS.validate_json(result, strict=True)
    except ValidationError:
        return _Answer(failed="what it says of its weights cannot be read")


def _weights_digest(method: Method, category: str) -> str:
    """Of a method's weight files, in their order; where they lie does not matter."""
    try:
        files = weight_paths(method, category)
    except Unavailable as error:
        return f"{MISSING_WEIGHTS}{error}"  # once they are there, the cell is another
    return hashlib.sha256("".join(map(file_digest, files)).encode()).hexdigest()
