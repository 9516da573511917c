"""Verification finds whatever no longer follows from the saved images and hashes."""

import json
from pathlib import Path

import pandas as pd
import pytest

from benchmarks.__main__ import main
from benchmarks.report.verify import Verification, verify
from extrap_train.errors import InputError
from tests.benchmarks.tables import greys_folder, run_greys


def test_a_changed_picture_is_noticed(own: Path, copy: Path) -> None:
    folder = greys_folder(copy)
    assert verify(folder) == Verification(cells=4)
    picture = next(copy.glob("greys/cells/*/0.png"))
    picture.write_bytes(picture.read_bytes()[:-1] + b"!")
    with pytest.raises(InputError, match="not what its cell's hash says"):
        verify(folder)
    assert main(["verify", str(folder.path)]) == 1


def test_verify_finds_a_forged_number_truth_and_protocol(copy: Path) -> None:
    folder = greys_folder(copy)
    file = next(copy.glob("greys/cells/*/cell.json"))
    record = json.loads(file.read_text())
    record["metrics"]["psnr"]["value"] += 0.5
    file.write_text(json.dumps(record))
    assert any("psnr is stated as" in problem for problem in verify(folder).problems)
    mask = next(copy.glob("greys/truths/*/masks/0.png"))
    mask.write_bytes(next(copy.glob("greys/truths/*/truth/0.png")).read_bytes())
    assert any(
        "masks/0.png is missing, or not what its hash says" in p for p in verify(folder).problems
    )
    protocol = folder.protocol.read_text()
    folder.protocol.write_text(protocol.replace('"pool": 9', '"pool": 8'))
    assert any("not what its hash" in problem for problem in verify(folder).problems)


@pytest.mark.parametrize(("metric", "change"), [("psnr", 3e-3), ("psnr", -3e-3), ("tsed", 1e-5)])
def test_a_number_that_rounding_does_not_explain_is_noticed(
    copy: Path, metric: str, change: float
) -> None:
    """By three ten-thousandths of about 10 dB, and by less where the number is 0."""
    file = next(copy.glob("greys/cells/*/cell.json"))
    record = json.loads(file.read_text())
    record["metrics"][metric]["value"] += change
    file.write_text(json.dumps(record))
    assert any(
        f"{metric} is stated as" in problem for problem in verify(greys_folder(copy)).problems
    )


def test_a_number_that_another_processor_rounds_otherwise_is_no_problem(copy: Path) -> None:
    files = list(copy.glob("greys/cells/*/cell.json"))
    for file in files:
        record = json.loads(file.read_text())
        record["metrics"]["psnr"]["value"] *= 1 + 1e-5
        file.write_text(json.dumps(record))
    problems = verify(greys_folder(copy)).problems
    assert not any("is stated as" in problem for problem in problems)


def test_verify_finds_what_is_left_out_and_what_only_pictures_show(copy: Path) -> None:
    folder = greys_folder(copy)
    files = sorted(copy.glob("greys/cells/*/cell.json"))
    records = [json.loads(file.read_text()) for file in files]
    del records[0]["metrics"]["masked_psnr"]
    records[1]["metrics"]["psnr"]["per_image"][0] += 1
    records[2]["made_from"]["inputs"]["weights"] = "0" * 64
    for file, record in zip(files, records, strict=True):
        file.write_text(json.dumps(record))
    table = folder.path / "greys_mean.csv"
    table.write_text(table.read_text().replace("dark", "best"))
    said = "\n".join(verify(folder).problems)
    assert "masked_psnr is not stated, computed as" in said
    assert "psnr by image is stated as" in said
    assert "its name does not follow" in said
    assert "greys_mean.csv: is not what the cells say" in said


def test_geometry_is_scored_kept_and_verified(own: Path, copy: Path) -> None:
    """Five points where the apples stand, under them: they show nothing of their surface."""
    assert run_greys(own, copy, "methods=[solid,dark]") == 0
    table = pd.read_csv(copy / "greys" / "greys.csv").set_index(["method", "metric"])["value"]
    assert (table["solid", "f_score"] == 0).all()
    assert (table["solid", "accuracy_distance"] > 0.01).all()
    assert table["dark", "f_score"].isna().all()
    folder = greys_folder(copy)
    assert verify(folder) == Verification(cells=4)
    cloud = next(copy.glob("greys/cells/*/points.npy"))
    cloud.write_bytes(cloud.read_bytes()[:-1] + b"!")
    with pytest.raises(InputError, match="not what its cell's hash says"):
        verify(folder)
