"""Groups of the reasons for which sequences were dropped: numbers and paths do not matter."""

import re
from collections.abc import Iterable
from dataclasses import dataclass

_PATH = re.compile(r"(?<!\S)/[^:;]+")
"""An absolute path, to the colon that ends it: a message goes on behind it."""
_NUMBER = re.compile(r"[0-9]+([.,][0-9]+)*")


@dataclass(frozen=True)
class ReasonGroup:
    """Reasons that are the same but for numbers and paths."""

    count: int
    example: str
    """The first of them."""
    differ: bool
    """Whether they are not all the same."""

    @property
    def short(self) -> str:
        """With # for the numbers; one that names files as it is: a path with # leads nowhere."""
        if _PATH.search(self.example):
            return f"for instance {self.example}" if self.differ else self.example
        return _NUMBER.sub("#", self.example)

    @property
    def counted(self) -> str:
        """How often, and the first."""
        times = "once" if self.count == 1 else f"{self.count} times"
        return f"{times}, for instance {self.example}" if self.differ else f"{times} {self.example}"


def group_reasons(reasons: Iterable[str]) -> list[ReasonGroup]:
    """Groups of equal reasons, the most frequent first."""
    members: dict[str, list[str]] = {}
    for reason in reasons:
        members.setdefault(_NUMBER.sub("#", _PATH.sub("/", reason)), []).append(reason)
    groups = [ReasonGroup(len(same), same[0], len({*same}) > 1) for same in members.values()]
    return sorted(groups, key=lambda group: -group.count)
