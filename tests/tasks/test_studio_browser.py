"""The page of `task=studio` in a real browser, from dropped photographs to a downloaded cloud."""

import re
import signal
import subprocess
import sys
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from headless import headless_page
from plyfile import PlyData

_OPTIONS = [
    "inputs=4",
    "complete.step_deg=90",
    "complete.splats.fit=false",
    "complete.held_out=0",
    "studio.port=8971",
]
_MINUTE = 60_000


@pytest.fixture
def served(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """The page of the command, which Ctrl-C ends in the end."""
    pytest.importorskip("viser", reason="needs viser: the extra `studio`")
    pytest.importorskip("pycolmap", reason="needs pycolmap: the extra `studio`")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    words = ["task=studio", "category=hydrant", "weights=base", *_OPTIONS, f"output={tmp_path}"]
    command = [sys.executable, "-c", _WITH_CTRL_C, *words]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        line = next(line for line in process.stdout if line.startswith("studio: "))
        yield line.split()[1]
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=60)
        assert process.returncode == 130
        assert errors.splitlines()[-1].startswith("interrupted: ")
        assert "Traceback" not in errors


_WITH_CTRL_C = """
import signal
signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore it
from extrap_train.__main__ import main
main()
"""


@pytest.mark.slow
def test_from_photographs_to_a_cloud(shared: Path, served: str, tmp_path: Path) -> None:
    photographs = sorted((shared / "data" / "templeSparseRing").glob("*.png"))
    if not photographs:
        pytest.skip("needs the photographs of the temple (templeSparseRing)")
    with headless_page(1280, 860) as page:
        page.goto(served, wait_until="domcontentloaded")
        zone = page.frame_locator("iframe")
        zone.locator("#zone").wait_for(timeout=2 * _MINUTE)
        fake = tmp_path / "fake.png"
        fake.write_bytes(b"no picture")
        _drop(page, [fake, *photographs])
        zone.get_by_text("fake.png: cannot be read").wait_for(timeout=_MINUTE)
        said = page.get_by_text("error: ").or_(page.get_by_text("photographs are used"))
        said.wait_for(timeout=15 * _MINUTE)
        assert "4 of 16" in said.inner_text()

        page.get_by_role("combobox", name="stand at").click()
        page.get_by_role("option", name=photographs[2].name).click()
        page.get_by_role("button", name="Generate the view from here").click()
        page.get_by_text("right: generated").wait_for(timeout=10 * _MINUTE)
        assert page.locator("img").count() > 0

        page.get_by_role("button", name="Complete the scene").click()
        page.get_by_text(re.compile(r"completing: [1-9]\d*/\d+ views")).wait_for(
            timeout=15 * _MINUTE
        )
        done = page.get_by_text(re.compile(r"^complete: \d+ views"))
        done.wait_for(timeout=15 * _MINUTE)
        assert int(done.inner_text().split()[1]) > 4
        for choice, name in (("cloud.ply", "cloud.ply"), ("everything (zip)", ".zip")):
            page.get_by_role("combobox", name="file").click()
            page.get_by_role("option", name=choice).click()
            with page.expect_download(timeout=_MINUTE) as download:
                page.get_by_role("button", name="Download").click()
            assert download.value.suggested_filename.endswith(name)
            download.value.save_as(tmp_path / f"got_{choice[:5]}")
        assert len(PlyData.read(tmp_path / "got_cloud")["vertex"]) > 1000
        assert any("cloud.ply" in n for n in zipfile.ZipFile(tmp_path / "got_every").namelist())
        answer = page.request.get(f"{served}/studio/photographs-1/{photographs[0].name}")
        assert answer.status == 404
        assert not page.errors


def _drop(page: Any, files: list[Path]) -> None:
    """Drop files on the zone as a desktop does."""
    frame = next(frame for frame in page.frames if frame.url.endswith("/drop"))
    transfer = frame.evaluate_handle("() => new DataTransfer()")
    for path in files:
        frame.evaluate(
            """([transfer, name, bytes]) =>
                transfer.items.add(new File([Uint8Array.from(bytes)], name))""",
            [transfer, path.name, list(path.read_bytes())],
        )
    frame.dispatch_event("#zone", "drop", {"dataTransfer": transfer})
