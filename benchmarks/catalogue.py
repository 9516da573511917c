"""What there is to compare: tables and methods as YAMLs, the package's and the user's own.

Light on purpose (no torch): `benchmark list` and `--help` answer at once.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

import conf
from extrap_train.command_line import CommandLine, CommandOptions, choices_of, open_own_folders
from extrap_train.config import (
    LPIPS_NETS,
    METRICS,
    CapturesConfig,
    DatasetDepthConfig,
    DepthConfig,
    MethodConfig,
    MetricConfig,
    TableConfig,
    check_options,
)
from extrap_train.errors import InputError, did_you_mean
from extrap_train.store.records import read_yaml

_NAMED_CAPTURES = ("captures.categories=", "captures.scenes=", "captures.source=")
TABLE = CommandOptions("benchmark run", "benchmark", TableConfig, {})


@dataclass(frozen=True)
class Catalogue:
    """The package's YAMLs and those of own folders, of which the last one wins."""

    own: tuple[str, ...] = ()

    @classmethod
    def with_own(cls, own: Sequence[str] = ()) -> "Catalogue":
        """With own folders, which methods are imported from, in worker processes, too."""
        return cls(tuple(open_own_folders(own)))

    def names(self, kind: str) -> list[str]:
        """Names of the `table`s, `method`s or `reported` numbers."""
        return choices_of(kind, self.own)

    def categories(self) -> list[str]:
        """Names of the single categories, without the choices that are several."""
        names = self.names("category")
        return [n for n in names if len(self.content("category", n).get("members", ())) == 1]

    def content(self, kind: str, name: str) -> dict[str, Any]:
        """A YAML's content; raises InputError for an unknown name.

        A table that `extends` another one has what it does not say itself from there.
        """
        content = self._read(kind, name)
        chain = [name]
        while kind == "table" and (base := content.pop("extends", None)):
            if base in chain:
                raise InputError(f"table {name}: extends itself ({' > '.join([*chain, base])})")
            chain.append(str(base))
            merged = OmegaConf.merge(self._read(kind, chain[-1]), content)
            content = OmegaConf.to_container(merged)  # type: ignore[assignment]
        return content

    def _read(self, kind: str, name: str) -> dict[str, Any]:
        for folder in [*reversed(self.own), conf.__path__[0]]:
            if (file := Path(folder) / kind / f"{name}.yaml").is_file():
                return read_yaml(file, "correct it")
        raise InputError(f"{kind} {name!r} is unknown; {did_you_mean(name, self.names(kind))}")

    def method(self, name: str, options: Mapping[str, Any] | None = None) -> MethodConfig:
        """A method by name, with options that replace those of its file."""
        method = MethodConfig(**self._read_typed("method", name, MethodConfig, {"name": name}))
        method.options |= options or {}
        return method

    def metric(self, name: str) -> MetricConfig:
        """A metric of your own by name."""
        if name in METRICS:
            raise InputError(f"scoring.metrics: {name} is the package's; give yours another name")
        metric = MetricConfig(**self._read_typed("metric", name, MetricConfig, {}))
        check_options(metric, f"metric {name}: ")
        return metric

    def _read_typed(
        self, kind: str, name: str, schema: type, more: Mapping[str, Any]
    ) -> dict[str, Any]:
        """A YAML's values, of the types that a dataclass declares."""
        content = self.content(kind, name)
        try:
            typed = OmegaConf.merge(OmegaConf.structured(schema), more, content)
            values: dict[str, Any] = OmegaConf.to_container(typed, throw_on_missing=True)  # type: ignore[assignment]
        except OmegaConfBaseException as error:
            raise InputError(f"{kind} {name}: {str(error).splitlines()[0]}") from None
        return values

    def depth(self, name: str) -> DepthConfig:
        """A depth source's options by its name, as `depth=` composes them."""
        from hydra import compose, initialize_config_module
        from hydra.errors import HydraException

        from extrap_train.cli import PREP, explain, register_schemas

        register_schemas()
        words = [f"depth={name}", f"hydra.searchpath=[{','.join(f'file://{f}' for f in self.own)}]"]
        try:
            with initialize_config_module("conf", version_base="1.3"):
                composed = OmegaConf.to_object(compose("prep", words).depth)
        except (HydraException, OmegaConfBaseException) as error:
            raise InputError(f"rules.depth={name}: {explain(error, PREP, words)}") from None
        assert isinstance(composed, DepthConfig)
        if isinstance(composed, DatasetDepthConfig) and name != "dataset":
            raise InputError(
                f"rules.depth={name}: is the data set's depth under another name; give "
                "rules.depth=dataset, which marks the table as an oracle"
            )
        check_options(composed, "depth.")
        for needed in ("checkpoint", "folder"):
            if getattr(composed, needed, "not needed") is None:
                raise InputError(
                    f"rules.depth={name}: its {needed} is not given; write depth/NAME.yaml with "
                    f"`{needed}: PATH` into a folder of your own, and give rules.depth=NAME and "
                    "--config-dir (docs/benchmark.md)"
                )
        return composed

    def table(self, name: str, overrides: Sequence[str] = ()) -> TableConfig:
        """A table by name, with `key=value` on top, composed as every other command's options.

        Where captures are named there, the title and `quick.categories` of the file do not apply.
        """
        content = self.content("table", name)
        is_other = any(word.startswith(_NAMED_CAPTURES) for word in overrides)
        if is_other:
            content.get("quick", {}).pop("categories", None)
        table = _compose(name, content, overrides)
        if is_other and not any(word.startswith("title=") for word in overrides):
            table.title = f"{name} on {_named_captures(table.captures)}"
        table.scoring.own = {metric: self.metric(metric) for metric in table.scoring.metrics}
        check_options(table)
        return table

    def check(self, table: TableConfig) -> None:
        """InputError for options that exclude each other, and for names that are unknown."""
        _check_table(table)
        _require_known("columns", table.columns, [*METRICS, *table.scoring.metrics])
        _require_known("rules.depth", [table.rules.depth], choices_of("depth", self.own))
        _require_known("options", table.options, self.names("method"))
        _require_known("reported", filter(None, [table.reported]), self.names("reported"))
        for method in table.methods:
            self.method(method)


def _compose(name: str, content: dict[str, Any], overrides: Sequence[str]) -> TableConfig:
    from hydra import compose, initialize_config_module  # slow: `list` and `--help` do without
    from hydra.core.config_store import ConfigStore
    from hydra.errors import HydraException

    from extrap_train.cli import explain

    words = CommandLine((), tuple(overrides)).prepared(TABLE)
    words += ["table@_global_=chosen_table", f"name={name}"]
    store = ConfigStore.instance()
    store.store(name="benchmark_schema", node=TableConfig)
    store.store(group="table", name="chosen_table", node=content)
    try:
        with initialize_config_module("conf", version_base="1.3"):
            table: TableConfig = OmegaConf.to_object(compose("benchmark", words))  # type: ignore[assignment]
    except (HydraException, OmegaConfBaseException) as error:
        raise InputError(f"table {name}: {explain(error, TABLE, overrides)}") from None
    return table


def _named_captures(captures: CapturesConfig) -> str:
    """What a table is measured on, for its title."""
    of = captures.scenes if captures.source == "scenes" else captures.categories
    return f"{', '.join(of)} ({captures.source})"


def _check_table(table: TableConfig) -> None:
    """What one option cannot say alone."""
    rules = table.rules
    _require_known("draws", table.draws, rules.draws)
    given = table.captures.source == "reconfusion"  # its files name inputs and targets
    if rules.draws != ["given"] if given else "given" in rules.draws:
        raise InputError(
            f"rules.draws={rules.draws}: captures.source=reconfusion needs rules.draws=[given], "
            "which no other source has"
        )
    if not given and max(rules.views, default=0) >= rules.pool:
        raise InputError(
            f"rules.views={rules.views}: no target is left of rules.pool={rules.pool} frames; give "
            "smaller numbers of views"
        )


def lpips_weights_of(overrides: Iterable[str]) -> dict[str, str]:
    """Files by net: the only option of `verify`, since weights lie elsewhere on every machine."""
    weights = {}
    for word in overrides:
        key, _, file = word.partition("=")
        net = key.removeprefix("scoring.lpips_weights.")
        if net == key or not file:
            raise InputError(f"{word}: verify takes only scoring.lpips_weights.NET=FILE")
        _require_known("scoring.lpips_weights", [net], LPIPS_NETS)
        weights[net] = file
    return weights


def require_only_output(overrides: Iterable[str]) -> None:
    """InputError for other options of `report`, which shows a table as it was run."""
    for word in overrides:
        if word.partition("=")[0] != "output":
            raise InputError(f"{word}: report takes only output=FOLDER; run the table with it")


def _require_known(option: str, words: Iterable[str], known: Sequence[str]) -> None:
    for word in words:
        if word not in known:
            raise InputError(f"{option}: {word!r} is unknown; {did_you_mean(word, known)}")
