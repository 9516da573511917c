"""`--help`: tasks, choices, and one line per option with its default, meaning, unit and range."""

from collections.abc import Iterable, Iterator, Sequence
from typing import Any

from extrap_train.command_options import CommandOptions, choices_of
from extrap_train.config import MISSING, Option, options_of

_HEAD = """\
Usage: {program} category=NAME [GROUP=CHOICE ...] [OPTION=VALUE ...] [FLAG ...]
"""
_TAIL = """\
Text is taken as typed. Quote it for the shell if it holds blanks or signs: 'scene=my scene (1)'.
Two cases need quotes inside as well, as in {quoted}: a value that begins and
ends with quotes of its own, and with -m one that holds a comma.

Flags:
  -m, --multirun      run every combination of values with commas between them: seed=0,1,2
  --config-dir DIR    folder with choices of your own, as DIR/category/vase.yaml
  --version           print the version
  --hydra-help        flags of Hydra, which composes the options
"""


_WIDEST = 44


def help_text(options: CommandOptions, own_folders: Sequence[str] = ()) -> str:
    """The whole page."""
    parts = [_HEAD.format(program=options.program)]
    if options.tasks:
        parts.append("Tasks:\n" + _rows(options.tasks.items()))
    groups = [*options.groups, *options.file_groups]
    choices = [(f"{group}=", " | ".join(choices_of(group, own_folders))) for group in groups]
    choices.append(("matcher@depth.matcher=", "the matcher of depth=monocular: depth.matcher.NAME"))
    parts.append("Choices:\n" + _rows(choices))
    for title, found in _sections(options):
        parts.append(f"{title}:\n" + _rows(map(_row, found)))
    parts.append(_TAIL.format(quoted="""'scene="a,b"'"""))
    return "\n".join(parts)


def option_rows(tree: type) -> str:
    """A line for every option of a tree."""
    return _rows(_row(option) for option in options_of(tree).values() if option.declared.help)


def _sections(options: CommandOptions) -> Iterator[tuple[str, list[Option]]]:
    """Options of the command itself, of each of its parts, and of each variant of a group."""
    own = options_of(options.tree)
    parts: dict[str, list[Option]] = {}
    for name, option in own.items():
        part = name.rpartition(".")[0]
        if part.partition(".")[0] not in options.groups:
            parts.setdefault(part, []).append(option)
    for part, found in parts.items():
        yield (f"Options of {part}" if part else "Options"), found
    for group, variants in options.groups.items():
        for variant in variants:
            listed = [o for o in options_of(variant, f"{group}.").values() if o.declared.help]
            own_values = f"{group} ({group}= sets values of its own)"
            chosen = f"{group}={variant.name}" if len(variants) > 1 else own_values  # type: ignore[attr-defined]
            if listed:
                yield f"Options of {chosen}", listed


def _row(option: Option) -> tuple[str, str]:
    limits = ", ".join(filter(None, [option.declared.unit, *_limits(option)]))
    return f"{option.name}={_shown(option.default)}", option.declared.help + (
        f" ({limits})" if limits else ""
    )


def _limits(option: Option) -> list[str]:
    return [" | ".join(option.declared.known)] if option.declared.known else [option.range]


def _shown(value: Any) -> str:
    if value is None or isinstance(value, bool):
        return str(value).lower().replace("none", "null")
    if isinstance(value, list):
        return f"[{','.join(map(_shown, value))}]"
    return "" if value == MISSING else f"{value}"


def _rows(rows: Iterable[tuple[str, str]]) -> str:
    listed = list(rows)
    width = min(_WIDEST, max(len(name) for name, _ in listed))
    return "".join(f"  {name:<{width}}  {meaning}\n" for name, meaning in listed)
