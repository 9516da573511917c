"""`benchmark`: comparisons with reference implementations, and what there is to compare."""

import argparse
import importlib
import sys
from collections.abc import Sequence
from pathlib import Path

from extrap_train.config import CATEGORIES
from extrap_train.errors import InputError

PERF_NAMES = ("align", "depth", "gaussians", "sample", "train", "warp")
LISTS = {"categories": CATEGORIES}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit status."""
    options = _parser().parse_args(arguments)
    try:
        if options.command == "perf":
            _perf([options.name] if options.name else PERF_NAMES, Path(options.output))
        else:
            _list([options.kind] if options.kind else list(LISTS))
    except (InputError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="benchmark", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    perf = commands.add_parser("perf", help="time our kernels against plain implementations")
    perf.add_argument("name", nargs="?", choices=PERF_NAMES, help="default: all")
    perf.add_argument("--output", default="perf", help="folder of the CSV files (default: perf)")
    listing = commands.add_parser("list", help="what there is")
    listing.add_argument("kind", nargs="?", choices=sorted(LISTS), help="default: all")
    return parser


def _perf(names: Sequence[str], folder: Path) -> None:
    for name in names:
        # torch loads here, not for --help.
        module = importlib.import_module(f"benchmarks.perf.{name}")
        timing = importlib.import_module("benchmarks.perf.timing")
        rows = module.run()
        timing.print_rows(rows)
        timing.write_rows(rows, folder / f"{name}.csv")
        print(f"written to {folder / f'{name}.csv'}")


def _list(kinds: Sequence[str]) -> None:
    for kind in kinds:
        print(f"{kind}: {' '.join(LISTS[kind])}")


if __name__ == "__main__":
    sys.exit(main())
