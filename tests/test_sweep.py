"""A sweep ends with a row for every job, whatever became of it."""

import codecs
import json
import shutil
import sys
from collections.abc import Callable
from pathlib import Path

import pandas as pd
import pytest
import yaml

from extrap_train.__main__ import main
from extrap_train.config import TrainConfig
from extrap_train.errors import InputError
from extrap_train.store import Outcome
from extrap_train.store.atomic import file_lock
from extrap_train.sweep import add_row, compare_over_seeds, over_seeds, read_rows

Fake = Callable[[TrainConfig], Path | Outcome]


def _trained(tmp_path: Path) -> Callable[[TrainConfig], Path]:
    """A task that has learnt as much as it was given steps, and never any cups."""

    def run(config: TrainConfig) -> Path:
        if config.category.name == "cup":
            raise InputError("no training pairs for cup: loosen prep")
        folder = tmp_path / f"{config.category.name}-{config.trainer.steps}"
        folder.mkdir(exist_ok=True)  # a sampler may ask twice
        psnr = 20.0 + config.trainer.steps
        scores = {"model": {"psnr": psnr, "lpips": None}, "nearest": {"psnr": 15.0}}
        summary = {"validation": scores, "seconds": {"train": 3.0}, "provenance": {"seed": 0}}
        (folder / "summary.json").write_text(json.dumps(summary))
        return folder

    return run


def _sweep(
    monkeypatch: pytest.MonkeyPatch,
    task: Fake,
    folder: Path,
    *words: str,
    draws: bool = False,
) -> str | None:
    """Run it, without its figure unless it `draws`; what it ends with, None for success."""
    if not draws:
        monkeypatch.setattr("extrap_train.sweep.draw", lambda *_: None)
    monkeypatch.setattr("extrap_train.__main__.task", lambda name: lambda config, _: task(config))
    monkeypatch.setattr(sys, "argv", ["extrap_train", "-m", *words, f"hydra.sweep.dir={folder}"])
    try:
        main()
    except SystemExit as stopped:
        return str(stopped)
    return None


_WORDS = ("category=apple", "seed=0,1", "trainer.steps=3")


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a sweep of two jobs; it is only read."""
    folder = tmp_path_factory.mktemp("finished")
    with pytest.MonkeyPatch.context() as patch:
        assert _sweep(patch, _trained(folder), folder / "sweep", *_WORDS) is None
    return folder / "sweep"


@pytest.fixture
def swept(finished: Path, tmp_path: Path) -> Path:
    """A copy of it to change, or to go on with."""
    return Path(shutil.copytree(finished, tmp_path / "sweep"))


def test_every_job_is_a_row_with_its_overrides_and_metrics(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    words = ["category=apple,book", "trainer.steps=1,2", "model.weight_decay=0"]
    assert _sweep(monkeypatch, _trained(tmp_path), tmp_path / "sweep", *words, draws=True) is None
    table = pd.read_csv(tmp_path / "sweep" / "sweep.csv")
    assert list(table.columns) == [
        "job", "status", "seconds", "category", "trainer.steps", "model.weight_decay",
        "result.validation.model.psnr", "result.validation.nearest.psnr", "folder", "reason",
    ]  # fmt: skip
    assert list(table["category"]) == ["apple", "apple", "book", "book"]
    assert list(table["result.validation.model.psnr"]) == [21.0, 22.0, 21.0, 22.0]
    assert (table["status"] == "ok").all()
    assert (tmp_path / "sweep" / "sweep.png").stat().st_size > 1000
    assert capfd.readouterr().out.splitlines()[-1].endswith("sweep/sweep.csv")


def test_jobs_that_differ_in_their_seed_have_a_mean(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    words = ["category=apple", "trainer.steps=1,2", "seed=0,1,2"]
    assert _sweep(monkeypatch, _trained(tmp_path), tmp_path / "sweep", *words) is None
    lines = (tmp_path / "sweep" / "seeds.md").read_text().splitlines()
    assert [cell.strip() for cell in lines[0].split("|")[1:4]] == [
        "",
        "seeds",
        "validation.model.psnr",
    ]
    assert lines[2].startswith("| trainer.steps=1 | 3 | 21.00 ± 0.00 |  |")
    assert lines[3].startswith("| trainer.steps=2 | 3 | 22.00 ± 0.00 | +1.00 ± 0.00 |")


def test_seeds_are_compared_one_by_one() -> None:
    """What a seed does to all alike is not part of the difference's error."""
    labels = ["old", "old", "old", "new", "new", "late"]
    seeds = ["0", "1", "2", "1", "0", "7"]
    psnr = [20.0, 22.0, 27.0, 22.5, 20.3, 19.0]
    lpips = [0.1, 0.2, float("nan"), 0.3, 0.2, float("nan")]
    jobs = pd.DataFrame({"psnr": psnr, "lpips": lpips}, index=[labels, seeds])
    table = over_seeds("old", jobs)
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in table.splitlines()]
    assert rows[0] == ["", "seeds", "psnr", "difference", "lpips", "difference"]
    assert rows[2] == ["old", "3", "23.00 ± 2.08", "", "0.1500 ± 0.0500", ""]
    assert rows[3] == [
        "new",
        "2",
        "21.40 ± 1.10",
        "+0.40 ± 0.10",
        "0.2500 ± 0.0500",
        "+0.1000 ± 0.0000",
    ]
    assert rows[4] == ["late", "1", "19.00", "–", "–", "–"]


def test_a_failed_job_is_a_row_and_the_others_go_on(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    words = ["category=apple,cup,book"]
    said = _sweep(monkeypatch, _trained(tmp_path), tmp_path / "sweep", *words)
    assert said == "error: no training pairs for cup: loosen prep"
    table = pd.read_csv(tmp_path / "sweep" / "sweep.csv").set_index("category")
    assert dict(table["status"]) == {"apple": "ok", "cup": "failed", "book": "ok"}
    assert table["reason"]["cup"] == "InputError: no training pairs for cup: loosen prep"
    assert pd.isna(table["result.validation.model.psnr"]["cup"])


def test_an_option_out_of_bounds_fails_its_job_alone(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    words = ["category=apple", "trainer.steps=0,3"]
    said = _sweep(monkeypatch, _trained(tmp_path), tmp_path / "sweep", *words)
    assert said == "error: trainer.steps=0: must be at least 1"
    table = pd.read_csv(tmp_path / "sweep" / "sweep.csv")
    assert list(table["status"]) == ["failed", "ok"]


def test_a_row_that_comes_late_or_twice_has_its_place(tmp_path: Path) -> None:
    """Launchers that run jobs side by side end them in any order."""
    file = tmp_path / "sweep.csv"
    for number, lr in (("10", "3"), ("2", "1"), ("10", "4")):
        rows = add_row(
            file,
            {"job": number, "status": "ok", "seconds": "1.0", "lr": lr, "folder": "", "reason": ""},
        )
    assert [*zip(rows["job"], rows["lr"], strict=True)] == [("2", "1"), ("10", "4")]
    pd.testing.assert_frame_equal(read_rows(file), rows)


def test_a_single_run_has_no_table(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(
        "extrap_train.__main__.task", lambda name: lambda config, _: _trained(tmp_path)(config)
    )
    monkeypatch.setattr(sys, "argv", ["extrap_train", "category=apple"])
    main()
    assert not list(tmp_path.rglob("sweep.csv"))


def test_a_job_that_takes_a_finished_run_says_so(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    train = _trained(tmp_path)

    def taken(config: TrainConfig) -> Outcome:
        return Outcome(train(config), is_reused=config.seed == 1)

    words = ["category=apple", "seed=0,1,2"]
    assert _sweep(monkeypatch, taken, tmp_path / "sweep", *words) is None
    table = pd.read_csv(tmp_path / "sweep" / "sweep.csv")
    assert list(table["status"]) == ["ok", "reused", "ok"]
    assert table["result.validation.model.psnr"].notna().all()
    assert all(Path(folder).is_dir() for folder in table["folder"])
    assert "job 1: reused validation.model.psnr" in capfd.readouterr().out
    assert "| 3 |" in (tmp_path / "sweep" / "seeds.md").read_text()


def _lines(said: str | None) -> int:
    return len((said or "").splitlines())


def test_two_sweeps_at_once_in_one_folder_are_one_too_many(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    with file_lock(tmp_path / ".sweep.lock", "held by this test"):
        said = _sweep(monkeypatch, _trained(tmp_path), tmp_path, "category=apple")
    assert "another sweep" in (said or "")
    assert _lines(said) == 1
    assert not (tmp_path / "sweep.csv").exists()
    assert _sweep(monkeypatch, _trained(tmp_path), tmp_path, "category=apple") is None


def test_another_sweep_does_not_mix_its_rows_with_those_that_lie_there(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, swept: Path
) -> None:
    train = _trained(tmp_path)
    before = (swept / "sweep.csv").read_bytes()
    for other in ("seed=0,1,2", "seed=1,0", "trainer.steps=4,5"):
        said = _sweep(monkeypatch, train, swept, *_WORDS, other)
        assert "hydra.sweep.dir" in (said or "")
        assert _lines(said) == 1
        assert (swept / "sweep.csv").read_bytes() == before
    assert _sweep(monkeypatch, train, swept, *_WORDS) is None


def test_a_sweep_goes_on_where_its_folder_was_moved_to(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    train, words = _trained(tmp_path), ("category=apple", "seed=0,1")
    assert _sweep(monkeypatch, train, tmp_path / "full", *words, "output=full") is None
    moved = (tmp_path / "full").rename(tmp_path / "roomy")
    assert _sweep(monkeypatch, train, moved, *words, "output=roomy") is None
    table = pd.read_csv(moved / "sweep.csv")
    assert list(table["seed"]) == [0, 1]
    assert "output" not in table


def test_a_table_that_a_spreadsheet_marked_as_unicode_is_read(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, swept: Path
) -> None:
    before = (swept / "sweep.csv").read_bytes()
    (swept / "sweep.csv").write_bytes(codecs.BOM_UTF8 + before)
    assert _sweep(monkeypatch, _trained(tmp_path), swept, *_WORDS) is None
    assert (swept / "sweep.csv").read_bytes().startswith(b"job,status,")


@pytest.mark.parametrize(
    "edit",
    [
        lambda table: table.replace(b",", b";"),
        lambda table: table.replace(b"apple", "\xe4pfel".encode("latin-1")),
        lambda table: table.replace(b"\n0,", b"\nthe first,"),
        lambda table: table.replace(b"\n0,", b"\n0,more,and,more,"),
        lambda table: table.replace(b"\n", b",\n").replace(b"reason,\n", b"reason\n"),
        lambda table: table.replace(b",20.0,", b',"20,0 dB",').replace(b",23.0,", b',"23,0",'),
        lambda table: b"",
        lambda table: b"\0" * 99,
    ],
)
def test_a_table_that_a_spreadsheet_changed_ends_the_sweep_before_its_jobs(
    monkeypatch: pytest.MonkeyPatch, swept: Path, edit: Callable[[bytes], bytes]
) -> None:
    changed = edit((swept / "sweep.csv").read_bytes())
    (swept / "sweep.csv").write_bytes(changed)
    said = _sweep(monkeypatch, lambda _: pytest.fail("a job ran"), swept, *_WORDS)
    assert "sweep.csv" in (said or "")
    assert "hydra.sweep.dir" in (said or "")
    assert _lines(said) == 1
    assert (swept / "sweep.csv").read_bytes() == changed


@pytest.mark.parametrize("content", ["", "[" * 20_000, "{}"])
def test_a_folder_with_a_damaged_manifest_is_refused(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, content: str
) -> None:
    (tmp_path / "manifest.json").write_text(content)
    said = _sweep(monkeypatch, _trained(tmp_path), tmp_path, "category=apple")
    assert "manifest.json" in (said or "")
    assert _lines(said) == 1


@pytest.mark.parametrize("error", [PermissionError(13, "Permission denied"), OSError(28, "full")])
@pytest.mark.parametrize("where", ["file_lock", "add_row"])
def test_a_sweep_that_cannot_write_its_table_ends_in_one_line(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, error: OSError, where: str
) -> None:
    def refuse(*_: object) -> None:
        raise error

    monkeypatch.setattr(f"extrap_train.sweep.{where}", refuse)
    said = _sweep(monkeypatch, _trained(tmp_path), tmp_path / "sweep", "category=apple")
    assert "hydra.sweep.dir" in (said or "")
    assert _lines(said) == 1


def test_a_full_disk_in_a_job_is_its_row(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def full(config: TrainConfig) -> Path:
        raise OSError(28, "No space left on device", str(tmp_path))

    said = _sweep(monkeypatch, full, tmp_path / "sweep", "category=apple", "seed=0,1")
    assert "No space left" in (said or "")
    assert _lines(said) == 1
    table = pd.read_csv(tmp_path / "sweep" / "sweep.csv")
    assert list(table["status"]) == ["failed", "failed"]


def test_a_sweeper_is_told_the_objective(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    words = ["category=apple", "trainer.steps=int(interval(1, 9))", "hydra/sweeper=optuna"]
    search = ["hydra.sweeper.n_trials=3", "hydra.sweeper.direction=maximize"]
    search += ["hydra.sweeper.sampler.seed=1", "model.weight_decay=0.01"]
    objective = "hydra.callbacks.sweep_table.objective=validation.model.psnr"
    task = _trained(tmp_path)
    assert _sweep(monkeypatch, task, tmp_path / "sweep", *words, *search, objective) is None
    table = pd.read_csv(tmp_path / "sweep" / "sweep.csv")
    assert len(table) == 3
    best = yaml.safe_load((tmp_path / "sweep" / "optimization_results.yaml").read_text())
    assert best["best_value"] == table["result.validation.model.psnr"].max()
    assert best["best_params"]["trainer.steps"] == best["best_value"] - 20


def test_an_objective_that_is_not_measured_is_named(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    objective = "hydra.callbacks.sweep_table.objective=validation.model.psrn"
    said = _sweep(monkeypatch, _trained(tmp_path), tmp_path, "category=apple", objective)
    assert said is not None
    assert "no such metric; did you mean validation.model.psnr" in said
    assert pd.read_csv(tmp_path / "sweep.csv")["status"][0] == "failed"


def test_what_others_are_compared_with_does_not_change_where_it_fails(tmp_path: Path) -> None:
    """Without the first combination there is no difference to show, least of all to the second."""
    rows = [
        {"job": str(job), "status": status, "seconds": "1", "model": model, "seed": seed, **found}
        for job, (model, seed, status, found) in enumerate(
            [
                ("plain", "0", "failed", {}),
                ("plain", "1", "failed", {}),
                ("new", "0", "ok", {"result.psnr": "20.0"}),
                ("new", "1", "ok", {"result.psnr": "21.0"}),
                ("newer", "0", "ok", {"result.psnr": "25.0"}),
            ]
        )
    ]
    compare_over_seeds(pd.DataFrame(rows).fillna(""), tmp_path / "seeds.md")
    lines = (tmp_path / "seeds.md").read_text().splitlines()[2:]
    table = [[cell.strip() for cell in line.split("|")[1:-1]] for line in lines]
    assert table == [
        ["model=plain", "0", "–", ""],
        ["model=new", "2", "20.50 ± 0.50", "–"],
        ["model=newer", "1", "25.00", "–"],
    ]
