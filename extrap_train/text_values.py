"""Text on a command line, before a parser takes it for a number, a list or a mapping."""

import json
from collections.abc import Sequence

from extrap_train.config import options_of

_ENTRIES_ARE_TEXT = "scoring.lpips_weights."


def yaml_words(words: Sequence[str], tree: type) -> list[str]:
    """`key=value` words whose values, read as YAML, are what was typed where `tree` wants text."""
    known = options_of(tree)
    found = []
    for word in words:
        key, _, value = word.partition("=")
        option = known.get(key)
        is_text = option.kind is str if option else key.startswith(_ENTRIES_ARE_TEXT)
        is_list = option is not None and option.is_list
        if is_text and is_list and value.startswith("["):
            parts = [part.strip() for part in split_at_commas(value[1:-1])]
            value = f"[{','.join(_yaml_text(part) for part in parts if part)}]"
        elif is_text and not is_list and value not in ("", "null"):
            value = _yaml_text(value)
        found.append(f"{key}={value}" if "=" in word else word)
    return found


def _yaml_text(text: str) -> str:
    is_quoted = len(text) > 1 and text[0] == text[-1] and text[0] in "\"'"
    return text if is_quoted else json.dumps(text)


def split_at_commas(text: str, *, lists: bool = False) -> list[str]:
    """The parts between commas that stand in no quotes, nor, of `lists`, in their brackets."""
    parts, depth, quote, start = [], 0, "", 0
    for at, letter in enumerate(text):
        if quote:
            quote = "" if letter == quote else quote
        elif letter in "\"'" and not text[start:at].strip():
            quote = letter  # one within a word, as in it's, is a letter
        elif lists and letter in "[]":
            depth += 1 if letter == "[" else -1
        elif letter == "," and depth == 0:
            parts.append(text[start:at])
            start = at + 1
    return [*parts, text[start:]]
