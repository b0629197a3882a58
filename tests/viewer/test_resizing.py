"""The canvas after changes of its size: phones, a folded panel, frames of other sites."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from keyss.core import Gaussians
from keyss.files import read_model
from keyss.viewer import export_html
from serving import serving
from viewer.browser import CLOSE, FAR, IN_CHROMIUM, KEYS, PANEL, Visit, psnr, render_pose, visit

pytestmark = IN_CHROMIUM

PHONE = {"has_touch": True, "is_mobile": True}
PORTRAIT, LANDSCAPE = {"width": 390, "height": 844}, {"width": 844, "height": 390}


def assert_drawn(tab: Visit, model: Gaussians) -> tuple[int, int]:
    """Assert that the canvas shows our render at its size; returns width and height."""
    found = tab.picture()
    height, width = found.shape[:2]
    assert psnr(found, render_pose(model, FAR, width, height)) > CLOSE
    return width, height


def test_found_is_found(chromium: Any, page_file: Path) -> None:
    """After a right key there is no word of a search; on a phone, the panel leaves most of the screen."""
    share = "document.querySelector('.panel').offsetHeight / innerHeight"
    with visit(chromium, viewport=PORTRAIT, **PHONE) as tab:
        tab.goto(page_file.as_uri())
        for summary in ("#more", "#keying > summary"):
            tab.page.tap(summary)
            assert tab.page.evaluate(share) < 0.4
        tab.try_key(KEYS[0])
        said = tab.page.locator("[role=status]").inner_text()
        assert said == "The key reveals a model of 200 Gaussians."
        assert tab.page.locator("#progress").is_hidden()
        assert tab.page.locator("#stop").is_hidden()
        assert tab.page.evaluate(share) < 0.4


@pytest.mark.slow
def test_secret_stays_after_search(chromium: Any, page_file: Path) -> None:
    """The panel and the canvas change their heights while frames are drawn."""
    with visit(chromium, viewport=PORTRAIT, **PHONE) as tab:
        tab.goto(page_file.as_uri())
        published = tab.picture()
        tab.page.tap("#keying > summary")
        tab.try_key(KEYS[0], thorough=True)
        focused = "document.activeElement.id"
        assert tab.page.evaluate(focused) != "key"  # the on-screen keyboard would cover the canvas
        shown = tab.picture()
        tab.page.evaluate("document.getElementById('wipe').dispatchEvent(new Event('input'))")  # draws again
        assert shown.std() > 10
        assert psnr(shown, tab.picture()) > 40
        assert shown.shape[0] < published.shape[0]
        assert tab.page.evaluate("document.documentElement.scrollWidth <= window.innerWidth")
        tab.page.tap("#close")
        assert tab.page.evaluate(focused) != "key"


@pytest.mark.slow
def test_rotate_phone(chromium: Any, page_file: Path, stego: Path) -> None:
    fits = "(panel => panel.scrollWidth <= panel.clientWidth)(document.querySelector('.panel'))"
    with visit(chromium, viewport=PORTRAIT, **PHONE) as tab:
        tab.goto(page_file.as_uri() + FAR)
        heights = []
        for _ in range(2):
            heights.append(assert_drawn(tab, read_model(stego))[1])
            tab.page.tap("#more")
        assert heights[0] > heights[1]
        tab.page.tap("#more")
        for viewport, size in ((LANDSCAPE, (844 - PANEL, 390)), (PORTRAIT, (390, heights[1]))):
            tab.page.set_viewport_size(viewport)
            assert assert_drawn(tab, read_model(stego)) == size
            assert tab.page.evaluate(fits)


@pytest.mark.slow
def test_rotate_phone_with_secret(chromium: Any, page_file: Path, secrets: list[Gaussians]) -> None:
    with visit(chromium, viewport=PORTRAIT, **PHONE) as tab:
        tab.goto(page_file.as_uri())
        tab.page.tap("#keying > summary")
        tab.try_key(KEYS[0])
        tab.at(FAR)
        size = assert_drawn(tab, secrets[0])
        tab.page.tap("#keying > summary")
        unfolded = assert_drawn(tab, secrets[0])
        assert unfolded[1] < size[1]
        for viewport, size in ((LANDSCAPE, (844 - PANEL, 390)), (PORTRAIT, unfolded)):
            tab.page.set_viewport_size(viewport)
            assert assert_drawn(tab, secrets[0]) == size
            assert tab.page.input_value("#wipe") == "100"


@pytest.mark.slow
def test_resize_element(tab: Visit, stego: Path, secrets: list[Gaussians], tmp_path: Path) -> None:
    export_html(stego, tmp_path / "site", look={"pose": FAR.removeprefix("#")})
    with serving(tmp_path / "site") as site:
        (tmp_path / "site" / "own.html").write_text(
            "<!doctype html><link rel=icon href=data:,><script src=embed.js></script><keyss-viewer>"
        )
        tab.page.goto(f"{site}own.html")
        frame = tab.page.frame_locator("iframe")
        frame.locator("main[data-picture=settled]").wait_for()
        for width, height in ((320, 240), (500, 200), (240, 280)):
            tab.page.evaluate(
                "([width, height]) => { document.querySelector('keyss-viewer').style.cssText ="
                " `width: ${width}px; height: ${height}px` }",
                [width, height],
            )
            assert assert_drawn(tab, read_model(stego)) == (width, height)
        tab.page.evaluate("document.querySelector('keyss-viewer').setAttribute('key-field', '')")
        frame.locator("main[data-picture=settled]").wait_for()
        frame.locator("#key").fill(KEYS[0])
        frame.locator("#key").press("Enter")
        frame.locator("#revealed:not([hidden])").wait_for()
        tab.at(FAR)
        for style in ("width: 500px; height: 400px", "display: none", "width: 320px; height: 500px"):
            tab.page.evaluate("style => { document.querySelector('keyss-viewer').style = style }", style)
            if "none" not in style:
                assert_drawn(tab, secrets[0])


def test_panel_fits_a_phone_held_sideways(chromium: Any, page_file: Path) -> None:
    with visit(chromium, viewport=LANDSCAPE, **PHONE) as tab:
        tab.goto(page_file.as_uri())
        tab.page.tap("#keying > summary")
        assert tab.page.is_visible("#key")
        bottom = "document.querySelector('#controls').getBoundingClientRect().bottom"
        assert tab.page.evaluate(f"{bottom} <= window.innerHeight")
