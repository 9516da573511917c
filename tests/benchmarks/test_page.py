"""The page works in a real browser: numbers sort, pictures change, nothing is fetched."""

import shutil
from collections.abc import Iterator
from typing import Any

import pytest

from tests.benchmarks.tables import run_greys, write_own

_BROWSERS = ("chromium", "chromium-browser", "google-chrome")


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    playwright = pytest.importorskip("playwright.sync_api", reason="needs playwright")
    browser = next(filter(None, map(shutil.which, _BROWSERS)), None)
    if browser is None:
        pytest.skip("needs chromium")
    folder = tmp_path_factory.mktemp("page")
    run_greys(write_own(folder / "own"), folder / "out", "methods=[dark,light,broken]", draws=True)
    with playwright.sync_playwright() as driver:
        window = driver.chromium.launch(
            executable_path=browser, args=["--no-sandbox", "--disable-gpu"]
        )
        opened = window.new_page()
        opened.requested, opened.errors = [], []
        opened.on("request", lambda request: opened.requested.append(request.url))
        opened.on("pageerror", lambda error: opened.errors.append(str(error)))
        opened.goto((folder / "out" / "greys" / "index.html").as_uri())
        yield opened
        window.close()


def _first_column(page: Any) -> list[str]:
    cells = page.locator("table.sortable").first.locator("tbody tr td:first-child")
    return [text.strip() for text in cells.all_inner_texts()]


def test_nothing_is_fetched_and_no_script_fails(page: Any) -> None:
    assert not page.errors
    fetched = [url for url in page.requested if not url.startswith(("file:", "data:"))]
    assert not fetched


def test_a_click_sorts_and_another_turns_it_round(page: Any) -> None:
    heading = page.locator("table.sortable").first.locator("th", has_text="PSNR").first
    heading.click()
    up = _first_column(page)
    heading.click()
    down = _first_column(page)
    assert up[:2] == down[1::-1]
    assert set(up[:2]) == {"dark", "light"}
    assert up[2] == down[2] == "broken"  # a row without a number stays last


def test_every_picture_loads_and_the_slider_cuts_it(page: Any) -> None:
    loaded = "[...document.images].every(i => i.complete && i.naturalWidth > 0)"
    assert page.evaluate(loaded)
    assert page.locator("#inputs img").count() == 3
    page.locator("#slider").fill("20")
    style = page.evaluate("document.getElementById('over').style.clipPath")
    assert style.replace("0px", "0") == "inset(0 80% 0 0)"


def test_another_target_shows_other_pictures_and_failures_say_why(page: Any) -> None:
    before = page.locator("#under").get_attribute("src")
    page.locator("#target").select_option("1")
    assert page.locator("#under").get_attribute("src") != before
    assert "no luck" in page.locator("#images").inner_text()


def test_the_published_numbers_are_labelled(page: Any) -> None:
    text = page.locator("body").inner_text()
    assert "Reported, not measured here" in text
    assert "ours (reported)" in text
