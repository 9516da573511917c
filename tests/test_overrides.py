"""A text option holds what was typed, whatever Hydra's grammar would make of it."""

import random
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf

from benchmarks.catalogue import TABLE
from extrap_train.__main__ import main
from extrap_train.cli import TRAIN
from extrap_train.command_line import CommandLine, CommandOptions
from extrap_train.config import TrainConfig


def held(*words: str, command: CommandOptions = TRAIN) -> dict[str, Any]:
    """What the options of one job hold, by Hydra's parser and OmegaConf."""
    prepared = CommandLine.split(words).prepared(command)
    parsed = OverridesParser.create().parse_overrides(prepared)
    values = OmegaConf.create([override.value() for override in parsed])
    return dict(zip([each.key_or_group for each in parsed], values, strict=True))


def swept(word: str) -> list[Any]:
    """What the option holds in each job of a sweep."""
    (prepared,) = CommandLine.split(["-m", word]).prepared(TRAIN)[1:]
    override = OverridesParser.create().parse_override(prepared)
    if not override.is_sweep_override():
        return [override.value()]
    jobs = [f"{override.key_or_group}={value}" for value in override.sweep_string_iterator()]
    return [job.value() for job in OverridesParser.create().parse_overrides(jobs)]


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


def test_a_text_holds_what_was_typed() -> None:
    for text in _TEXTS:
        assert held(f"scene={text}", f"validation.lpips_weights={text}") == {
            "scene": text,
            "validation.lpips_weights": text,
        }


def test_any_text_survives() -> None:
    generator = random.Random(0)
    letters = "ab1 .,=()[]{}'\"\\$#~:;+-_/|&!?*%^é日\t"
    for _ in range(300):
        text = "".join(generator.choices(letters, k=generator.randint(1, 9)))
        if text[0] != text[-1] or text[0] not in "'\"":  # that is quoted already
            assert held(f"run={text}") == {"run": text}


@pytest.mark.parametrize(
    ("word", "value"),
    [
        ("scene=null", None),
        ('scene="null"', "null"),
        ("scene='a b'", "a b"),
        (r"scene='it\'s'", "it's"),
        ('scene="2024_05_01"', "2024_05_01"),
        ("scene=", ""),
        ("scene=''", ""),
        ("input_frames=[IMG 003 (edited).jpg]", ["IMG 003 (edited).jpg"]),
        ("input_frames=[003,1e3, true ,null.png]", ["003", "1e3", "true", "null.png"]),
        ("input_frames=[a=b,Stühle,it's,don't]", ["a=b", "Stühle", "it's", "don't"]),
        ('input_frames=["a,b.jpg",c.jpg]', ["a,b.jpg", "c.jpg"]),
        ("input_frames=[]", []),
    ],
)
def test_quotes_null_and_lists_mean_what_they_say(word: str, value: Any) -> None:
    assert list(held(word).values()) == [value]


@pytest.mark.parametrize(
    ("word", "values"),
    [
        ("run=1.10,1.1", ["1.10", "1.1"]),
        ("run=a b,Stühle (1),2024_05_01", ["a b", "Stühle (1)", "2024_05_01"]),
        ('run="a,b",c', ["a,b", "c"]),
        ("run=it's,a", ["it's", "a"]),
        ("run=choice(x,y)", ["x", "y"]),
        ("run=x=1", ["x=1"]),
        ("input_frames=[003,a b],[c]", [["003", "a b"], ["c"]]),
        ("seed=range(0,2)", [0, 1]),
        ("model.learning_rate=1e-4,3e-4", [1e-4, 3e-4]),
    ],
)
def test_commas_separate_the_jobs_of_a_sweep(word: str, values: list[Any]) -> None:
    assert swept(word) == values


def test_the_jobs_of_a_sweep_are_given_what_was_typed(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    jobs: list[TrainConfig] = []
    monkeypatch.setattr("extrap_train.__main__.task", lambda _: lambda job, _: jobs.append(job))
    words = ["it", "-m", "run=1.10,a (1)", "category=hydrant", f"output={tmp_path / 'x y=z'}"]
    monkeypatch.setattr(sys, "argv", [*words, f"hydra.sweep.dir={tmp_path / 'sweep'}"])
    main()
    assert [job.run for job in jobs] == ["1.10", "a (1)"]
    assert {job.output for job in jobs} == {f"{tmp_path}/x y=z"}


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


def test_a_table_holds_texts_as_they_were_typed() -> None:
    for text in _TEXTS:
        words = (f"output={text}", f"scoring.lpips_weights.alex={text}")
        assert list(held(*words, command=TABLE).values()) == [text, text]


@pytest.mark.parametrize(
    ("word", "value"),
    [
        ("captures.root=null", None),
        ("captures.scenes=[a b (1),2024_05_01,it's]", ["a b (1)", "2024_05_01", "it's"]),
        ('methods=["ours",inpainted]', ["ours", "inpainted"]),
        ("methods=[]", []),
        ("rules.views=[3,6]", [3, 6]),
        ("options.ours.steps=4", 4),
    ],
)
def test_other_values_of_a_table_have_their_types(word: str, value: Any) -> None:
    (read,) = held(word, command=TABLE).values()
    assert read == value


def test_a_value_that_hydra_cannot_read_is_text_for_a_method() -> None:
    (read,) = held("options.ours.weights=/a b/{category}=1/", command=TABLE).values()
    assert read == "/a b/{category}=1/"
