"""Results from elsewhere are data: damage is one line that names the file, and every report escapes
what it shows.
"""

import hashlib
import io
import json
import os
import random
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from PIL import Image

from benchmarks.__main__ import main
from benchmarks.protocol.array_files import MAX_POINTS, read_points
from extrap_train.errors import InputError
from tests.benchmarks.tables import greys_folder


def _png(mode: str, size: tuple[int, int], kind: str = "png") -> bytes:
    content = io.BytesIO()
    Image.new(mode, size).save(content, kind)
    return content.getvalue()


def _npy(array: np.ndarray) -> bytes:
    content = io.BytesIO()
    np.save(content, array, allow_pickle=True)
    return content.getvalue()


def _claiming(shape: tuple[int, ...]) -> bytes:
    content = io.BytesIO()
    header = {"descr": "<f4", "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(content, header)
    return content.getvalue()


def _stating(header: bytes) -> bytes:
    """An NPY file with this header and no numbers."""
    return b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header


def _edit(file: Path, edit: Callable[[Any], Any]) -> None:
    content = json.loads(file.read_text())
    edit(content)
    file.write_text(json.dumps(content))


def _stated(record: Path, kind: str, name: str, file: Path, content: bytes) -> None:
    """Put a file in place whose hash its record states."""
    file.write_bytes(content)
    digest = hashlib.sha256(content).hexdigest()
    _edit(record, lambda entries: entries[kind].update({name: digest}))


def _picture(content: bytes) -> Callable[[Path, Path], Path]:
    def damage(cell: Path, scene: Path) -> Path:
        _stated(cell / "cell.json", "images", "0.png", cell / "0.png", content)
        return cell / "0.png"

    return damage


def _truth(name: str, content: bytes) -> Callable[[Path, Path], Path]:
    def damage(cell: Path, scene: Path) -> Path:
        record = scene / "scene.json"
        truth = scene.parents[1] / "truths" / scene.name / name
        _stated(record, "files", name, truth, content)
        data = _data_hash(scene)
        for file in cell.parent.glob("*/cell.json"):
            _edit(file, lambda entries: entries["made_from"]["inputs"].update(photographs=data))
        return truth

    return damage


def _data_hash(scene: Path) -> str:
    from benchmarks.protocol.prepared_scene import Scene

    return Scene.open(scene).data_hash


def _entry(name: str, value: Any) -> Callable[[Path, Path], Path]:
    def damage(cell: Path, scene: Path) -> Path:
        _edit(scene / "scene.json", lambda entries: entries.update({name: value}))
        return scene / "scene.json"

    return damage


def _whole(content: bytes) -> Callable[[Path, Path], Path]:
    def damage(cell: Path, scene: Path) -> Path:
        (cell / "cell.json").write_bytes(content)
        return cell / "cell.json"

    return damage


def _pipe(cell: Path, scene: Path) -> Path:
    (cell / "0.png").unlink()
    os.mkfifo(cell / "0.png")
    return cell / "0.png"


DAMAGE = {
    "gray": _picture(_png("L", (24, 24))),
    "small": _picture(_png("RGB", (1, 1))),
    "huge": _picture(_png("1", (14_000, 14_000))),
    "postscript": _picture(_png("RGB", (24, 24), "eps")),
    "jpeg": _picture(_png("RGB", (24, 24), "jpeg")),
    "pipe": _pipe,
    "text_array": _truth("truth/depth.npy", _npy(np.array(["a"]))),
    "pickle": _truth("truth/depth.npy", _npy(np.array([{}], dtype=object))),
    "claim": _truth("truth/depth.npy", _claiming((6, 24, 10**12))),
    "unclosed": _truth("truth/depth.npy", _stating(b"{'shape': " + b"(" * 50)),
    "nested": _truth("truth/depth.npy", _stating(b"{'shape': " + b"(" * 5000 + b")" * 5000)),
    "endless": _truth("truth/object.npy", _stating(b"{'shape': (" + b"9" * 5000 + b",)}")),
    "other_shape": _truth("truth/object.npy", _npy(np.zeros((5, 2), np.float32))),
    "nan": _truth("truth/object.npy", _npy(np.full((5, 3), np.nan, np.float32))),
    "draw": _entry("draw", None),
    "angles": _entry("angles_rad", None),
    "few_angles": _entry("angles_rad", [0.1]),
    "files": _entry("files", None),
    "no_files": _entry("files", {}),
    "outside": _entry("files", {"../../plan.json": "0"}),
    "cameras": _entry("inputs", {}),
    "no_cameras": _entry("targets", []),
    "size": _entry("image_size", 10**9),
    "deep": _whole(b"[" * 20_000),
    "deep_options": _whole(b'{"options": ' * 5_000),
    "surrogate": _whole(b'{"key": "\\ud800"}'),
    "number": _whole(b"1e999"),
}


@pytest.mark.parametrize("name", DAMAGE)
def test_a_damaged_file_is_one_line(
    name: str, copy: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = greys_folder(copy)
    cell = folder.cells / json.loads(folder.plan.read_text())["cells"][0]  # is read first
    scene = folder.scenes / json.loads((cell / "cell.json").read_text())["scene"]
    file = DAMAGE[name](cell, scene)
    commands = [["verify", str(folder.path)]]
    if name in ("gray", "angles", "text_array"):
        own = ["--config-dir", str(_own(copy))]
        commands.append(["report", "greys", f"output={copy}", "--format", "html", *own])
    for command in commands:
        status, said = main(command), capsys.readouterr().err
        assert status == 1
        assert said.startswith("error: ")
        assert said.count("\n") == 1
        assert file.name in said


def _own(copy: Path) -> Path:
    """A folder with the table's YAML alone: its methods are not asked."""
    folder = copy / "own" / "table"
    folder.mkdir(parents=True, exist_ok=True)
    text = "title: Greys\nmethods: [dark]\ncaptures: {source: synthetic, categories: [apple]}\n"
    (folder / "greys.yaml").write_text(text)
    return folder.parent


def test_reports_escape_what_they_show(copy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = greys_folder(copy)
    script = "</script><!--<script>alert(1)</script>"

    def edit(plan: Any) -> None:
        plan["table"]["title"] = "${oc.env:HOME} $\\frac{ \x00 " + script
        plan["methods"]["dark"] |= {"title": f"a|b|{script}", "time": "x\n\\input{/etc/passwd}"}
        plan["methods"]["light"] |= {"title": "[a](javascript:b) `c` *d* =1+1", "group": "\n\n# x"}

    _edit(folder.plan, edit)
    for file in folder.cells.glob("*/cell.json"):
        _edit(file, lambda cell: cell["given"].update(init="=cmd()|x\n\\input{y}"))
        _edit(file, lambda cell: cell["metrics"]["lpips_alex"].update(reason="=1+1\n<b>"))
    assert main(["report", "greys", f"output={copy}", "--config-dir", str(_own(copy))]) == 0
    capsys.readouterr()
    text = {kind: (folder.path / f"greys.{kind}").read_text() for kind in ("md", "tex", "csv")}
    page = (folder.path / "index.html").read_text()
    for content in (*text.values(), page):
        assert os.environ["HOME"] + " " not in content
        assert "\x00" not in content
    assert not any(line.lstrip().startswith(r"\input") for line in text["tex"].splitlines())
    rows = [line for line in text["md"].splitlines() if line.startswith("| ")]
    assert len({line.replace(r"\|", "").count("|") for line in rows if "24" not in line}) <= 3
    assert "<script" not in text["md"]
    assert "alert(1)</script" not in page
    assert r"\[a\](" in text["md"]
    assert page.count("<script") == 2
    assert "<!--" not in page.split('<script id="data"')[1]
    reasons = pd.read_csv(folder.path / "greys.csv")["reason"].dropna()
    assert not reasons.str.startswith(("=", "+", "-", "@")).any()
    assert not reasons.str.contains("\n").any()


@pytest.mark.parametrize(
    "header",
    [
        "format ascii 1.0\nelement vertex 99999999999999\nproperty float x\n",
        "format binary_little_endian 1.0\nelement vertex 1000000000\nproperty float x\n",
        "format ascii 1.0\nelement vertex 1\nproperty float x\nelement face 9999999999999\n",
        "format ascii 1.0\nelement vertex x\n",
    ],
)
def test_a_cloud_that_claims_more_points_than_it_holds_is_refused(
    header: str, tmp_path: Path
) -> None:
    (tmp_path / "cloud.ply").write_text(f"ply\n{header}end_header\n0 0 0\n")
    assert MAX_POINTS < 10**9
    with pytest.raises(InputError, match=r"cloud\.ply"):
        read_points(tmp_path / "cloud.ply")


_ODD = (None, [], {}, "", "x", "\ud800", "../x", -1, 0, 10**30, 1e308, -0.5, True, [[1]], {"a": {}})


def _mutate_json(value: Any, rng: random.Random) -> Any:
    """One entry somewhere in a JSON value replaced, removed or doubled."""
    if isinstance(value, dict) and value and rng.random() < 0.9:
        key = rng.choice(sorted(value))
        changed = dict(value)
        if rng.random() < 0.15:
            del changed[key]
        else:
            changed[key] = _mutate_json(value[key], rng)
        return changed
    if isinstance(value, list) and value and rng.random() < 0.9:
        index = rng.randrange(len(value))
        if rng.random() < 0.2:
            return value[:index] + value[index + rng.choice((0, 1)) :] * rng.choice((1, 2))
        return [*value[:index], _mutate_json(value[index], rng), *value[index + 1 :]]
    return rng.choice(_ODD)


def _damage(file: Path, rng: random.Random) -> None:
    content = file.read_bytes()
    kind = rng.choice(("json", "json", "json", "cut", "flip", "gone", "folder", "loop", "empty"))
    if kind == "json" and file.suffix == ".json":
        file.write_text(json.dumps(_mutate_json(json.loads(content), rng)))
    elif kind in ("gone", "folder", "loop"):
        file.unlink()
        if kind == "folder":
            file.mkdir()
        elif kind == "loop":
            file.symlink_to(file)
    elif kind == "empty":
        file.write_bytes(b"")
    elif kind == "cut":
        file.write_bytes(content[: rng.randrange(len(content))])
    else:
        flipped = bytearray(content)
        for _ in range(rng.choice((1, 8, 64))):
            flipped[rng.randrange(len(flipped))] ^= 1 << rng.randrange(8)
        file.write_bytes(bytes(flipped))


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(160))
def test_no_damage_of_results_is_a_traceback(
    seed: int, finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rng = random.Random(seed)
    copy = tmp_path / "results"
    shutil.copytree(finished, copy)
    folder = greys_folder(copy)
    files = [p for p in sorted(folder.path.rglob("*")) if p.is_file() and p.stat().st_size]
    records = [p for p in files if p.suffix == ".json"]
    for _ in range(rng.choice((1, 1, 2))):
        file = rng.choice(records if rng.random() < 0.7 else files)
        if file.is_file() and not file.is_symlink() and file.stat().st_size:
            _damage(file, rng)
    own = ["--config-dir", str(_own(copy))]
    for command in (["verify", str(folder.path)], ["report", "greys", f"output={copy}", *own]):
        status, said = main(command), capsys.readouterr()
        assert status in (0, 1)
        assert "Traceback" not in said.err
        assert status == 0 or said.err.startswith("error: ") or command[0] == "verify"
