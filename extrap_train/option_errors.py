"""What is wrong with an option of the command line, in one line that says what to give instead."""

import difflib
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

from omegaconf import OmegaConf

from extrap_train.config import dotted

Groups = Mapping[str, Sequence[type]]

_KINDS = {
    "could not be converted to Integer": "must be a whole number",
    "could not be converted to Float": "must be a number",
    "is not a valid bool": "must be true or false",
    "is not Optional": "cannot be null",
    "is not a ListConfig": "must be a list, as [1,2]",
    "is not a subclass of": "has options of its own: give those, as {key}.NAME=VALUE",
}
"""What OmegaConf says of a value that is of another type than its option."""


@dataclass(frozen=True)
class Options:
    """What a command can be told."""

    tree: type
    """Dataclass of all its options."""
    groups: Groups
    """Variants of each group that the tree has a choice of."""
    choices: Sequence[str] = ()
    """Groups of files that set options of any kind."""

    def one_line(self, error: Exception, overrides: Sequence[str]) -> str:
        """What Hydra or OmegaConf has found wrong with the words that were given."""
        text = " ".join(f"{error} {error.__cause__ or ''}".split())
        given = {word.partition("=")[0].lstrip("+~"): word for word in overrides}
        for reading in (self._unknown_choice, self._missing_choice, self._unknown, _wrong_type):
            if said := reading(text, given):
                return said
        return text

    def _unknown_choice(self, text: str, given: Mapping[str, str]) -> str | None:
        found = re.search(
            r"Could not find '(\w+)/([^']+)' Available options in '\w+': (.*?)(?= Config)", text
        )
        if not found:
            return None
        kind, value, known = found.groups()
        names = _choices(known)
        return f"{kind}={value} is unknown{_suggest(value, names)}; known: {', '.join(names)}"

    def _missing_choice(self, text: str, given: Mapping[str, str]) -> str | None:
        found = re.search(r"You must specify '(\w+)'.*?Available options:(.*)", text)
        if not found:
            return None
        said = f"{found[1]} is not given: {found[1]}={'|'.join(_choices(found[2]))}"
        strange = [key for key in given if key not in self._known()]
        for key in difflib.get_close_matches(found[1], strange, n=1):
            said += f"; there is no option {key}, did you mean {found[1]}?"
        return said

    def _unknown(self, text: str, given: Mapping[str, str]) -> str | None:
        found = re.search(r"Key '(\w+)' (?:is )?not in|Could not override '([\w.]+)'", text)
        if not found:
            return None
        name = found[1] or found[2]
        key = next((k for k in given if name in (k, k.split(".")[-1], k.split(".")[0])), name)
        if others := self._elsewhere(key):
            return f"{key} is an option of {' or '.join(others)}: give that, too, or leave it out"
        return f"there is no option {key}{_suggest(key, self._known())}; see --help"

    def _elsewhere(self, key: str) -> list[str]:
        """The choices that have an option which the choice made does not have."""
        group = key.partition(".")[0]
        variants: Sequence[Any] = self.groups.get(group, ())
        return [f"{group}={v.name}" for v in variants if key in _options_of(v, f"{group}.")]

    def _known(self) -> list[str]:
        variants = [(group, variant) for group, all_ in self.groups.items() for variant in all_]
        names = [name for group, variant in variants for name in _options_of(variant, f"{group}.")]
        return [*_options_of(self.tree), *names, *self.groups, *self.choices]


def options_of(tree: type, groups: Groups, choices: Sequence[str] = ()) -> Options:
    """Of a command with this tree, which has some of the groups."""
    own = {field.name for field in fields(tree)}
    return Options(tree, {g: variants for g, variants in groups.items() if g in own}, choices)


def _wrong_type(text: str, given: Mapping[str, str]) -> str | None:
    found = re.search(r"(?:Error merging override )?(.*) full_key: ([\w.]+)", text)
    if not found:
        return None
    reason, key = found.groups()
    word = given.get(key, key)
    kind = next((said for mark, said in _KINDS.items() if mark in reason), None)
    return f"{word}: {kind.format(key=key) if kind else reason.removeprefix(f'{word} ')}"


def _options_of(tree: type, prefix: str = "") -> list[str]:
    content: Any = OmegaConf.to_container(OmegaConf.structured(tree))
    return list(dotted(content, prefix))


def _choices(listed: str) -> list[str]:
    return [name for name in listed.split() if not name.endswith("_schema")]


def _suggest(given: str, known: Sequence[str]) -> str:
    near = difflib.get_close_matches(given, [n for n in known if n != given], n=1)
    return f"; did you mean {near[0]}?" if near else ""
