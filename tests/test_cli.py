"""Wrong options end with one line that says what to do, and with no run begun."""

import re
import sys
from pathlib import Path

import pytest
from in_process import refused_command

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


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ([], "category is not given"),
        (["category=hydrnt"], "did you mean hydrant?; known: all, "),
        (["category=hydrant", "data=coed"], "did you mean co3d"),
        (["category=hydrant", "experiment=smalbase"], "experiment=smalbase is unknown"),
        (["category=hydrant", "trainer.stesp=3"], "did you mean trainer.steps"),
        (["category=hydrant", "mdoel=small"], "did you mean model"),
        (["catgory=hydrant"], "no option catgory; did you mean category?"),
        (["category=hydrant", "experimnt=paper"], "no option experimnt; did you mean experiment?"),
        (["category=hydrant", "depth.planes=8"], "depth.planes is an option of depth=stereo: give"),
        (["category=hydrant", "data.set_list=dev"], "data.set_list is an option of data=co3d:"),
        (["category=hydrant", "data=uco3d"], "data=uco3d needs the folder of the captures"),
        (["category=hydrant", "depth=files"], "depth.folder=: is no folder; give depth.folder"),
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
        (
            ["category=hydrant", "task=scne"],
            "task=scne is unknown; known: category, check, complete",
        ),
        (["category=hydrant", "model.prediction=eps"], "known: epsilon, v_prediction, sample"),
        (
            ["category=hydrant", "model.image_size=96"],
            "give prep.image_size=192",
        ),
        (["category=hydrant", "model.patch=7"], "not a multiple of 56"),
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
        (["category=hydrant", "logger=wanbd"], "did you mean wandb?"),
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
def test_a_wrong_option_is_one_clear_line(arguments: list[str], said: str, tmp_path: Path) -> None:
    assert said in refused_command(arguments, tmp_path)


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
    word: str, said: str, tmp_path: Path
) -> None:
    assert refused_command(["category=hydrant", word], tmp_path) == f"error: {word}: {said}"


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
    own_choices: Path, tmp_path: Path
) -> None:
    message = refused_command([f"--config-dir={own_choices}", "category=mien"], tmp_path)
    assert "did you mean mine?; known: all, " in message
    assert ", hydrant, mine" in message
    message = refused_command(["--config-dir", "/nowhere", "category=mine"], tmp_path)
    assert "--config-dir /nowhere: no such folder" in message


def test_a_start_that_is_no_model_lists_those_in_the_package(tmp_path: Path) -> None:
    message = refused_command(["category=hydrant", "model.start=nonsense"], tmp_path)
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
        ("name: [vase\n", ("mine.yaml, line 2", "not valid YAML")),
        ("name: vase\n\tmembers: []\n", ("mine.yaml, line 2", "not valid YAML")),
        ("defaults: [category_schema]\ncolour: 3\n", ("category/mine.yaml", "category.colour")),
    ],
)
def test_a_choice_of_ones_own_that_is_malformed_is_one_line(
    content: str,
    expected: tuple[str, ...],
    own_choices: Path,
    tmp_path: Path,
) -> None:
    (own_choices / "category/mine.yaml").write_text(content)
    message = refused_command([f"--config-dir={own_choices}", "category=mine"], tmp_path)
    assert "\n" not in message
    assert all(text in message for text in expected), message
