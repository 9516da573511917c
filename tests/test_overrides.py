"""A text option holds what was typed, whatever Hydra's grammar would make of it."""

import random
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest

from extrap_train.__main__ import main
from extrap_train.cli import TRAIN
from extrap_train.config import TrainConfig
from extrap_train.overrides import CommandLine

Composed = Callable[..., list[TrainConfig]]


@pytest.fixture
def composed(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Composed:
    """The configurations that the jobs of a command line are given."""

    def run(*words: str) -> list[TrainConfig]:
        jobs: list[TrainConfig] = []
        monkeypatch.setattr("extrap_train.__main__.task", lambda _: jobs.append)
        where = [f"hydra.sweep.dir={tmp_path / 'sweep'}"]
        monkeypatch.setattr(sys, "argv", ["it", "category=hydrant", *words, *where])
        main()
        return jobs

    return run


_TEXTS = (
    *("2024_05_01", "1.10", "1e3", "003", "0x10", "1_000", "nan", "inf", "+5", "-3"),
    *("nullable", "Null", "NULL", "none", "true", "Off", "yes", "~", "null.jpg"),
    *("captures/Stühle", "bike (1)", "a=b", "it's", "x#1", "a,b", "日本", "~/x", "$HOME/x"),
    *(
        "${oc.env:HOME}",
        "a${b}",
        r"\${b}",
        r"a\\${b}",
        "C:\\new\\table",
        "a\\",
        "end\\\\",
        '6" tall',
    ),
    *(
        "a b",
        " a ",
        "[a]",
        "{a: 1}",
        "f(x)",
        "choice(a,b)",
        "a:b",
        "a;b|c&d",
        "%d",
        "é\u0301",
        "a\tb",
    ),
    *(
        """it's 6" tall""",
        "co3d:/x y/apple/12_34",
        "IMG 003 (edited).jpg",
        "a'b'c",
        "a\nb",
        "?",
        "*",
    ),
)


@pytest.mark.parametrize("text", _TEXTS)
def test_a_text_holds_what_was_typed(text: str, composed: Composed) -> None:
    (config,) = composed(
        f"scene={text}", f"run={text}", f"output={text}", f"validation.lpips_weights={text}"
    )
    assert [config.scene, config.run, config.output] == [text] * 3
    assert config.validation.lpips_weights == text


def test_any_text_survives(composed: Composed) -> None:
    generator = random.Random(0)
    letters = "ab1 .,=()[]{}'\"\\$#~:;+-_/|&!?*%^é日\t"
    keys = ("scene", "run", "pose", "adapter")
    for _ in range(20):
        texts = ["".join(generator.choices(letters, k=generator.randint(1, 9))) for _ in range(4)]
        texts = [t for t in texts if t[0] != t[-1] or t[0] not in "'\""]  # those are quoted already
        words = [f"{key}={t}" for key, t in zip(keys, texts, strict=False)]
        (config,) = composed(*words)
        held = [config.scene, config.run, config.pose, config.adapter]
        assert held[: len(texts)] == texts


@pytest.mark.parametrize(
    ("word", "held"),
    [
        ("scene=null", None),
        ('scene="null"', "null"),
        ("scene='a b'", "a b"),
        (r"scene='it\'s'", "it's"),
        ('scene="2024_05_01"', "2024_05_01"),
        ("scene=", ""),
        ("scene=''", ""),
    ],
)
def test_quotes_of_ones_own_and_null_mean_what_they_did(
    word: str, held: str | None, composed: Composed
) -> None:
    (config,) = composed(word)
    assert config.scene == held


@pytest.mark.parametrize(
    ("typed", "held"),
    [
        ("[IMG 003 (edited).jpg]", ["IMG 003 (edited).jpg"]),
        ("[003,1e3, true ,null.png]", ["003", "1e3", "true", "null.png"]),
        (
            "[a=b.jpg,Stühle.jpg,it's.jpg,don't.jpg]",
            ["a=b.jpg", "Stühle.jpg", "it's.jpg", "don't.jpg"],
        ),
        ('["a,b.jpg",c.jpg]', ["a,b.jpg", "c.jpg"]),
        ("[]", []),
    ],
)
def test_a_list_of_texts_holds_what_was_typed(
    typed: str, held: list[str], composed: Composed
) -> None:
    (config,) = composed(f"input_frames={typed}")
    assert config.input_frames == held


@pytest.mark.parametrize(
    ("word", "held"),
    [
        ("run=1.10,1.1", ["1.10", "1.1"]),
        ("run=a b,Stühle (1),2024_05_01", ["a b", "Stühle (1)", "2024_05_01"]),
        ('run="a,b",c', ["a,b", "c"]),
        ("run=it's,a", ["it's", "a"]),
        ("run=choice(x,y)", ["x", "y"]),
        ("run=x=1", ["x=1"]),
    ],
)
def test_commas_separate_the_jobs_of_a_sweep(
    word: str, held: list[str], composed: Composed
) -> None:
    assert [config.run for config in composed("-m", word)] == held


def test_lists_of_texts_are_swept_whole(composed: Composed) -> None:
    jobs = composed("-m", "input_frames=[003,a b],[c]")
    assert [config.input_frames for config in jobs] == [["003", "a b"], ["c"]]


def test_numbers_and_choices_are_swept_as_before(composed: Composed) -> None:
    jobs = composed("-m", "seed=range(0,2)", "model.learning_rate=1e-4,3e-4", "depth=stereo")
    assert [(c.seed, c.model.learning_rate) for c in jobs] == [
        (0, 1e-4),
        (0, 3e-4),
        (1, 1e-4),
        (1, 3e-4),
    ]


@pytest.mark.parametrize("words", [("scene=a b", "run=1.10"), ("-m", "run=a b,c d", "seed=0,1")])
def test_what_is_prepared_is_prepared_already(words: Sequence[str]) -> None:
    """Processes that train one model together are started with the first one's words."""
    once = CommandLine.split(words).prepared(TRAIN)
    assert CommandLine.split(once).prepared(TRAIN) == once


def test_an_entry_of_a_mapping_is_text(monkeypatch: pytest.MonkeyPatch) -> None:
    from data_prep.__main__ import main as prepare  # the command that has one

    held = []
    monkeypatch.setattr("data_prep.__main__._run", held.append)
    words = ["category=hydrant", "launcher=slurm", "launcher.directives.constraint=1e3"]
    monkeypatch.setattr(sys, "argv", ["it", *words])
    prepare()
    assert held[0].launcher.directives == {"constraint": "1e3"}
