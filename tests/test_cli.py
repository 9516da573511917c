"""Wrong options and unusable input end with one line that says what to do, and with nothing half-
written.
"""

import errno
import gzip
import json
import os
import re
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from data_prep.__main__ import main as prepare
from extrap_train.__main__ import main


@pytest.fixture
def own_choices(tmp_path: Path) -> Path:
    """A folder with a category of one's own, and a blank in its name."""
    folder = tmp_path / "my choices"
    (folder / "category").mkdir(parents=True)
    content = "defaults: [category_schema, _self_]\nname: mine\nmembers: [mine]\n"
    (folder / "category" / "mine.yaml").write_text(content)
    return folder


def _error(arguments: list[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> str:
    """What the command line says before it gives up; it must be one line and leave no run."""
    monkeypatch.setattr(sys, "argv", ["extrap_train", *arguments, f"output={tmp_path / 'out'}"])
    with pytest.raises(SystemExit) as stopped:
        main()
    message = str(stopped.value)
    assert message.startswith("error: ")
    assert "\n" not in message
    assert not (tmp_path / "out" / "train").exists()
    return message


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ([], "category is not given"),
        (["category=hydrnt"], "did you mean hydrant?; known: all, apple, book"),
        (["category=hydrant", "data=coed"], "did you mean co3d"),
        (["category=hydrant", "experiment=smalbase"], "experiment=smalbase is unknown"),
        (["category=hydrant", "trainer.stesp=3"], "did you mean trainer.steps"),
        (["category=hydrant", "mdoel=small"], "did you mean model"),
        (["catgory=hydrant"], "no option catgory; did you mean category?"),
        (["category=hydrant", "experimnt=paper"], "no option experimnt; did you mean experiment?"),
        (["category=hydrant", "depth.planes=8"], "depth.planes is an option of depth=stereo: give"),
        (["category=hydrant", "data.set_list=dev"], "data.set_list is an option of data=co3d:"),
        (["category=hydrant", "trainer.steps=0"], "trainer.steps=0: must be at least 1"),
        (["category=hydrant", "threads=0"], "threads=0: must be at least 1"),
        (["category=hydrant", "seed=-1"], "seed=-1: must be from 0"),
        (["category=hydrant", "depth=stereo", "depth.planes=2"], "depth.planes=2: must be from 3"),
        (["category=hydrant", "depth=mast3r"], "depth.checkpoint is not given: give depth.check"),
        (
            ["category=hydrant", "depth=monocular", "matcher@depth.matcher=aliked"],
            "depth.matcher.checkpoint is not given: give depth.matcher.checkpoint=FILE, aliked-n16",
        ),
        (["category=hydrant", "model.patch=0"], "model.patch=0: must be from 1"),
        (["category=hydrant", "model.unet.channels=[30,60]"], "need multiples of 16"),
        (["category=hydrant", "trainer.precision=half"], "known: auto, 32-true"),
        (["category=hydrant", "~prep.image_size"], "prep.image_size"),
        (["hydrant"], "did you mean category=hydrant?"),
        (["-m", "category=hydrnt,apple"], "did you mean hydrant"),
        (["category=hydrant", "task=scne"], "task=scne is unknown; known: category, complete"),
        (["category=hydrant", "model.prediction=eps"], "known: epsilon, v_prediction, sample"),
        (
            ["category=hydrant", "model.image_size=96"],
            "give prep.image_size=192",
        ),
        (["category=hydrant", "model.patch=7"], "no multiple of 56"),
        (["category=hydrant", "data=co3d"], "give data.root=FOLDER"),
        (
            ["category=hydrant", "model=small_megascenes", "model.geometry=true"],
            "model.family=megascenes is not conditioned on the warp",
        ),
        (["category=hydrant", "sampler.compat=megascenes"], "predicts `sample`: leave it out"),
        (
            ["category=hydrant", "model=small_megascenes", "model.references=3"],
            "conditioned on the nearest alone; give model.references=1",
        ),
        (["category=hydrant", "sampler.solver=heun"], "known: ddim, dpmpp, unipc"),
        (["category=hydrant", "sampler.solver=unipc", "sampler.eta=1"], "need sampler.solver=ddim"),
        (["category=hydrant", "+trainer.logger=wandb"], "there is no option trainer.logger"),
        (["category=hydrant", "++trainer.wandb.project=x"], "no option trainer.wandb.project"),
        (["category=hydrant", "+logger=wandb"], "there is no option logger"),
        (["category=hydrant", "+experiments=paper"], "did you mean experiment?"),
        (["category=hydrant", "model.unet.channels=[1,2"], "model.unet.channels=[1,2: must be a"),
        (["category=hydrant", "trainer.steps=1 (x)"], "trainer.steps=1 (x): must be a whole numb"),
        (["category=hydrant", "model.learning_rate=1e-4)"], "model.learning_rate=1e-4): must be"),
        (["category=hydrant", "input_frames=a.jpg"], "input_frames=a.jpg: must be a list, as [a"),
        (["category=hydrant", "~task"], "~task"),
        (["category=hydrant", "~experiment"], "~experiment: give experiment=NAME"),
        (["category=hydrant", "category.nmae=x"], "did you mean category.name?"),
        (
            ["-m", "category=hydrant", "data=synthetic,cod3"],
            "data=cod3 is unknown; did you mean co",
        ),
    ],
)
def test_a_wrong_option_is_one_clear_line(
    arguments: list[str], said: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    assert said in _error(arguments, monkeypatch, tmp_path)


@pytest.mark.parametrize(
    ("word", "said"),
    [
        ("trainer.steps=abc", "must be a whole number"),
        ("trainer.steps=1e3", "must be a whole number"),
        ("trainer.steps=null", "cannot be null"),
        ("model.learning_rate=fast", "must be a number"),
        ("resume=maybe", "must be true or false"),
        ("model.unet.channels=[a]", "every value must be a whole number"),
        ("model.unet.channels=3", "must be a list, as [1,2]"),
        ("trainer=3", "trainer has options of its own: give trainer.NAME=VALUE"),
    ],
)
def test_a_value_of_another_type_is_said_as_it_was_given(
    word: str, said: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    assert _error(["category=hydrant", word], monkeypatch, tmp_path) == f"error: {word}: {said}"


@pytest.mark.parametrize(
    ("word", "said"),
    [
        ("trainer.steps=10", "there is no option trainer.steps; see --help"),
        ("prep.image_sise=64", "did you mean prep.image_size?"),
        ("depth.planes=8", "is an option of depth=stereo"),
    ],
)
def test_a_command_suggests_only_what_it_has(
    word: str, said: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    options = ["category=hydrant", word, f"output={tmp_path / 'out'}"]
    monkeypatch.setattr(sys, "argv", ["data_prep", *options])
    with pytest.raises(SystemExit, match=re.escape(said)):
        prepare()


def test_a_missing_root_is_named_and_hydra_adds_no_line(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    options = ["category=hydrant", "data=co3d", f"data.root={tmp_path / 'nowhere'}"]
    assert "nowhere" in _error([*options, "model.start=null"], monkeypatch, tmp_path)
    assert "Error executing job" not in capfd.readouterr().err


def test_a_run_is_not_begun_on_data_that_are_none(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Else its name would be taken."""
    (tmp_path / "co3d").mkdir()
    options = ["category=hydrant", "data=co3d", f"data.root={tmp_path / 'co3d'}", "run=mine"]
    assert "has no category" in _error([*options, "model.start=null"], monkeypatch, tmp_path)


@pytest.mark.parametrize("command", [main, prepare])
def test_no_member_is_prepared_where_another_is_missing(
    command: Callable[[], None], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """The one that is there is not even read: its annotations would be refused."""
    (tmp_path / "co3d/apple").mkdir(parents=True)
    (tmp_path / "co3d/apple/frame_annotations.jgz").touch()
    options = ["category=all", "data=co3d", f"data.root={tmp_path / 'co3d'}"]
    start = ["model.start=null"] if command is main else []
    monkeypatch.setattr(sys, "argv", ["it", *options, *start, f"output={tmp_path / 'out'}"])
    with pytest.raises(SystemExit, match="has no category 'book'; categories present: apple"):
        command()
    assert not (tmp_path / "out").exists()


def test_a_run_is_not_removed_before_there_is_another(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "co3d").mkdir()
    run = tmp_path / "out/train/hydrant/small/mine"
    for name in ("summary.json", "checkpoints/step-00000003.ckpt", "model/unet"):
        (run / name).parent.mkdir(parents=True, exist_ok=True)
        (run / name).touch()
    before = sorted(run.rglob("*"))
    options = ["data=co3d", f"data.root={tmp_path / 'co3d'}", "run=mine", "model.start=null"]
    words = ["extrap_train", "category=hydrant", "resume=false", *options]
    monkeypatch.setattr(sys, "argv", [*words, f"output={tmp_path / 'out'}"])
    with pytest.raises(SystemExit, match="has no category"):
        main()
    assert sorted(run.rglob("*")) == before


def test_a_full_disk_anywhere_is_one_line(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr("extrap_train.__main__.task", lambda name: full)
    assert "out: No space left on device" in _error(["category=hydrant"], monkeypatch, tmp_path)


def test_a_name_that_is_too_long_is_one_line(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def run(*_: object) -> None:
        (tmp_path / "out" / ("x" * 300)).mkdir(parents=True)

    monkeypatch.setattr("extrap_train.__main__.task", lambda name: run)
    assert "shorter run=NAME" in _error(["category=hydrant"], monkeypatch, tmp_path)


@pytest.mark.parametrize(
    ("place", "remedy"),
    [
        ("out", "choose another output="),
        ("out/a/b", "choose"),
        ("data/cup", "change its rights"),
    ],
)
def test_a_closed_place_is_called_what_it_is(
    place: str, remedy: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def closed(*_: object) -> None:
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(tmp_path / place))

    monkeypatch.setattr("extrap_train.__main__.task", lambda name: closed)
    message = _error(["category=hydrant"], monkeypatch, tmp_path)
    assert f"{place}: Permission denied; " in message
    assert remedy in message


def test_a_folder_above_the_output_that_cannot_be_made_is_of_the_output(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def closed(*_: object) -> None:
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(tmp_path / "out"))

    monkeypatch.setattr("extrap_train.__main__.task", lambda name: closed)
    options = ["extrap_train", "category=hydrant", f"output={tmp_path / 'out' / 'deep' / 'down'}"]
    monkeypatch.setattr(sys, "argv", options)
    with pytest.raises(SystemExit, match=r"out: Permission denied; .* choose another output="):
        main()


def test_a_root_that_may_not_be_looked_at_is_one_line(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Even where that is found while the options are still checked."""

    def closed(*_: object) -> None:
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), "/closed/co3d")

    monkeypatch.setattr("extrap_train.cli.validate", closed)
    options = ["category=hydrant", "data=co3d", "data.root=/closed/co3d"]
    message = _error(options, monkeypatch, tmp_path)
    assert (
        message
        == "error: /closed/co3d: Permission denied; change its rights, or name another place"
    )


@pytest.mark.parametrize("form", ["--config-dir {}", "--config-dir={}", "-cd {}"])
def test_a_category_is_added_with_one_file_in_a_folder_of_ones_own(
    form: str, own_choices: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    members: list[str] = []
    task = members.extend
    monkeypatch.setattr(
        "extrap_train.__main__.task", lambda _: lambda c, _: task(c.category.members)
    )
    flags = [word.format(own_choices) for word in form.split()]
    words = ["extrap_train", "depth=stereo", *flags, "category=mine"]  # in any order
    monkeypatch.setattr(sys, "argv", words)
    main()
    assert members == ["mine"]


def test_a_choice_that_is_in_no_folder_lists_those_of_ones_own(
    own_choices: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    message = _error([f"--config-dir={own_choices}", "category=mien"], monkeypatch, tmp_path)
    assert "did you mean mine?; known: all, apple, book, chair, cup, hydrant, mine" in message
    message = _error(["--config-dir", "/nowhere", "category=mine"], monkeypatch, tmp_path)
    assert "--config-dir /nowhere: no such folder" in message


@pytest.mark.parametrize("place", ["file", "/proc/nowhere"])
def test_an_output_that_can_be_no_folder_is_one_line(
    place: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "file").write_text("not a folder")
    output = tmp_path / place
    options = ["category=hydrant", "data.train_sequences=1", f"output={output}"]
    monkeypatch.setattr(sys, "argv", ["command", *options])
    with pytest.raises(SystemExit) as stopped:
        prepare()
    message = str(stopped.value)
    assert re.fullmatch(rf"error: {output}.*choose another (output=|folder)", message), message


def test_annotations_that_climb_out_are_refused(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    folder = tmp_path / "co3d" / "hydrant"
    folder.mkdir(parents=True)
    viewpoint = {
        "R": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
        "T": [0, 0, 5],
        "focal_length": [2, 2],
        "principal_point": [0, 0],
        "intrinsics_format": "ndc_isotropic",
    }
    frame = {
        "sequence_name": "a",
        "frame_number": 0,
        "image": {"path": "../../secret.jpg", "size": [64, 64]},
        "viewpoint": viewpoint,
    }
    sequence = {"sequence_name": "a", "category": "hydrant"}
    for name, entries in (("frame", [frame]), ("sequence", [sequence])):
        content = gzip.compress(json.dumps(entries).encode())
        (folder / f"{name}_annotations.jgz").write_bytes(content)
    options = ["category=hydrant", "data=co3d", f"data.root={tmp_path / 'co3d'}"]
    message = _error([*options, "model.start=null"], monkeypatch, tmp_path)
    assert "../../secret.jpg" in message


def test_a_start_that_is_no_model_lists_those_in_the_package(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    message = _error(["category=hydrant", "model.start=nonsense"], monkeypatch, tmp_path)
    assert "model.start=nonsense is neither a file or folder of weights" in message
    assert "nor one of the package's: base" in message


@pytest.mark.parametrize(
    ("words", "notes"),
    [
        (["data.image_size=256"], ["model.image_size=64"]),
        (["data.image_size=256", "model.image_size=128", "prep.image_size=256"], []),
        (["data.image_size=256", "task=view"], []),
        ([], []),
    ],
)
def test_photographs_larger_than_what_is_generated_are_noted(
    words: list[str],
    notes: list[str],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr("extrap_train.__main__.task", lambda _: lambda *_: None)
    monkeypatch.setattr(sys, "argv", ["it", "category=hydrant", *words])
    main()
    said = capsys.readouterr().err.splitlines()
    assert len(said) == len(notes)
    assert all(note in line for note, line in zip(notes, said, strict=True))


@pytest.mark.parametrize(
    ("words", "workers"), [(["threads=3"], 3), (["threads=3", "workers=2"], 2), ([], None)]
)
def test_data_prep_takes_threads_for_its_processes(
    words: list[str], workers: int | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[int | None] = []
    take = "data_prep.category_pairs.prepare_category"
    monkeypatch.setattr(take, lambda *_, **options: asked.append(options["workers"]))
    monkeypatch.setattr("data_prep.prep_report.write_report", lambda *_: None)
    monkeypatch.setattr(sys, "argv", ["it", "category=hydrant", *words])
    prepare()
    assert asked == [workers]


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        ("name: [vase\n", ("mine.yaml, line 2", "no valid YAML")),
        ("name: vase\n\tmembers: []\n", ("mine.yaml, line 2", "no valid YAML")),
        ("defaults: [category_schema]\ncolour: 3\n", ("category/mine.yaml", "category.colour")),
    ],
)
def test_a_choice_of_ones_own_that_is_malformed_is_one_line(
    content: str,
    expected: tuple[str, ...],
    own_choices: Path,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    (own_choices / "category/mine.yaml").write_text(content)
    message = _error([f"--config-dir={own_choices}", "category=mine"], monkeypatch, tmp_path)
    assert "\n" not in message
    assert all(text in message for text in expected), message
