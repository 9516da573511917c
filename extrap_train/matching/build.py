"""A matcher from its options."""

from extrap_train.config import FlowMatcherConfig, MatcherConfig
from extrap_train.errors import InputError
from extrap_train.matching import Matcher
from extrap_train.matching.flow import FlowMatcher


def matcher(config: MatcherConfig) -> Matcher:
    """The matcher that the type of `config` stands for."""
    match config:
        case FlowMatcherConfig():
            return FlowMatcher(config)
        case _:
            raise InputError(f"matcher={config.name}: unknown; choose flow")
