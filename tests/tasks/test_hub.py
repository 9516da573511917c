"""Models of the hub: pushed with a card, downloaded once, and found again without a network."""

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from hub_server import Hub, serve_hub
from huggingface_hub import ModelCard
from in_process import refused_command, run_command
from opened_runs import hydrant_config
from runs_of_hub import finished_run

from benchmarks.methods.base import Unavailable
from benchmarks.methods.diffusion import Diffusion
from benchmarks.protocol.captures import trained_models
from extrap_train.__main__ import main
from extrap_train.config import MethodConfig, packaged_names
from extrap_train.diffusion import hub as hub_module
from extrap_train.diffusion.hub import is_repository
from extrap_train.diffusion.leakage import trainings_of
from extrap_train.diffusion.model_files import initial_model, load_model, saved_config
from extrap_train.errors import InputError
from extrap_train.runs import run_manifest
from extrap_train.tasks.category import _model
from extrap_train.tasks.model_card import _licence_of, model_card
from extrap_train.tasks.scene_model import UsedWeights

_PUSHED = "me/small.hydrants-v1.5"
_ASK = """
import sys
from extrap_train.diffusion.hub import weights_folder
from extrap_train.errors import InputError
for name in sys.argv[1:]:
    try:
        print(weights_folder(name, "weights"))
    except InputError as error:
        print(f"error: {error}")
"""


def _ask(hub: Hub, cache: Path, *names: str) -> list[str]:
    """The folder of each, or why there is none, in a process that reads its own environment."""
    environment = os.environ | {"HF_ENDPOINT": hub.address, "HF_HOME": str(cache)}
    command = [sys.executable, "-c", _ASK, *names]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


def _use_hub(hub: Hub, cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let this process download from a hub, into a cache of its own."""
    template = f"{hub.address}/{{repo_id}}/resolve/{{revision}}/{{filename}}"
    monkeypatch.setattr("huggingface_hub.constants.ENDPOINT", hub.address)
    monkeypatch.setattr("huggingface_hub.constants.HUGGINGFACE_CO_URL_TEMPLATE", template)
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(cache))


def test_a_pushed_model_is_loaded_from_a_clean_cache_and_again_without_the_hub(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run, cache = finished_run(tmp_path / "private_place"), tmp_path / "cache"
    with serve_hub() as hub:
        words = ["task=push", "category=hydrant", f"weights={run.path}", f"repo={_PUSHED}"]
        monkeypatch.setattr("huggingface_hub.constants.ENDPOINT", hub.address)
        said = run_command(main, *words)
        assert hub.private == {_PUSHED}
        commit, files = hub.newest(_PUSHED)
        assert f"weights={_PUSHED}@{commit}" in said
        later = hub.add(_PUSHED, {"README.md": b"# other words"})
        hub.add("me/pickles", {"pytorch_model.bin": b"\x80", "config.json": b"{}"})
        names = [_PUSHED, f"{_PUSHED}@{commit}", "me/pickles", "me/none", f"{_PUSHED}@v9"]
        newest, pinned, pickles, nobody, unknown = _ask(hub, cache, *names)
        assert [Path(newest).name, Path(pinned).name] == [later, commit]
        assert "no model of this project" in pickles
        assert "no such repository" in nobody
        assert "no revision v9" in unknown
        assert not any(name.endswith(".bin") for name in hub.downloads)
    again, missing = _ask(hub, cache, f"{_PUSHED}@{commit}", "me/none")
    assert again == pinned
    assert "cannot be reached" in missing

    wanted, found = load_model(run.model), load_model(Path(pinned))
    assert torch.equal(found.unet.conv_in.weight, wanted.unet.conv_in.weight)
    assert not any(path.suffix == ".md" for path in Path(pinned).rglob("*"))
    _check_card(files["README.md"].decode())
    assert not any(b"private_place" in content for content in files.values())
    assert "model/pickle.bin" not in files
    assert json.loads(files["manifest.json"])["split"]["hydrant"]["train"] == ["0001"]


def _check_card(text: str) -> None:
    card = ModelCard(text)
    assert card.data.license == "other"  # it started from weights of others
    for said in ("zeronvs.ckpt", "its authors", "| steps | 7 |", "1 captures", "| model | 24 |"):
        assert said in card.text


def test_the_manifest_that_is_pushed_has_what_local_starts_have_seen(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = finished_run(tmp_path / "first")
    second = finished_run(tmp_path / "second", start=first.model, capture="0002")
    with serve_hub() as hub:
        monkeypatch.setattr("huggingface_hub.constants.ENDPOINT", hub.address)
        words = ["task=push", "category=hydrant", f"weights={second.model}", "repo=me/second"]
        run_command(main, *words)
    _, files = hub.newest("me/second")
    assert json.loads(files["extrapolation_model.json"])["start"] == "local:model"
    assert json.loads(files["manifest.json"])["split"]["hydrant"]["train"] == ["0001", "0002"]


def _push(hub: Hub, monkeypatch: pytest.MonkeyPatch, weights: object, repo: str) -> str:
    monkeypatch.setattr("huggingface_hub.constants.ENDPOINT", hub.address)
    return run_command(main, "task=push", "category=hydrant", f"weights={weights}", f"repo={repo}")


def test_a_second_push_leaves_nothing_of_the_first_model(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = finished_run(tmp_path)
    with serve_hub() as hub:
        _push(hub, monkeypatch, "ours-hydrant", "me/twice")
        hub.add("me/twice", {"results/picture.png": b"\x89"})
        assert {"difference.safetensors", "manifest.json"} <= hub.newest("me/twice")[1].keys()
        (run.path / "manifest.json").unlink()
        _push(hub, monkeypatch, run.model, "me/twice")
    _, files = hub.newest("me/twice")
    assert "unet/diffusion_pytorch_model.safetensors" in files
    assert not {"difference.safetensors", "manifest.json"} & files.keys()
    assert {".gitattributes", "results/picture.png"} <= files.keys()


def test_a_model_whose_starts_would_be_forgotten_is_not_pushed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = finished_run(tmp_path / "first")
    second = finished_run(tmp_path / "second", start=first.model, capture="0002")
    (second.path / "manifest.json").unlink()
    with serve_hub() as hub:
        monkeypatch.setattr("huggingface_hub.constants.ENDPOINT", hub.address)
        words = ["task=push", "category=hydrant", f"weights={second.model}", "repo=me/second"]
        assert "manifest.json" in refused_command(words, tmp_path)
    assert "extrapolation_model.json" not in hub.newest("me/second")[1]


def test_a_downloaded_model_is_pushed_again_with_its_record(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = finished_run(tmp_path / "own")
    run.model.rename(tmp_path / "snapshot")
    (run.path / "manifest.json").rename(tmp_path / "snapshot" / "manifest.json")
    with serve_hub() as hub:
        _push(hub, monkeypatch, tmp_path / "snapshot", "me/again")
    _, files = hub.newest("me/again")
    assert json.loads(files["manifest.json"])["split"]["hydrant"]["train"] == ["0001"]
    assert "1 captures" in files["README.md"].decode()


def test_a_card_says_what_the_starts_were_trained_on(tmp_path: Path) -> None:
    first = finished_run(tmp_path / "first", start="base")
    second = finished_run(tmp_path / "second", start=first.model, capture="0002")
    assert ModelCard(model_card(second.model, "me/x", 7)).data.license == "apache-2.0"
    record = first.path / "manifest.json"
    record.write_text(record.read_text().replace("synthetic", "co3d"))
    card = ModelCard(model_card(second.model, "me/x", 7))
    assert card.data.license == "other"
    assert "CO3D (CC BY-NC 4.0)" in card.text
    assert "an earlier model" in card.text
    record.unlink()
    assert ModelCard(model_card(second.model, "me/x", 7)).data.license == "other"


@pytest.fixture
def downloaded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder that `me/downloaded` is cached in, with its run's manifest within."""
    run = finished_run(tmp_path)
    (run.path / "manifest.json").rename(run.model / "manifest.json")
    known = {"me/downloaded": run.model}

    def download(name: str, option: str) -> Path:
        if (repository := name.partition("@")[0]) not in known:
            raise InputError(f"{option}={name}: cannot be reached")
        return known[repository]

    monkeypatch.setattr(hub_module, "_download", download)
    return run.model


def test_results_and_trainings_follow_from_the_content_of_a_repository(
    downloaded: Path, tmp_path: Path
) -> None:
    config = hydrant_config(tmp_path)
    used = UsedWeights.of(replace(config, weights="me/downloaded"))
    assert (used.name, used.is_packaged, used.steps) == ("me/downloaded", False, None)
    started = replace(config, model=replace(config.model, start="me/downloaded"))
    started.category.members = []
    assert run_manifest(started, []).inputs == {"model.start": used.sha256}
    (training,) = trainings_of("me/downloaded")
    assert (training.model, training.split.train) == ("me/downloaded", ("0001",))
    model = initial_model(replace(saved_config(downloaded), start="me/downloaded"))
    assert torch.equal(model.unet.conv_in.weight, load_model(downloaded).unet.conv_in.weight)


def test_what_other_tools_add_to_a_download_changes_nothing(
    downloaded: Path, tmp_path: Path
) -> None:
    config = replace(hydrant_config(tmp_path), weights="me/downloaded")
    before = UsedWeights.of(config).sha256
    (downloaded / "README.md").write_text("# a card")
    assert UsedWeights.of(config).sha256 == before
    files = Diffusion(weights="me/downloaded").weight_files("cup")
    assert downloaded / "README.md" not in files


def test_a_start_of_the_hub_is_saved_with_its_commit(downloaded: Path, tmp_path: Path) -> None:
    config = hydrant_config(tmp_path)
    config.model = replace(saved_config(downloaded), start="me/downloaded")
    assert _model(config).config.start == f"me/downloaded@{downloaded.name}"


def test_weights_that_are_not_there_make_a_row_unavailable_and_no_error(
    downloaded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "outputs").mkdir()
    for weights in ("me/nobody", "outputs/typo"):
        method = MethodConfig("ours", factory="a.B", options={"weights": weights})
        assert trained_models([method], ["cup"]) == []
        with pytest.raises(Unavailable):
            Diffusion(weights=weights).weight_files("cup")


def test_a_start_that_cannot_be_asked_what_it_has_seen_is_named_with_its_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, downloaded: Path
) -> None:
    run = finished_run(tmp_path / "own", start="me/nobody")
    method = MethodConfig("ours", factory="a.B", options={"weights": str(run.model)})
    with pytest.raises(InputError, match=r"extrapolation_model\.json: start=me/nobody"):
        trained_models([method], ["cup"])


def test_a_table_compares_a_repository(downloaded: Path) -> None:
    assert downloaded / "extrapolation_model.json" in Diffusion(
        weights="me/downloaded"
    ).weight_files("cup")
    with pytest.raises(Unavailable, match="cannot be reached"):
        Diffusion(weights="me/{category}s").weight_files("cup")


@pytest.mark.parametrize(
    "card",
    ["---\n- a\n---\n", "---\nlicense: [\n---\n", "---\n1: 2\n---\n", "---\nmodel-index: 3\n---\n"],
)
def test_a_start_with_a_broken_card_has_no_known_licence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, card: str
) -> None:
    with serve_hub() as hub:
        _use_hub(hub, tmp_path, monkeypatch)
        hub.add("me/start", {"README.md": card.encode()})
        assert _licence_of("me/start") == "the licence that its page names"


def test_paths_and_files_are_no_repositories(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "runs" / "mine").mkdir(parents=True)
    assert all(map(is_repository, ["a/b", "a/b@main", "org-1/v1.5@refs/pr/1"]))
    assert is_repository("runs/mistyped@main")
    others = [
        "runs/mine",
        "runs/mistyped",
        "./b",
        "../b",
        "/a/b",
        "a/b/c",
        "runs/b.ckpt",
        "a/b@",
        *packaged_names(),
    ]
    assert not any(map(is_repository, others))


def test_a_push_without_a_place_or_of_no_model_is_one_line(tmp_path: Path) -> None:
    said = refused_command(["task=push", "category=hydrant", "weights=base"], tmp_path)
    assert "repo=org/name" in said
    words = ["task=push", "category=hydrant", f"weights={tmp_path}", "repo=me/x"]
    assert "not a model of this project" in refused_command(words, tmp_path)
