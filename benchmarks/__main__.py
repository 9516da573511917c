"""`benchmark`: comparison tables of methods, and our kernels against reference implementations."""

import argparse
import importlib
import sys
from collections.abc import Callable, Sequence
from importlib.metadata import version
from pathlib import Path

from benchmarks.catalogue import Catalogue, lpips_weights_of, require_only_output
from extrap_train.command_line import option_rows
from extrap_train.config import TableConfig
from extrap_train.errors import Ended, InputError, ends_in_one_line

PERF_NAMES = ("align", "average", "gaussians", "prep", "sample", "stereo", "train", "warp")
KINDS = ("methods", "tables", "categories")
FORMATS = ("csv", "md", "latex", "html")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit status."""
    options = _parse_arguments(arguments)
    try:
        with ends_in_one_line():
            return _run_command(options)
    except Ended as end:
        return end.code


def _run_command(options: argparse.Namespace) -> int:
    try:
        status: int = options.run(options)
    except BrokenPipeError:
        raise
    except OSError as error:
        raise InputError(" ".join(str(error).split())) from error
    return status


def _parse_arguments(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Overrides may stand before, between and after the options."""
    parser = _parser()
    options, rest = parser.parse_known_args(arguments)
    strange = [word for word in rest if word.startswith("-") or "overrides" not in options]
    if strange:
        parser.error(f"unrecognized arguments: {' '.join(strange)}")
    if rest:
        options.overrides = [*options.overrides, *rest]
    return options


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="benchmark", description=__doc__)
    parser.add_argument(
        "--version", action="version", version=f"extrap-train {version('extrap-train')}"
    )
    commands = parser.add_subparsers(dest="command", required=True)

    def command(
        name: str, run: Callable[[argparse.Namespace], int], text: str
    ) -> argparse.ArgumentParser:
        sub = commands.add_parser(name, help=text, description=text)
        sub.set_defaults(run=run)
        return sub

    def with_table(sub: argparse.ArgumentParser) -> None:
        sub.add_argument("table", help="a name of `benchmark list tables`")
        sub.add_argument("overrides", nargs="*", metavar="key=value", help="e.g. methods=[ours]")
        sub.formatter_class = argparse.RawDescriptionHelpFormatter
        sub.epilog = (
            f"options of a table, each table with values of its own:\n{option_rows(TableConfig)}"
        )
        _add_config_dir(sub)

    listing = command("list", _list, "list methods, tables and categories")
    listing.add_argument("kind", nargs="?", choices=KINDS, help="default: all")
    _add_config_dir(listing)
    run = command("run", _run, "run a table: finished cells are reused, failed ones tried again")
    with_table(run)
    run.add_argument(
        "--quick",
        action="store_true",
        help="only the part that the table's options under quick keep",
    )
    run.add_argument("--dry-run", action="store_true", help="say what would run, and how long")
    where = run.add_mutually_exclusive_group()
    where.add_argument("--workers", type=_positive, default=0, metavar="N", help="default: cores")
    where.add_argument(
        "--slurm",
        action="store_true",
        help="as a SLURM job array; slurm.partition=NAME and the like",
    )
    report = command("report", _report, "write a table's reports again")
    with_table(report)
    report.add_argument("--format", choices=FORMATS, help="default: all")
    verify = command("verify", _verify, "compute every number again from the saved images")
    verify.add_argument("results", help="folder of a table's results")
    verify.add_argument(
        "overrides",
        nargs="*",
        metavar="scoring.lpips_weights.NET=FILE",
        help="files of weights on this machine",
    )
    _add_config_dir(verify)
    compare = command("compare", _compare, "compare two results of one protocol, with intervals")
    compare.add_argument("before", help="folder of a table's results")
    compare.add_argument("after", help="folder of a table's results")
    perf = command("perf", _perf, "time our kernels against plain implementations")
    perf.add_argument("name", nargs="?", choices=PERF_NAMES, help="default: all")
    perf.add_argument(
        "--end-to-end",
        action="store_true",
        help="with train: a whole step, from the stored frames to the averaged weights",
    )
    perf.add_argument("--output", default="perf", help="folder of the CSV files (default: perf)")
    return parser


def _add_config_dir(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--config-dir",
        action="append",
        default=[],
        metavar="DIR",
        help="folder with your own method/, table/, metric/, depth/, matcher/ and Python files",
    )


def _positive(text: str) -> int:
    if not text.isdigit() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text} is not a positive number")
    return int(text)


def _list(options: argparse.Namespace) -> int:
    catalogue = Catalogue.with_own(options.config_dir)
    for kind in [options.kind] if options.kind else KINDS:
        if kind == "categories":
            print(f"categories: {' '.join(catalogue.categories())}")
            continue
        print(f"{kind}:")
        for name in catalogue.names(kind.removesuffix("s")):
            print(f"  {name:<20} {_description(catalogue, kind, name)}")
    return 0


def _description(catalogue: Catalogue, kind: str, name: str) -> str:
    content = catalogue.content(kind.removesuffix("s"), name)
    if kind == "tables":
        return f"{content.get('title', '')}: {', '.join(content.get('methods', ()))}"
    needs = content.get("needs")
    return content.get("title", "") + (f" (needs {needs})" if needs else "")


# Below, torch is imported by the functions that need it.


def _run(options: argparse.Namespace) -> int:
    catalogue = Catalogue.with_own(options.config_dir)
    table = catalogue.table(options.table, options.overrides)
    catalogue.check(table)  # before anything heavy loads
    from benchmarks.run_table import RunOptions, run_table
    from extrap_train.jobs.slurm import slurm_launcher

    logs = Path(table.output) / table.name / "slurm"
    cluster = slurm_launcher(table.slurm, logs) if options.slurm else None
    run = RunOptions(options.quick, options.dry_run, options.workers, cluster)
    failed = run_table(table, catalogue, run)
    if failed:
        print(f"{failed} cells have failed; the same command tries them again", file=sys.stderr)
    return 1 if failed else 0


def _report(options: argparse.Namespace) -> int:
    catalogue = Catalogue.with_own(options.config_dir)
    require_only_output(options.overrides)
    table = catalogue.table(options.table, options.overrides)
    from benchmarks.report import lay_out_results, write_reports
    from benchmarks.report.aggregate import read_results
    from benchmarks.run.plan import TableFolder

    folder = TableFolder(Path(table.output) / table.name)
    formats = (options.format,) if options.format else FORMATS
    results = read_results(folder)
    for path in write_reports(results, lay_out_results(results, catalogue), folder, formats):
        print(f"written: {path}")
    return 0


def _verify(options: argparse.Namespace) -> int:
    Catalogue.with_own(options.config_dir)  # metrics are imported from there
    weights = lpips_weights_of(options.overrides)
    from benchmarks.report.verify import verify
    from benchmarks.run.plan import TableFolder

    found = verify(TableFolder(Path(options.results)), weights)
    for line in [*found.problems, *(f"{c}: not checked: {r}" for c, r in found.unchecked.items())]:
        print(line, file=sys.stderr)
    if found.problems:
        print(f"error: {len(found.problems)} mismatches in {options.results}", file=sys.stderr)
        return 1
    rest = f" but {', '.join(found.unchecked)}" if found.unchecked else ""
    print(
        f"{found.cells} cells verified: every metric{rest} follows from the saved images, and "
        "every row from its table; times and memory cannot be checked"
    )
    return 0


def _compare(options: argparse.Namespace) -> int:
    from benchmarks.report.aggregate import read_results
    from benchmarks.report.compare import compare
    from benchmarks.run.plan import TableFolder

    before, after = (TableFolder(Path(name)) for name in (options.before, options.after))
    table = compare(read_results(before), read_results(after))
    print(table.to_string(index=False, float_format=lambda value: f"{value:.4f}"))
    if (table["scoring"] == "other").any():
        print(
            "note: where scoring is `other`, both were scored with other weights, options or code: "
            "a change may be of the scoring, not of the method",
            file=sys.stderr,
        )
    return 0


def _perf(options: argparse.Namespace) -> int:
    names = [options.name] if options.name else list(PERF_NAMES)
    if options.end_to_end:
        if options.name != "train":
            raise InputError("--end-to-end is of `benchmark perf train`; name that or leave it out")
        names = ["end_to_end"]
    for name in names:
        module = importlib.import_module(f"benchmarks.perf.{name}_timing")
        timing = importlib.import_module("benchmarks.perf.timing")
        rows = module.run()
        timing.print_rows(rows)
        file = Path(options.output) / f"{name}.csv"
        timing.write_rows(rows, file)
        print(f"written to {file}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
