"""Text from outside as it may stand in records, reports and terminals."""

MAX_LETTERS = 300


def one_line(text: str, most: int = MAX_LETTERS) -> str:
    """Text on one line, without control characters and halves of letters, cut to `most`."""
    line = " ".join(text.split())
    if len(line) > most:
        line = line[: most - 1] + "…"
    return "".join(one if one.isprintable() else "\N{REPLACEMENT CHARACTER}" for one in line)
