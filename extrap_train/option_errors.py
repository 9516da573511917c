"""What is wrong with an option where only the composed configuration shows it, in one line."""

import re
from collections.abc import Sequence

from hydra.errors import MissingConfigException
from omegaconf.errors import ConfigKeyError, OmegaConfBaseException, ValidationError

from extrap_train.command_options import CommandOptions, suggest


def explain(error: Exception, options: CommandOptions, overrides: Sequence[str]) -> str:
    """What Hydra or OmegaConf has found, in our words where it is about an option or a choice."""
    if isinstance(error, MissingConfigException) and "/" in (error.missing_cfg_file or ""):
        group, _, name = str(error.missing_cfg_file).rpartition("/")
        known = [known for known in error.options or () if not known.endswith("_schema")]
        return f"{group}={name} is unknown{suggest(name, known)}; known: {', '.join(known)}"
    cause = error if isinstance(error, OmegaConfBaseException) else error.__cause__
    if isinstance(cause, OmegaConfBaseException) and cause.full_key:
        key = re.sub(r"\[\d+\]$", "", cause.full_key)
        if isinstance(cause, ValidationError) and key in options.known:
            return _wrong_value(key, cause, options, overrides)
        if isinstance(cause, ConfigKeyError | AttributeError):
            return unknown_option(key, options)
    return " ".join(str(error).split("\n")[0].split())


def unknown_option(key: str, options: CommandOptions) -> str:
    """What to do instead of giving it: choose what has it, or mend its name."""
    if variants := options.variants_with(key):
        return f"{key} is an option of {' or '.join(variants)}: give that, too, or leave it out"
    return f"there is no option {key}{options.suggest(key)}; see --help"


def _wrong_value(
    key: str, cause: ValidationError, options: CommandOptions, overrides: Sequence[str]
) -> str:
    option = options.known[key]
    given = next((word for word in overrides if word.startswith(f"{key}=")), key)
    if given == f"{key}=null" and not option.may_be_null:
        return f"{given}: cannot be null"
    value_is_list = given.startswith(f"{key}=[")
    if option.is_list and value_is_list:
        return f"{given}: every value {option.item_must_be}"
    return f"{given}: {option.must_be}"
