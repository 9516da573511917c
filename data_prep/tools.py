"""By what frames and corrections are made: options travel to jobs, networks stay where they run.

A network that is sent to another process takes a file descriptor a tensor along, and a job that
waits keeps them: a few jobs of MASt3R's nine hundred tensors are more than a process may have open.
"""

import os
import pickle
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TypeVar

import torch

from extrap_train.config import (
    AlikedMatcherConfig,
    DepthConfig,
    LoftrMatcherConfig,
    Mast3rConfig,
    MatcherConfig,
    MonocularConfig,
)
from extrap_train.data.paths import file_stamp
from extrap_train.depth import DepthSource
from extrap_train.depth.build import depth_source
from extrap_train.device import fastest_device
from extrap_train.matching import Matcher
from extrap_train.matching.build import matcher

Options = TypeVar("Options")
Tool = TypeVar("Tool")


@dataclass(frozen=True)
class Tools:
    """A depth source and a matcher: options, from which every process makes its own, once.

    A ready one is used as it is, and goes along with every job: none that holds a network.
    """

    depth: DepthConfig | DepthSource
    correction: MatcherConfig | Matcher | None
    """What warps are corrected with; None leaves them."""

    @property
    def depth_identity(self) -> str:
        """What decides about depth: options, and which files of weights they name."""
        return _identity(self.depth)

    @property
    def correction_identity(self) -> str:
        """What decides about corrections; empty where there are none."""
        return "" if self.correction is None else _identity(self.correction)

    def depth_source(self) -> DepthSource:
        """On the GPU of this process, where it has one."""
        return (
            _made(depth_source, self.depth) if isinstance(self.depth, DepthConfig) else self.depth
        )

    def matcher(self) -> Matcher | None:
        """On the GPU of this process, where it has one."""
        how = self.correction
        return _made(matcher, how) if isinstance(how, MatcherConfig) else how

    def default_workers(self) -> int:
        """One where a network runs on a GPU, whose memory every process would fill with another;
        else one a core."""
        networks = (Mast3rConfig, MonocularConfig, LoftrMatcherConfig, AlikedMatcherConfig)
        on_gpu = fastest_device().type == "cuda"
        if on_gpu and any(isinstance(tool, networks) for tool in (self.depth, self.correction)):
            return 1
        return len(os.sched_getaffinity(0))

    def check(self) -> None:
        """Raises InputError where weights cannot be used, without taking a GPU's memory."""
        cpu = torch.device("cpu")
        if isinstance(self.depth, DepthConfig):
            depth_source(self.depth, cpu)
        if isinstance(self.correction, MatcherConfig):
            matcher(self.correction, device=cpu)


def _identity(tool: object) -> str:
    return f"{tool!r} {[file_stamp(file) for file in weight_files(tool)]}"


def weight_files(tool: object) -> list[Path]:
    """The files of weights that a depth source or a matcher reads."""
    match tool:
        case Mast3rConfig() | LoftrMatcherConfig() | AlikedMatcherConfig():
            return [Path(tool.checkpoint or "")]
        case MonocularConfig():
            # transformers takes seconds to load: only where it is wanted.
            from extrap_train.depth.depth_anything import files_read

            return [*files_read(tool.model), *weight_files(tool.matcher)]
        case _:
            return []


def put_away() -> None:
    """Let go of what this process has made: training wants the memory."""
    _made_once.cache_clear()


def _made(make: Callable[[Options], Tool], options: Options) -> Tool:
    return _made_once(make, pickle.dumps(options))


@lru_cache(maxsize=2)
def _made_once(make: Callable[[Options], Tool], options: bytes) -> Tool:
    """By the options' bytes, because options can be changed and so cannot be looked up."""
    return make(pickle.loads(options))
