"""A finished run is known by its summary."""

import json
from dataclasses import asdict, replace
from pathlib import Path

import pytest

from extrap_train.config import (
    CategoryConfig,
    DatasetDepthConfig,
    FlowMatcherConfig,
    ModelConfig,
    SyntheticConfig,
    TrainConfig,
    TrainerConfig,
    ValidationConfig,
)
from extrap_train.errors import InputError
from extrap_train.runs import RunFolder
from extrap_train.tasks.results import Finished

_SUMMARY = {"steps": 20, "provenance": {"validation": asdict(ValidationConfig())}}


def _config(steps: int, validation: ValidationConfig) -> TrainConfig:
    return TrainConfig(
        category=CategoryConfig("cup", ["cup"]),
        data=SyntheticConfig(),
        depth=DatasetDepthConfig(),
        matcher=FlowMatcherConfig(),
        model=ModelConfig(name="small"),
        trainer=TrainerConfig(steps=steps),
        validation=validation,
    )


def test_a_run_answers_for_fewer_steps_measured_alike(tmp_path: Path) -> None:
    run = RunFolder(tmp_path)
    run.summary.write_text(json.dumps(_SUMMARY))
    finished = Finished.read(run)
    assert finished.steps == 20
    assert finished.answers(_config(10, ValidationConfig()))
    assert finished.answers(_config(20, ValidationConfig()))
    assert not finished.answers(_config(21, ValidationConfig()))
    assert not finished.answers(_config(10, replace(ValidationConfig(), examples=3)))


@pytest.mark.parametrize(
    "content", [b"", b'{"steps": 2', b"[]", b"3", b"\xff\xfe", b'{"steps": 20}', b'{"steps": []}']
)
def test_a_damaged_summary_is_one_line(content: bytes, tmp_path: Path) -> None:
    run = RunFolder(tmp_path)
    run.summary.write_bytes(content)
    with pytest.raises(InputError, match=r"summary\.json: is damaged .*; delete it") as refused:
        Finished.read(run)
    assert "\n" not in str(refused.value)
