"""Where a run's metrics, options and sample sheets go beside its own files: `logger=`."""

import logging
import os
import urllib.error
import urllib.request
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from http.client import HTTPException
from importlib.util import find_spec
from netrc import NetrcParseError, netrc
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit
from uuid import uuid4

import yaml
from hydra.core.hydra_config import HydraConfig
from lightning.pytorch.loggers import Logger, MLFlowLogger, TensorBoardLogger, WandbLogger
from PIL import Image
from torchvision.transforms.functional import pil_to_tensor

from extrap_train.config import TrainConfig
from extrap_train.errors import InputError
from extrap_train.processes import is_first
from extrap_train.runs import RunFolder, in_sweep
from extrap_train.store.atomic import write_atomic
from extrap_train.store.manifest import REMEDY
from extrap_train.store.records import read_yaml
from extrap_train.terminal import terminal

_PROJECT = "extrap-train"
_PACKAGES = ("wandb", "mlflow")
_WANDB_HOST = "https://api.wandb.ai"
_ANSWERS_WITHIN_S = 5.0
_MAX_GROUP = 128
"""Letters of a group's name at Weights & Biases."""


def require_logger(name: str) -> None:
    """InputError where the chosen logger's package is not installed."""
    if name in _PACKAGES and find_spec(name) is None:
        raise InputError(
            f'logger={name} needs {name}: pip install "extrap-train[tracking]", or leave it out'
        )


@contextmanager
def open_logger(config: TrainConfig, folder: RunFolder) -> Iterator[list[Logger]]:
    """The chosen logger of a run that has its `config.yaml`, told of these options.

    There is none for `csv`, nor in processes that the first one speaks for.

    A resumed run goes on where it was logged before. A job of a sweep is logged by the sweep's
    folder and its number there.
    """
    if not is_first():
        yield []
        return
    options = read_yaml(folder.options, REMEDY)
    if config.logger.name == "wandb":
        with _opened_wandb(folder, options) as logger:
            yield [logger]
    elif config.logger.name == "mlflow":
        with _opened_mlflow(folder, options, Path(config.output)) as logger:
            yield [logger]
    elif config.logger.name == "tensorboard":
        board = TensorBoardLogger(folder.path, name="", version="tensorboard")
        board.experiment.add_text("options", f"```\n{yaml.safe_dump(options, sort_keys=False)}```")
        yield [board]
    else:
        yield []


def log_sheet(loggers: list[Logger], file: Path, step: int) -> None:
    """Show a sample sheet wherever the run is logged."""
    for logger in loggers:
        if isinstance(logger, WandbLogger):
            logger.log_image("samples", [str(file)], step)
        elif isinstance(logger, MLFlowLogger):
            logger.experiment.log_artifact(str(logger.run_id), str(file), "samples")
        elif isinstance(logger, TensorBoardLogger):
            with Image.open(file) as picture:
                logger.experiment.add_image("samples", pil_to_tensor(picture), step)


def _names(folder: RunFolder) -> tuple[str, Mapping[str, str]]:
    """What a run is called, and its sweep and job if it is one of a sweep's."""
    if not in_sweep():
        return folder.path.name, {}
    hydra = HydraConfig.get()
    place, job = Path(hydra.sweep.dir), str(hydra.job.num)
    return f"{place.name} job {job}", {"sweep": str(place), "job": job}


@contextmanager
def _opened_wandb(folder: RunFolder, options: Mapping[str, Any]) -> Iterator[WandbLogger]:
    import wandb

    name, tags = _names(folder)
    note = _id_file(folder, "wandb")
    if not note.is_file():
        write_atomic(note, uuid4().hex[:8].encode())
    offline = _why_offline()
    try:
        run = wandb.init(
            project=os.environ.get("WANDB_PROJECT", _PROJECT),
            dir=folder.path,
            id=note.read_text(),
            resume="allow",
            name=name,
            group=tags["sweep"][-_MAX_GROUP:] if tags else None,
            config={**options, **tags},
            mode="offline" if offline else None,
            settings=wandb.Settings(console="off", silent=True),
        )
    except (wandb.Error, ValueError) as error:
        raise InputError(
            f"logger=wandb: {' '.join(str(error).split())}; mend that, or set WANDB_MODE=offline"
        ) from None
    place = Path(run.dir).parent
    said = f"offline ({offline}); wandb sync {place} uploads it" if offline else run.url or place
    terminal().print(f"wandb: {said}")
    run.define_metric("*", step_metric="trainer/global_step")  # a resumed run's own count goes on
    try:
        yield WandbLogger(experiment=run)
    except BaseException:
        run.finish(exit_code=1)
        raise
    run.finish()


def _why_offline() -> str | None:
    """Why Weights & Biases cannot be reached; None where it can, or WANDB_MODE decides that."""
    if "WANDB_MODE" in os.environ:
        return None
    host = os.environ.get("WANDB_BASE_URL", _WANDB_HOST)
    if "WANDB_API_KEY" not in os.environ and not _has_login(urlsplit(host).hostname or ""):
        return "no WANDB_API_KEY, no login"
    return _silence_of(host)


def _silence_of(address: str) -> str | None:
    """Why a server does not answer; None where it does, whatever it says."""
    try:
        urllib.request.urlopen(address, timeout=_ANSWERS_WITHIN_S).close()
    except urllib.error.HTTPError:
        return None
    except (OSError, ValueError, HTTPException) as error:
        return f"no answer from {address}: {getattr(error, 'reason', error)}"
    return None


def _has_login(host: str) -> bool:
    """Whether `wandb login` has left a key for this host."""
    try:
        return netrc(os.environ.get("NETRC")).authenticators(host) is not None
    except (OSError, NetrcParseError):
        return False


@contextmanager
def _opened_mlflow(
    folder: RunFolder, options: Mapping[str, Any], output: Path
) -> Iterator[MLFlowLogger]:
    """At MLFLOW_TRACKING_URI, or in a database beside all results, `mlflow.db`."""
    from mlflow.exceptions import MlflowException

    for noisy in ("mlflow", "alembic"):
        logging.getLogger(noisy).setLevel(logging.WARNING)
    output.mkdir(parents=True, exist_ok=True)
    given = os.environ.get("MLFLOW_TRACKING_URI")
    if given and given.startswith("http") and (silence := _silence_of(given)):
        # MLflow itself would try for minutes.
        raise InputError(f"logger=mlflow: {silence}; start it, or mend MLFLOW_TRACKING_URI")
    place = given or f"sqlite:///{output.resolve() / 'mlflow.db'}"
    name, tags = _names(folder)
    note = _id_file(folder, "mlflow")
    try:
        logger = MLFlowLogger(
            os.environ.get("MLFLOW_EXPERIMENT_NAME", _PROJECT),
            run_name=name,
            tracking_uri=place,
            tags=dict(tags),
            artifact_location=None if given else (output.resolve() / "mlflow").as_uri(),
            run_id=note.read_text() if note.is_file() else None,
        )
        run = str(logger.run_id)
        if not note.is_file():  # MLflow's options of a run are for good
            logger.log_hyperparams(dict(options))
            write_atomic(note, run.encode())
        terminal().print(f"mlflow: run {run} in {place}")
        yield logger
    except MlflowException as error:
        raise InputError(
            f"logger=mlflow: {place}: {' '.join(str(error).split())}; mend MLFLOW_TRACKING_URI, or "
            f"delete {note} to log another run, and run the same command again to resume"
        ) from None


def _id_file(folder: RunFolder, name: str) -> Path:
    """Holds the id under which the run is logged, which a resumed one goes on with."""
    return folder.path / f".{name}_run"
