"""The page in a real headless browser."""

import shutil

import pytest
from test_completion import inputs

from extrap_train.reconstruction.cloud import cloud_of

viser = pytest.importorskip("viser", reason="needs the extra `viewer`")
sync_api = pytest.importorskip("playwright.sync_api", reason="needs playwright")
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="needs chromium")
def test_the_cloud_grows_and_the_threshold_thins_it(tmp_path):
    from extrap_train.reconstruction.viewer import CloudViewer

    known = inputs(-30.0, 0.0, 30.0)
    with CloudViewer(18080) as viewer, sync_api.sync_playwright() as playwright:
        viewer.show(known)
        options = ["--no-sandbox", "--use-gl=swiftshader", "--enable-unsafe-swiftshader"]
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=options)
        page = browser.new_page(viewport={"width": 900, "height": 600})
        errors = []
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.goto(f"http://localhost:{viewer.port}", wait_until="domcontentloaded")
        page.get_by_text("least confidence").wait_for(timeout=120_000)
        page.get_by_text("views", exact=True).wait_for()
        page.locator("canvas").first.wait_for()
        box = page.get_by_label("points")
        everything = len(cloud_of(known))
        assert int(box.input_value()) == viewer.shown_points == everything
        viewer.select(views=1, least_confidence=0.0)
        page.wait_for_timeout(1000)
        fewer = int(box.input_value())
        assert 0 < fewer < everything
        viewer.select(views=3, least_confidence=1.01)
        page.wait_for_timeout(1000)
        assert int(box.input_value()) == 0
        viewer.select(views=3, least_confidence=0.0)
        page.wait_for_timeout(3000)
        page.screenshot(path=tmp_path / "viewer.png")
        browser.close()
    assert not errors
    assert (tmp_path / "viewer.png").stat().st_size > 10_000
