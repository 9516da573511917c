"""A table ends with every cell that can be made, however its methods, files and options fail."""

import json
import os
import socket
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from benchmarks.__main__ import main
from benchmarks.catalogue import Catalogue
from benchmarks.protocol.prepared_scene import Scene
from benchmarks.report.aggregate import TIDY, read_results
from benchmarks.run import run_method
from benchmarks.run.identity import MethodContent
from benchmarks.run.plan import cell_jobs, open_protocol
from benchmarks.run.run_method import check_output
from extrap_train.errors import InputError
from extrap_train.jobs.slurm import SubmittedLauncher
from tests.benchmarks.tables import greys_folder, run_greys

HOST = socket.gethostname().partition(".")[0]


def _table(output: Path) -> pd.DataFrame:
    """The tidy table without what time and machine decide."""
    table = pd.read_csv(output / "greys" / "greys.csv")
    return table[~table["metric"].isin(["seconds", "peak_memory_mib"])].reset_index(drop=True)


def _pictures(output: Path) -> dict[Path, bytes]:
    return {f.relative_to(output): f.read_bytes() for f in output.glob("*/cells/*/*.png")}


def test_a_third_partys_method_is_a_row(finished: Path) -> None:
    table = pd.read_csv(finished / "greys" / "greys.csv")
    assert list(table.columns) == TIDY
    assert set(table["method"]) == {"dark", "light"}
    assert (table["status"] == "ok").all()
    assert len(table[table["metric"] == "psnr"]) == 4  # two methods, two captures
    empty = table[table["metric"] == "lpips_alex"]
    assert empty["value"].isna().all()
    assert empty["reason"].str.contains("alexnet").all()
    assert (table[table["metric"] == "seconds"]["value"] >= 0).all()
    assert (table[table["metric"] == "peak_memory_mib"]["value"] > 10).all()


def test_every_report_is_there(finished: Path) -> None:
    folder = finished / "greys"
    for name in ("greys.csv", "greys_mean.csv", "greys.md", "greys.tex", "index.html"):
        assert (folder / name).stat().st_size > 100
    assert (folder / "plots" / "masked_psnr_over_angle.svg").read_text().startswith("<svg")


def test_a_cell_says_what_made_it(finished: Path) -> None:
    cells = read_results(greys_folder(finished)).cells
    for cell in cells:
        assert cell.device == "cpu"
        assert cell.made_from.options["factory"] == "grey_method.Grey"
        assert cell.made_from.options["rules.image_size"] == 24
        assert set(cell.made_from.inputs) == {"photographs", "weights", "code"}
        assert cell.given == {"init": "none", "device": "cpu"}
        assert cell.counts == {"greys": 1.0}
        assert cell.made_from.packages["torch"]
    assert len({cell.key for cell in cells}) == len(cells) == 4


def test_a_second_run_uses_every_cell_again(
    own: Path, copy: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    stamps = {f: f.stat().st_ino for f in copy.glob("greys/cells/*/*")}
    assert run_greys(own, copy) == 0
    assert "4 reused, 0 open" in capsys.readouterr().out
    assert {f: f.stat().st_ino for f in copy.glob("greys/cells/*/*")} == stamps


def test_leftovers_of_killed_writers_are_gone_after_the_next_run(own: Path, copy: Path) -> None:
    """Half-written cells, scenes and truths beside the whole ones, and files in the table."""
    table = copy / "greys"
    key = next(table.glob("cells/*")).name
    scene = next(table.glob("scenes/*")).name
    left = [table / "cells" / f".{key}.99999", table / "scenes" / f".{scene}.99999"]
    left += [table / "cells" / f".{key}.{HOST}-999999.0a1b2c3d.tmp"]
    left += [table / "truths" / f".{scene}.replaced.{HOST}-999999.tmp"]
    left += [table / f".truths.{HOST}-999999.4d3c2b1a.tmp"]
    for folder in left:
        folder.mkdir()
        (folder / "0.png").write_bytes(b"half")
    (table / f".greys.csv.{HOST}-999999.tmp").write_bytes(b"half")
    assert run_greys(own, copy) == 0
    assert {path.name for path in table.rglob(".*")} <= {".run.lock", ".lock", ".truths.lock"}


def test_two_runs_give_the_same_images_and_numbers(finished: Path, quick: Path) -> None:
    whole = _table(finished)
    again = whole[whole["sequence"].astype(str).str.zfill(4) == "0000"].reset_index(drop=True)
    pd.testing.assert_frame_equal(_table(quick), again)
    pictures = _pictures(quick)
    assert len(pictures) == 2 * 6  # methods, targets
    assert pictures.items() <= _pictures(finished).items()


def test_a_cell_changes_its_name_with_its_options_alone(own: Path, copy: Path) -> None:
    before = {f.name for f in copy.glob("greys/cells/*")}
    run_greys(own, copy, "options.dark.level=0.3")
    new = {f.name for f in copy.glob("greys/cells/*")} - before
    assert len(new) == 2  # dark's two; light's are as they were


def test_failures_are_rows_and_the_rest_goes_on(own: Path, copy: Path) -> None:
    assert run_greys(own, copy, "methods=[dark,broken,absent,bright,light]") == 4
    table = pd.read_csv(copy / "greys" / "greys.csv")
    states = table.groupby("method")["status"].first()
    assert dict(states) == {
        "absent": "unavailable",
        "bright": "failed",
        "broken": "failed",
        "dark": "ok",
        "light": "ok",
    }
    reasons = table.groupby("method")["reason"].first()
    assert "RuntimeError: no luck" in reasons["broken"]
    assert "metrics take images in [0, 1]" in reasons["bright"]
    assert "grey.bin is missing" in reasons["absent"]
    assert "no luck" in (copy / "greys" / "greys.md").read_text()


def test_a_failed_cell_is_tried_again_and_a_finished_one_not(
    own: Path, copy: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run_greys(own, copy, "methods=[dark,broken]")
    capsys.readouterr()
    run_greys(own, copy, "methods=[dark,broken]", dry_run=True)
    assert "2 reused, 2 open" in capsys.readouterr().out


@pytest.mark.parametrize("damages", [[b"", b"{", b'{"key": "other"}'], [b"[]", b"bare"]])
def test_corrupt_cells_are_announced_and_made_anew(
    damages: list[bytes],
    own: Path,
    finished: Path,
    copy: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    for victim, damage in zip(copy.glob("greys/cells/*/cell.json"), damages, strict=False):
        bare = json.dumps({"key": victim.parent.name, "status": "ok"}).encode()
        victim.write_bytes(bare if damage == b"bare" else damage)
    assert run_greys(own, copy) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert said.count("made again") == len(damages)
    assert f"{4 - len(damages)} reused, {len(damages)} open" in said
    pd.testing.assert_frame_equal(_table(copy), _table(finished))


def test_a_cell_of_the_cpu_sees_no_gpu_from_its_start(
    own: Path, copy: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Asking a GPU for anything opens it, and hiding it afterwards changes nothing."""
    seen = []

    class Watched(run_method.Stopwatch):
        def __enter__(self) -> "Watched":
            seen.append(os.environ.get("CUDA_VISIBLE_DEVICES"))
            super().__enter__()
            return self

    monkeypatch.setattr(run_method, "Stopwatch", Watched)
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "0")
    folder, catalogue = greys_folder(copy), Catalogue.with_own([str(own)])
    table = catalogue.table("greys", [f"output={copy}", "device=cpu"])
    protocol, _ = open_protocol(table, folder)
    scenes = [Scene.open(path) for path in folder.scenes.glob("*-*")]
    config = catalogue.method("dark")
    categories = {scene.draw.category for scene in scenes}
    content = MethodContent(dict.fromkeys(categories, "none"), "this")
    job = cell_jobs(table, folder, protocol, [config], {"dark": content}, scenes)[0]
    made = check_output(run_method.run_method(job), 6, 24, "dark")
    assert made.output.status == "made"
    assert seen == [""]


def test_a_protocol_without_results_gives_way(own: Path, tmp_path: Path) -> None:
    """A first command that was wrong does not spoil the folder for the right one."""
    assert run_greys(own, tmp_path, "rules.image_size=16", dry_run=True) == 0
    assert run_greys(own, tmp_path, "methods=[dark]", quick=True) == 0
    assert read_results(greys_folder(tmp_path)).plan.table.rules.image_size == 24


def test_a_plan_that_is_none_is_one_line(copy: Path) -> None:
    greys_folder(copy).plan.write_text("{}")
    with pytest.raises(InputError, match=r"plan.json: damaged"):
        read_results(greys_folder(copy))


def test_results_of_another_protocol_are_refused(own: Path, copy: Path) -> None:
    with pytest.raises(InputError, match=r"another protocol.*rules.image_size was 24, is 16"):
        run_greys(own, copy, "rules.image_size=16")
    file = next(copy.glob("greys/cells/*/cell.json"))
    record = json.loads(file.read_text())
    record["protocol"] = "0" * 64
    file.write_text(json.dumps(record))
    with pytest.raises(InputError, match="is a result of another protocol"):
        read_results(greys_folder(copy))


def test_a_change_of_scoring_keeps_the_images(own: Path, copy: Path) -> None:
    """What the method made is scored again, and the method itself is not asked."""
    seconds = {c.images["0.png"]: c.seconds for c in read_results(greys_folder(copy)).cells}
    assert run_greys(own, copy, "scoring.lpips=[vgg]") == 0
    again = read_results(greys_folder(copy)).cells
    assert len(again) == 4
    assert "lpips_vgg" in again[0].metrics
    assert {c.images["0.png"]: c.seconds for c in again} == seconds


def test_quick_is_a_part_of_the_same_table(finished: Path, quick: Path) -> None:
    part, whole = (read_results(greys_folder(output)).cells for output in (quick, finished))
    assert {cell.sequence for cell in part} == {"0000"}
    assert {cell.key for cell in part} < {cell.key for cell in whole}


def test_a_dry_run_makes_nothing_and_says_what_is_missing(
    own: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run_greys(own, tmp_path, dry_run=True) == 0
    said = capsys.readouterr().out
    assert "not yet known" in said
    assert not list(tmp_path.glob("greys/cells/*"))


def test_a_dry_run_says_what_scoring_again_costs(
    own: Path, copy: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Estimated for images that are there, from the time that scoring such cells took."""
    for file in copy.glob("greys/cells/*/cell.json"):
        file.write_text(json.dumps(json.loads(file.read_text()) | {"scoring_seconds": 90.0}))
    capsys.readouterr()
    assert run_greys(own, copy, "scoring.lpips=[vgg]", dry_run=True) == 0
    assert "about 0:06:00 (h:mm:ss) of one core" in capsys.readouterr().out


def test_the_version_is_the_packages(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["--version"])
    assert ended.value.code == 0
    assert capsys.readouterr().out == f"extrap-train {version('extrap-train')}\n"


def test_two_runs_on_one_folder_do_not_mix(own: Path, copy: Path) -> None:
    from filelock import FileLock

    with FileLock(copy / "greys" / ".run.lock"), pytest.raises(InputError, match="another process"):
        run_greys(own, copy)


def test_a_method_with_a_wrong_option_is_named(own: Path, copy: Path) -> None:
    with pytest.raises(InputError, match="dark: there is no option levle; did you mean level"):
        run_greys(own, copy, "options.dark.levle=0.3")


def test_two_names_of_one_method_are_no_two_rows(own: Path, copy: Path) -> None:
    with pytest.raises(InputError, match=r"methods dark and light are the same.*leave one out"):
        run_greys(own, copy, "options.light.level=0.2")


def test_means_hold_their_interval(finished: Path) -> None:
    means = read_results(greys_folder(finished)).means()
    assert (
        (means["low"] <= means["mean"] + 1e-12) & (means["mean"] <= means["high"] + 1e-12)
    ).all()
    psnr = means[means["metric"] == "psnr"].set_index("method")
    assert psnr["mean"].idxmax() == psnr["rank"].idxmin()
    assert np.isnan(means[means["metric"] == "coverage"]["rank"]).all()


@pytest.mark.slow  # its two tasks load for longer than they run
def test_a_cluster_makes_the_same_table(own: Path, finished: Path, tmp_path: Path) -> None:
    """The code that submits to SLURM, with submitit's own executor for a machine without it."""
    import submitit

    executor = submitit.LocalExecutor(tmp_path / "submitted")
    executor.update_parameters(timeout_min=30)
    launcher = SubmittedLauncher(lambda: executor, tasks=1, poll_seconds=0.05)
    assert run_greys(own, tmp_path, launcher=launcher) == 0
    pd.testing.assert_frame_equal(_table(tmp_path), _table(finished))
    assert _pictures(tmp_path) == _pictures(finished)


def test_a_quick_table_says_that_it_is_one(finished: Path, quick: Path) -> None:
    title = "Greys; oracle: depth of the data set (quick: a part of the table)"
    assert f"<title>{title}" in (quick / "greys" / "index.html").read_text()
    assert title in (quick / "greys" / "greys.md").read_text()
    assert "quick" not in (finished / "greys" / "greys.md").read_text()
