"""The page in a real browser: nothing is fetched, the slider moves, paper shows all of it."""

from __future__ import annotations

import io
import re
import select
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest
from PIL import Image
from report.audits import BLUE, GREEN, RED
from report.browser import Page

from keyss.report import write_report
from report import browser

PROGRAM = browser.find()
pytestmark = pytest.mark.skipif(PROGRAM is None, reason=f"none of {', '.join(browser.NAMES)} on PATH")

SLIDER = "document.querySelector('.stage input')"


@pytest.fixture(scope="module")
def report(run_folder: Path) -> Path:
    return write_report(run_folder)


@pytest.fixture(scope="module")
def chromium(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    assert PROGRAM is not None
    with browser.browse(PROGRAM, tmp_path_factory.mktemp("profile")) as page:
        yield page


@pytest.fixture
def page(chromium: Page, report: Path) -> Page:
    chromium.resize(1000)
    chromium.prefer("light")
    chromium.open(report)
    return chromium


def colours(page: Page) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """What the stage shows a quarter and three quarters of its width from the left."""
    page.evaluate("document.querySelector('.stage').scrollIntoView({block: 'center'})")
    x, y, width, height = box(page, "document.querySelector('.stage')")
    picture = Image.open(io.BytesIO(page.screenshot(whole=False))).convert("RGB")
    left, right = (picture.getpixel((int(x + share * width), int(y + height / 4))) for share in (0.25, 0.75))
    assert isinstance(left, tuple)
    assert isinstance(right, tuple)
    return left, right


def box(page: Page, element: str) -> list[float]:
    """Left, top, width and height of an element in the window, in pixels."""
    page.evaluate(f"window.box = {element}.getBoundingClientRect()")
    found: list[float] = page.evaluate("[box.x, box.y, box.width, box.height]")
    return found


def choose(page: Page, side: str, label: str) -> None:
    page.evaluate(
        f"""(() => {{
          const select = document.querySelector('select[aria-label$="{side} picture"]');
          select.value = [...select.options].findIndex((option) => option.text === "{label}");
          select.dispatchEvent(new Event("input", {{bubbles: true}}));
        }})()"""
    )


def test_it_opens_from_disk_without_complaints_or_requests(page: Page, report: Path) -> None:
    assert page.complaints() == []
    assert page.requests() == [report.resolve().as_uri()]
    assert page.evaluate("document.title") == "treasure and map, hidden in garden · keyss"
    assert page.evaluate("[...document.images].every((image) => image.complete && image.naturalWidth === 8)")
    assert page.evaluate("[...document.querySelectorAll('svg')].every((svg) => svg.clientHeight > 100)")


def test_the_slider_moves_with_the_keyboard(page: Page) -> None:
    assert colours(page) == (RED, BLUE)
    page.evaluate(f"{SLIDER}.focus()")
    page.press("Home", 36)
    assert colours(page) == (BLUE, BLUE)
    for _ in range(30):
        page.press("ArrowRight", 39)
    assert colours(page) == (RED, BLUE)
    page.press("End", 35)
    assert colours(page) == (RED, RED)
    assert page.evaluate(f"{SLIDER}.getAttribute('aria-valuetext')") == "100 % photo"


def test_the_slider_moves_with_the_mouse(page: Page) -> None:
    colours(page)  # scrolls to it
    x, y, width, height = box(page, SLIDER)
    at = {"x": x + 0.9 * width, "y": y + height / 2, "button": "left", "clickCount": 1}
    for kind in ("mousePressed", "mouseReleased"):
        page.call("Input.dispatchMouseEvent", type=kind, **at)
    assert colours(page) == (RED, RED)


def test_either_side_can_show_any_picture(page: Page) -> None:
    choose(page, "left", "plain 3DGS")
    assert colours(page) == (GREEN, BLUE)
    choose(page, "right", "photo")
    assert colours(page) == (GREEN, RED)
    choose(page, "right", "plain 3DGS")
    assert colours(page) == (GREEN, GREEN)


def test_the_difference(page: Page) -> None:
    page.evaluate("document.querySelector('.choices input').click()")
    assert colours(page)[1] == tuple(min(255, 4 * abs(a - b)) for a, b in zip(RED, BLUE, strict=True))
    choose(page, "left", "published")
    assert page.evaluate("document.querySelectorAll('.shot.left.right').length") == 1


def test_all_pictures_are_shown_without_scripts_and_on_paper(page: Page, report: Path) -> None:
    boxes = """[...document.querySelectorAll('.shot')].map((shot) => {
      const box = shot.getBoundingClientRect();
      return [getComputedStyle(shot).clipPath, box.width > 50, box.height > 30, Math.round(box.left)];
    })"""

    def side_by_side() -> None:
        shots = page.evaluate(boxes)
        assert [shot[:3] for shot in shots] == 3 * [["none", True, True]]
        assert len({shot[3] for shot in shots}) == 3

    page.call("Emulation.setEmulatedMedia", media="print")
    side_by_side()
    page.call("Emulation.setEmulatedMedia", media="")
    page.call("Emulation.setScriptExecutionDisabled", value=True)
    try:
        page.open(report)
        side_by_side()
    finally:
        page.call("Emulation.setScriptExecutionDisabled", value=False)


@pytest.mark.parametrize("width", [320, 390, 768, 1600])
def test_the_page_is_never_wider_than_the_window(page: Page, width: int) -> None:
    page.resize(width)
    assert page.evaluate("document.documentElement.scrollWidth <= window.innerWidth")
    assert page.evaluate("Math.max(...[...document.querySelectorAll('p')].map((p) => p.clientWidth))") > 250


def test_dark_and_light(page: Page) -> None:
    def brightness(of: str, name: str) -> float:
        color = page.evaluate(f"getComputedStyle(document.querySelector('{of}')).{name}")
        channels = [float(number) for number in re.findall(r"[\d.]+", color)[:3]]
        return sum(channels) / 3 / 255

    text, page_ = ("svg text", "fill"), ("body", "backgroundColor")
    assert brightness(*text) < 0.5 < brightness(*page_)
    page.prefer("dark")
    assert brightness(*page_) < 0.2
    assert brightness(*text) > 0.5


def test_it_prints_on_a_few_pages(page: Page) -> None:
    data = page.pdf()
    assert data.startswith(b"%PDF")
    assert 4 <= len(re.findall(rb"/Type\s*/Page\b(?!s)", data)) <= 10


@pytest.mark.parametrize("guarded", [True, False], ids=["with the policy", "without, as a control"])
def test_markup_that_slipped_in_could_do_nothing(
    page: Page, report: Path, tmp_path: Path, guarded: bool
) -> None:
    html = report.read_text()
    if not guarded:
        html = re.sub(r'<meta http-equiv="Content-Security-Policy"[^>]*>', "", html)
    with socket.create_server(("127.0.0.1", 0)) as server:
        there = f"http://127.0.0.1:{server.getsockname()[1]}"
        added = f"""<script>document.title = "ran"</script><img src="x" onerror="document.title = 'ran'">
          <img src="{there}/x.png"><iframe src="{there}/"></iframe>"""
        changed = tmp_path / "changed.html"
        changed.write_text(html.replace("</body>", f"{added}</body>"))
        page.open(changed, until="Page.domContentEventFired")
        arrived, _, _ = select.select([server], [], [], 1.0)
    assert (page.evaluate("document.title") == "ran") is not guarded
    assert bool(arrived) is not guarded
    assert page.evaluate("document.querySelector('.compare').classList.contains('live')")
