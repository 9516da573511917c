"""What a table cannot be made with is one line: depth without weights, captures that weights have
seen. What one machine lacks is a row's reason.
"""

import sys
from pathlib import Path

import pytest
import torch

from benchmarks.__main__ import main
from benchmarks.catalogue import Catalogue
from benchmarks.methods.base import Unavailable
from benchmarks.run.run_method import build_method
from extrap_train.config import MODEL_CONFIG, ModelConfig
from extrap_train.store.manifest import MANIFEST, Manifest, Split
from extrap_train.store.records import write_record
from tests.benchmarks.analytic import scene_inputs


def _refused(capsys: pytest.CaptureFixture[str], output: Path, *words: str) -> str:
    """What the table `untrained` says before it prepares anything."""
    assert main(["run", "untrained", f"output={output}", *words]) == 1
    message = capsys.readouterr().err
    assert message.startswith("error: ")
    assert message.count("\n") == 1
    assert not (output / "untrained" / "scenes").exists()
    return message


def test_depth_whose_weights_are_not_given(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    message = _refused(capsys, tmp_path, "rules.depth=mast3r")
    assert "rules.depth=mast3r" in message
    assert "checkpoint" in message
    assert "depth.checkpoint=" not in message  # no option of a table


def test_captures_that_the_weights_have_seen(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (model := tmp_path / "run" / "model").mkdir(parents=True)
    write_record(model / MODEL_CONFIG, ModelConfig(name="small"))
    seen = {"hydrant": Split("synthetic", ("0001",), ("0100",), 0)}
    write_record(tmp_path / "run" / MANIFEST, Manifest.of({}, {}, seen))
    words = ["methods=[ours]", f"options.ours.weights={model}"]
    message = _refused(capsys, tmp_path / "out", *words)
    assert "options.ours.weights" in message
    assert "hydrant/0001" in message


def test_a_gpu_without_gsplat_is_a_rows_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setitem(sys.modules, "gsplat", None)
    method = build_method(Catalogue().method("3dgs"))
    with pytest.raises(Unavailable, match=r"rasterizer=gsplat needs .*rasterizer=numba") as said:
        method.synthesize(scene_inputs()[0])
    assert "\n" not in str(said.value)
