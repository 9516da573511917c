"""What a table is told: its words, its folders, its methods; one line where they are wrong."""

import shutil
from pathlib import Path

import pytest

from benchmarks.__main__ import main
from benchmarks.catalogue import Catalogue
from benchmarks.report import lay_out_results
from benchmarks.report.aggregate import read_results
from benchmarks.run.plan import TableFolder
from benchmarks.run.run_method import build_method
from benchmarks.run_table import RunOptions, run_table
from extrap_train.errors import InputError
from tests.benchmarks.tables import greys_folder, run_greys, without_plots, write_own


@pytest.fixture
def own(tmp_path: Path) -> Path:
    return write_own(tmp_path / "own")


def test_a_capture_with_too_few_frames_is_named(own: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"apple/0000: has 8 usable frames.*picks 9"):
        run_greys(own, tmp_path, "captures.frames=8")


def test_read_only_output_is_one_line(own: Path, tmp_path: Path) -> None:
    (tmp_path / "greys").write_text("a file where the folder should be")
    with pytest.raises(InputError, match="cannot be written"):
        run_greys(own, tmp_path)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["run", "table2"], "table1"),
        (["run", "table1", "methods=[our]"], "ours"),
        (["run", "table1", "rules.veiws=[3]"], "rules.views"),
        (["run", "table1", "captures.source=c3d"], "captures.source"),
        (["run", "table1", "draws=[sprd]"], "spread"),
        (["run", "table1", "rules.draws=[all]"], "rules.draws"),
        (["run", "table1", "rules.depth=stereoo"], "rules.depth"),
        (["run", "table1", "rules.depth=files"], "folder: PATH"),
        (["run", "table1", "rules.views=[3,9]"], "rules.pool"),
        (["run", "table1", "scoring.lpips=[alx]"], "scoring.lpips"),
        (["run", "table1", "scoring.lpips_weights.alx=FILE"], "scoring.lpips_weights"),
        (["run", "table1", "columns=[psnrr]"], "columns"),
        (["run", "table1", "device=gpu"], "device"),
        (["run", "table1", "options.our.steps=3"], "ours"),
        (["run", "table1", "methods=[ours,ours]"], "methods: ours"),
        (["run", "table1", "rules.views=[3,3]"], "rules.views: 3"),
        (["run", "table1", "rules.seeds=[0,0]"], "rules.seeds: 0"),
        (["run", "table1", "captures.categories=[cup,cup]"], "captures.categories: cup"),
        (["run", "table1", "rules.draws=[given]", "draws=[given]"], "rules.draws"),
        (["run", "reconfusion", "rules.draws=[random]", "draws=[random]"], "rules.draws"),
        (["run", "table1", "reported=nonsense"], "reported"),
        (["run", "table1", "rules.image_size=0"], "rules.image_size=0"),
        (["run", "table1", "rules.fine_scale=0"], "rules.fine_scale=0"),
        (["run", "table1", "rules.views=[0]"], "rules.views"),
        (["run", "table1", "cell_timeout_s=nan"], "cell_timeout_s=nan"),
        (["run", "table1", "rules.pool=many"], "rules.pool=many"),
        (["run", "table1", "rules.pool=null"], "rules.pool=null"),
        (["run", "table1", "title"], "title: "),
        (["report", "table1", "columns=[psnr]"], "columns=[psnr]"),
        (["run", "table1", "--config-dir", "/nowhere"], "/nowhere"),
        (["report", "table1", "output=/nowhere"], "/nowhere"),
        (["verify", "/nowhere"], "/nowhere"),
    ],
)
def test_a_wrong_word_is_one_line(
    words: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(words) == 1
    message = capsys.readouterr().err
    assert message.startswith("error: ")
    assert message.count("\n") == 1
    assert said in message


def test_every_table_of_the_package_is_sound() -> None:
    """Its methods exist, its columns are metrics, its published numbers are complete.

    It shows what needs no training, names first what no input shows, and takes no depth but what
    the inputs give unless its name says that it is an oracle.
    """
    catalogue = Catalogue.with_own()
    for name in catalogue.names("table"):
        table = catalogue.table(name)
        assert table.methods[:2] == ["nearest", "inpainted"]
        assert table.columns[:2] == ["unseen_psnr", "unseen_ssim"]
        assert table.rules.is_oracle == name.endswith("_oracle")
        assert not (table.reported and "halves" in table.draws)
        for method, options in table.options.items():
            build_method(catalogue.method(method, options))
        catalogue.check(table)
        for method in table.methods:
            assert catalogue.method(method).factory
        nets = {f"lpips_{net}" for net in table.scoring.lpips}
        assert {c for c in table.columns if c.startswith("lpips")} == nets
        assert set(table.draws) <= set(table.rules.draws)
        if table.reported:
            content = catalogue.content("reported", table.reported)
            for row in content["rows"].values():
                assert all(len(v) == len(content["metrics"]) for v in row.values())


def test_a_table_extends_another(own: Path) -> None:
    (own / "table" / "more.yaml").write_text("extends: greys\nrules: {pool: 5}\nmethods: [dark]\n")
    (own / "table" / "loop.yaml").write_text("extends: loop\n")
    catalogue = Catalogue.with_own([str(own)])
    table, base = catalogue.table("more"), catalogue.table("greys")
    assert (table.name, table.rules.pool, table.methods) == ("more", 5, ["dark"])
    assert (table.rules.image_size, table.captures) == (base.rules.image_size, base.captures)
    with pytest.raises(InputError, match="extends itself"):
        catalogue.table("loop")


def test_the_oracle_table_stands_beside_the_one_with_estimated_depth(
    own: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """In every format and in the same form, from the moment that there are both results."""
    (own / "table" / "greys_oracle.yaml").write_text("extends: greys\n")
    catalogue = Catalogue.with_own([str(own)])
    small = ["methods=[dark]", f"output={tmp_path}", "rules.pool=4"]
    for name, depth in (("greys", "stereo"), ("greys_oracle", "dataset")):
        table = catalogue.table(name, [*small, f"rules.depth={depth}"])
        with without_plots():
            assert run_table(table, catalogue, RunOptions(quick=True, workers=1)) == 0
    said = capsys.readouterr().out
    assert said.count("estimated from the inputs (stereo)") == 2  # of greys, and beside the oracle
    main(["report", "greys", f"output={tmp_path}", "--config-dir", str(own)])
    for name in ("greys", "greys_oracle"):
        for file in (f"{name}.md", f"{name}.tex", "index.html"):
            text = (tmp_path / name / file).read_text()
            both = [text.index(w) for w in ("inputs (stereo)", "oracle: depth of the data set")]
            assert (both[0] < both[1]) == (name == "greys")
    shutil.rmtree(tmp_path / "greys" / "cells")
    results = read_results(TableFolder(tmp_path / "greys_oracle"))
    assert results.counterpart().cells == []
    (tmp_path / "greys" / "plan.json").write_text("{")
    assert lay_out_results(results, catalogue).beside == []


def test_the_readmes_method_runs_as_it_stands(tmp_path: Path) -> None:
    """The file and the YAML, taken from the text."""
    text = (Path(__file__).parents[2] / "README.md").read_text()
    source = text.split("```python\n# mine/blur.py\n")[1].split("```")[0]
    assert len(source.splitlines()) <= 20
    yaml = text.split("mkdir -p mine/method && printf '")[1].split("'")[0].replace("\\n", "\n")
    own = write_own(tmp_path / "own")
    (own / "blur.py").write_text(source)
    (own / "method" / "average.yaml").write_text(yaml)
    assert run_greys(own, tmp_path / "out", "methods=[average]", quick=True) == 0
    assert read_results(greys_folder(tmp_path / "out")).cells[0].status == "ok"


def test_slurm_takes_the_clusters_options_and_says_where_there_is_none(
    own: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    words = ["run", "greys", "--slurm", "slurm.partition=gpu", "--config-dir", str(own)]
    assert main([*words, f"output={tmp_path / 'out'}"]) == 1
    assert "there is no sbatch on this machine" in capsys.readouterr().err
    assert main([*words, "slurm.partitoin=gpu"]) == 1
    assert "did you mean slurm.partition" in capsys.readouterr().err
