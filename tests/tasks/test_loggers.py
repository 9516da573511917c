"""Where a training is logged: each logger has the options, metrics and sheets; `metrics.csv` stays.

Weights & Biases and MLflow are the real packages, without a network.
"""

import json
import socket
from pathlib import Path
from threading import Thread

import pandas as pd
import pytest
from in_process import refused_command, run_command
from opened_runs import hydrant_config, opened
from tiny_job import TINY

from extrap_train.__main__ import main
from extrap_train.config import LoggerConfig
from extrap_train.errors import InputError
from extrap_train.tasks import loggers
from extrap_train.tasks.loggers import log_sheet, open_logger

_OPTIONS = [
    *TINY,
    "trainer.checkpoint_every=2",
    "trainer.validate_every=2",
    "validation.examples=2",
    "validation.pictures=1",
    "sampler.steps=1",
]


@pytest.fixture(autouse=True)
def _nobody_is_logged_in(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for name in ("WANDB_API_KEY", "WANDB_MODE", "WANDB_BASE_URL", "MLFLOW_TRACKING_URI"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("NETRC", str(tmp_path / "netrc"))
    for name in ("CONFIG", "CACHE", "DATA"):
        monkeypatch.setenv(f"WANDB_{name}_DIR", str(tmp_path / "wandb_own"))


def test_wandb_has_every_job_of_a_sweep_offline(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("wandb", reason="needs the extra `tracking`")
    monkeypatch.chdir(tmp_path)
    sweep = ["-m", "seed=0,1", "hydra.sweep.dir=both_seeds", "trainer.steps=2"]
    said = run_command(main, *_OPTIONS, *sweep, "logger=wandb", f"output={tmp_path}")
    assert said.count("offline (no WANDB_API_KEY") == 2
    runs = sorted(tmp_path.glob("train/hydrant/small/*/wandb/offline-run-*"))
    assert len({run.name.rpartition("-")[2] for run in runs}) == 2  # of ids
    for run in runs:
        assert len([*run.glob("files/media/images/samples*.png")]) == 1
        job = run.parents[1].name[len("seed") :][0]
        (log,) = run.glob("*.wandb")
        content = log.read_bytes()
        for word in ("both_seeds", f"both_seeds job {job}", "validation/psnr", "warmup_steps"):
            assert word.encode() in content
        assert "validation/psnr" in pd.read_csv(run.parents[1] / "metrics.csv")


def test_mlflow_goes_on_with_the_run_that_is_resumed(tmp_path: Path) -> None:
    mlflow = pytest.importorskip("mlflow", reason="needs the extra `tracking`")
    for steps in (2, 4):
        words = [*_OPTIONS, f"trainer.steps={steps}", "logger=mlflow", f"output={tmp_path}"]
        run_command(main, *words)
    client = mlflow.MlflowClient(f"sqlite:///{tmp_path / 'mlflow.db'}")
    (experiment,) = client.search_experiments(filter_string="name = 'extrap-train'")
    (run,) = client.search_runs([experiment.experiment_id])
    folder = (tmp_path / "train/hydrant/small/latest").resolve()
    assert (run.info.run_name, run.info.status) == (folder.name, "FINISHED")
    assert run.data.params["trainer/steps"] == "2"  # as it was begun
    psnr = client.get_metric_history(run.info.run_id, "validation/psnr")
    assert [metric.step for metric in psnr] == [2, 4]
    sheets = client.list_artifacts(run.info.run_id, "samples")
    assert [Path(sheet.path).name for sheet in sheets] == [
        f"step-{step:08d}.png" for step in (2, 4)
    ]
    assert (tmp_path / "mlflow").is_dir()
    table = pd.read_csv(folder / "metrics.csv")
    assert table["step"].tolist() == [2, 4]
    assert not (folder / "tensorboard").exists()


def test_a_mlflow_run_that_is_gone_is_one_line(tmp_path: Path) -> None:
    pytest.importorskip("mlflow", reason="needs the extra `tracking`")
    config = hydrant_config(tmp_path)
    config.logger = LoggerConfig("mlflow")
    folder = opened(config)
    (folder.path / ".mlflow_run").write_text("0" * 32)
    with pytest.raises(InputError, match="mlflow_run"), open_logger(config, folder):
        pass


def test_a_server_of_mlflow_that_does_not_answer_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("mlflow", reason="needs the extra `tracking`")
    config = hydrant_config(tmp_path)
    config.logger = LoggerConfig("mlflow")
    monkeypatch.setenv("MLFLOW_TRACKING_URI", "http://127.0.0.1:9")
    with (
        pytest.raises(InputError, match="MLFLOW_TRACKING_URI"),
        open_logger(config, opened(config)),
    ):
        pass


def test_a_server_that_does_not_speak_http_gives_no_answer() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:

        def answer() -> None:
            connection, _ = server.accept()
            with connection:
                connection.recv(4096)
                connection.sendall(b"what?\r\n\r\n")

        Thread(target=answer, daemon=True).start()
        said = loggers._silence_of(f"http://127.0.0.1:{server.getsockname()[1]}")
    assert "no answer" in str(said)
    assert "no answer" in str(loggers._silence_of("http://127.0.0.1:port"))


def test_tensorboard_has_options_and_sheets_and_csv_adds_nothing(tmp_path: Path) -> None:
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    config = hydrant_config(tmp_path)
    folder = opened(config)
    sheet = Path(__file__).parents[2] / "docs/pictures/table1.jpg"
    with open_logger(config, folder) as chosen:
        log_sheet(chosen, sheet, 7)
        chosen[0].finalize("success")
    events = EventAccumulator(str(folder.path / "tensorboard")).Reload()
    (picture,) = events.Images("samples")
    (options,) = events.Tensors("options/text_summary")
    assert picture.step == 7
    assert b"warmup_steps" in options.tensor_proto.string_val[0]
    config.logger = LoggerConfig("csv")
    with open_logger(config, folder) as chosen:
        assert chosen == []


def test_a_missing_package_is_named_with_its_extra(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(loggers, "find_spec", lambda name: None)
    for name in ("wandb", "mlflow"):
        said = refused_command(["category=hydrant", f"logger={name}"], tmp_path)
        assert "extrap-train[tracking]" in said


def test_wandb_stays_offline_where_its_host_does_not_answer(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with socket.socket() as closed:
        closed.bind(("127.0.0.1", 0))
        monkeypatch.setenv("WANDB_BASE_URL", f"http://127.0.0.1:{closed.getsockname()[1]}")
        monkeypatch.setenv("WANDB_API_KEY", "0" * 40)
        assert "no answer" in str(loggers._why_offline())
    monkeypatch.setenv("WANDB_MODE", "online")
    assert loggers._why_offline() is None  # as the user says


def test_the_logger_is_no_part_of_what_a_run_is(tmp_path: Path) -> None:
    config = hydrant_config(tmp_path)
    folder = opened(config)
    config.logger = LoggerConfig("csv")
    assert opened(config).path == folder.path
    assert "logger" not in json.loads((folder.path / "manifest.json").read_text())["options"]
