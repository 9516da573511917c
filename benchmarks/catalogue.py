"""What there is to compare: tables and methods as YAMLs, the package's and one's own.

Light on purpose (no torch): `benchmark list` and `--help` answer at once.
"""

import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar, cast

import yaml
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from pydantic import TypeAdapter, ValidationError

import conf
from extrap_train.config import MethodConfig, TableConfig, dotted
from extrap_train.errors import InputError, did_you_mean
from extrap_train.store.records import read_yaml

T = TypeVar("T")


@dataclass(frozen=True)
class Catalogue:
    """The YAMLs of some folders; a later folder's file wins over an earlier one's of that name."""

    folders: tuple[Path, ...]

    @classmethod
    def with_own(cls, own: Sequence[str] = ()) -> "Catalogue":
        """The package's, and those of one's own folders, which may be imported from as well."""
        folders = [Path(name).resolve() for name in own]
        for folder in folders:
            if not folder.is_dir():
                raise InputError(f"--config-dir {folder}: no such folder")
            # Beside the YAMLs lies the method's file; worker processes find it there, too.
            sys.path.insert(0, str(folder))
        if folders:
            paths = [*map(str, folders), *filter(None, [os.environ.get("PYTHONPATH")])]
            os.environ["PYTHONPATH"] = os.pathsep.join(paths)
        return cls((Path(conf.__path__[0]), *folders))

    def names(self, kind: str) -> list[str]:
        """Names of the `table`s or `method`s."""
        return sorted(
            {file.stem for folder in self.folders for file in (folder / kind).glob("*.yaml")}
        )

    def method(self, name: str) -> MethodConfig:
        """A method by name."""
        return _typed(MethodConfig, name, self._file("method", name), [])

    def table(self, name: str, overrides: Sequence[str] = ()) -> TableConfig:
        """A table by name, with `key=value` on top."""
        return _typed(TableConfig, name, self._file("table", name), overrides)

    def reported(self, name: str) -> dict[str, Any]:
        """Published numbers by name: `source`, and `rows` of method, views, metric and value."""
        return read_yaml(self._file("reported", name), "correct it")

    def _file(self, kind: str, name: str) -> Path:
        for folder in reversed(self.folders):
            if (file := folder / kind / f"{name}.yaml").is_file():
                return file
        raise InputError(f"{kind} {name!r} is unknown; {did_you_mean(name, self.names(kind))}")


def _typed(kind: type[T], name: str, file: Path, overrides: Sequence[str]) -> T:
    """The file over the dataclass's defaults, the overrides over both; nothing in them is
    interpolated.
    """
    wrong = [word for word in overrides if "=" not in word]
    if wrong:
        raise InputError(f"{wrong[0]!r} is no key=value")
    try:
        content = read_yaml(file, "correct it")
        given = OmegaConf.from_dotlist(list(overrides))
        merged = OmegaConf.merge(OmegaConf.structured(kind), {"name": name}, content, given)
        missing = sorted(map(str, OmegaConf.missing_keys(merged)))
        if missing:
            raise InputError(f"{file}: does not say {missing[0]}; add it")
        values = OmegaConf.to_container(merged, resolve=False)
        return TypeAdapter(kind).validate_python(values)
    except InputError:
        raise
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        reason = f"{'.'.join(map(str, first['loc']))}: {first['msg']}"
        raise InputError(f"{' '.join([str(file), *overrides])}: {reason}") from None
    except (OmegaConfBaseException, yaml.YAMLError, ValueError) as error:
        reason = " ".join(str(error).splitlines()[:1])
        raise InputError(f"{_blame(kind, file, overrides)}: {reason}") from None


def _blame(kind: type[Any], file: Path, overrides: Sequence[str]) -> str:
    """The override whose key does not exist, with a suggestion, or else where it all stands."""
    known = list(dotted(cast(dict[str, Any], OmegaConf.to_container(OmegaConf.structured(kind)))))
    for word in overrides:
        key = word.partition("=")[0]
        if key not in known and not key.startswith(("options.", "scoring.lpips_weights")):
            return f"there is no option {key}; {did_you_mean(key, known)}"
    return " ".join([str(file), *overrides])
