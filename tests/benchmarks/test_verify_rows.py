"""A row is what it is called: relabelled, dropped and damaged results are noticed."""

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from benchmarks.__main__ import main
from benchmarks.protocol.prepared_scene import Scene
from benchmarks.report import verify as verification
from benchmarks.report.verify import verify
from benchmarks.score import Score
from extrap_train.errors import InputError
from tests.benchmarks.tables import greys_folder

Edit = Callable[[dict[str, Any]], Any]


@pytest.fixture(scope="module", autouse=True)
def _scored_once() -> Iterator[None]:
    """Pictures stay as they are in these tests: so do their scores."""
    known: dict[tuple[object, ...], dict[str, Score]] = {}
    score_files = verification.score_files

    def score(folder: Path, images: Any, points: Any, scene: Scene, scoring: Any) -> Any:
        key = (*images.values(), *points.values(), scene.data_hash, repr(scoring))
        if key not in known:
            known[key] = score_files(folder, images, points, scene, scoring)
        return known[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("benchmarks.report.verify.score_files", score)
        yield


def _edit(file: Path, edit: Edit) -> None:
    content = json.loads(file.read_text())
    edit(content)
    file.write_text(json.dumps(content))


def _cell_of(copy: Path, method: str) -> Path:
    files = copy.glob("greys/cells/*/cell.json")
    return next(file for file in files if json.loads(file.read_text())["method"] == method)


def test_a_result_under_another_name_is_noticed(copy: Path) -> None:
    """Everything that is scored stays as it was; only what it is called changes."""
    relabelled = {"method": "light", "n_views": 6, "category": "chair"}
    _edit(_cell_of(copy, "dark"), lambda cell: cell.update(relabelled, seed=1))
    said = "\n".join(verify(greys_folder(copy)).problems)
    assert "options.level (was 0.2, now 0.6)" in said
    assert "states n_views 6, its photographs are of 3" in said
    assert "states category chair, its photographs are of apple" in said
    assert "states seed 1, its photographs are of 0" in said
    assert "dark on apple-000" in said
    assert "there is no cell of it" in said
    assert "has 2 cells" in said


def test_options_of_a_row_that_the_images_were_not_made_with_are_noticed(copy: Path) -> None:
    folder = greys_folder(copy)
    stated = {"options.level": 0.9}
    _edit(_cell_of(copy, "dark"), lambda cell: cell["made_from"]["options"].update(stated))
    said = "\n".join(verify(folder).problems)
    assert "options.level (was 0.9, now 0.2)" in said
    assert "its name does not follow" in said
    _edit(folder.plan, lambda plan: plan["methods"]["dark"]["options"].update(level=0.7))
    assert sum("options.level" in problem for problem in verify(folder).problems) == 2
    _edit(folder.plan, lambda plan: plan["table"]["options"].update(light={"level": 0.7}))
    said = "\n".join(verify(folder).problems)
    assert "light was not made with the options that its table gives" in said


def _swap_titles(plan: dict[str, Any]) -> None:
    dark, light = plan["methods"]["dark"], plan["methods"]["light"]
    dark["title"], light["title"] = light["title"], dark["title"]


@pytest.mark.parametrize(
    "edit",
    [
        _swap_titles,
        lambda plan: plan["methods"]["dark"].update(group="the best"),
        lambda plan: plan["methods"]["dark"].update(time="per image"),
        lambda plan: plan["table"].update(title="Results on CO3D"),
        lambda plan: plan["table"].update(reported="megascenes"),
        lambda plan: plan.pop("sha256"),
    ],
)
def test_what_the_report_would_say_of_a_row_is_noticed(edit: Edit, copy: Path) -> None:
    """No cell states it, and every number stays as it was."""
    folder = greys_folder(copy)
    _edit(folder.plan, edit)
    (problem,) = verify(folder).problems
    assert str(folder.plan) in problem


def test_a_cell_that_the_plan_has_lost_is_missed(copy: Path) -> None:
    folder = greys_folder(copy)
    _edit(folder.plan, lambda plan: plan["cells"].pop())
    problems = verify(folder).problems
    assert sum("there is no cell of it" in problem for problem in problems) == 1
    _edit(folder.plan, lambda plan: plan["methods"].pop("light"))
    with pytest.raises(InputError, match="is of light, and the table has no such row"):
        verify(folder)


def test_a_missing_csv_file_is_noticed(copy: Path) -> None:
    (greys_folder(copy).path / "greys_images.csv").unlink()
    (problem,) = verify(greys_folder(copy)).problems
    assert "greys_images.csv: is missing; `benchmark report greys` writes it" in problem


def test_a_plan_that_does_not_say_what_made_its_rows_is_refused(copy: Path) -> None:
    _edit(greys_folder(copy).plan, lambda plan: plan["methods"]["dark"].pop("factory"))
    with pytest.raises(InputError, match=r"plan\.json: does not say what made its rows"):
        verify(greys_folder(copy))


@pytest.mark.parametrize(
    "edit",
    [
        lambda plan: plan.update(table={}),
        lambda plan: plan.update(table=[]),
        lambda plan: plan["table"].update(name="../elsewhere"),
        lambda plan: plan["table"].update(captures=3),
        lambda plan: plan["table"].update(title=3),
        lambda plan: plan.update(cells=[3]),
        lambda plan: plan.update(cells=["../../elsewhere"]),
        lambda plan: plan.update(cells=2 * plan["cells"]),
        lambda plan: plan.update(methods={"dark": "dark"}),
        lambda plan: plan.update(protocol=None),
        lambda plan: plan.pop("quick"),
    ],
)
def test_a_damaged_plan_is_one_line(
    edit: Edit, copy: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    _edit(greys_folder(copy).plan, edit)
    assert main(["verify", str(greys_folder(copy).path)]) == 1
    _require_line(capsys.readouterr().err, "plan.json: ")


@pytest.mark.parametrize(
    "edit",
    [
        lambda cell: cell.update(made_from={}),
        lambda cell: cell["made_from"].pop("inputs"),
        lambda cell: cell.update(scored_from=[]),
        lambda cell: cell.update(images=[]),
        lambda cell: cell.update(images={"../0.png": ""}),
        lambda cell: cell.update(points=3),
        lambda cell: cell.update(metrics={"psnr": 3.0}),
        lambda cell: cell["metrics"]["psnr"].update(per_image=3),
        lambda cell: cell["metrics"]["psnr"].update(reason=3),
        lambda cell: cell.update(seconds="3"),
        lambda cell: cell.update(scene="../scenes"),
        lambda cell: cell.update(n_views="3"),
        lambda cell: cell.update(status="fine"),
        lambda cell: cell.update(status=[]),
        lambda cell: cell.pop("protocol"),
    ],
)
def test_a_damaged_cell_is_one_line(
    edit: Edit, copy: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    _edit(_cell_of(copy, "dark"), edit)
    assert main(["verify", str(greys_folder(copy).path)]) == 1
    _require_line(capsys.readouterr().err, "cell.json: ")


def _require_line(message: str, said: str) -> None:
    assert message.startswith("error: ")
    assert message.count("\n") == 1
    assert said in message
