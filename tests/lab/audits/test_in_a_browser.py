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

from keyss.lab.audits import audit
from lab.audits.audited import found_in, run_with
from viewer.browser import PATIENCE, PROGRAM

playwright = pytest.importorskip("playwright.sync_api", reason="needs playwright: pip install playwright")

pytestmark = pytest.mark.skipif(PROGRAM is None, reason="no Chromium on PATH")

RED, GREEN, BLUE = (220, 30, 30), (30, 160, 60), (30, 60, 220)
SLIDER = ".stage input >> nth=0"


@pytest.fixture(scope="module")
def report(run_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of the audit with pictures of one colour each in its first slider."""
    data = found_in(run_folder)
    run = run_with(run_folder, tmp_path_factory.mktemp("coloured"), data)
    items = next(iter(data["images"]["pictures"].values()))
    for label, colour in {"photo": RED, "stego model": BLUE, "plain model": GREEN}.items():
        Image.new("RGB", (40, 30), colour).save(run / "private" / "audit" / items[label])
    audit(run, report_only=True)
    return run / "private" / "report.html"


@pytest.fixture
def page(chromium: playwright.Browser, report: Path) -> Iterator[playwright.Page]:
    page = chromium.new_page(viewport={"width": 1000, "height": 900}, color_scheme="light")
    page.set_default_timeout(PATIENCE)
    page.goto(report.as_uri())
    yield page
    page.close()


def colours(page: playwright.Page) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """What the first stage shows a quarter and three quarters of its width from the left."""
    picture = Image.open(io.BytesIO(page.locator(".stage").first.screenshot())).convert("RGB")
    left, right = (
        picture.getpixel((int(share * picture.width), picture.height // 4)) for share in (0.25, 0.75)
    )
    assert isinstance(left, tuple)
    assert isinstance(right, tuple)
    return left, right


def choose(page: playwright.Page, side: str, label: str) -> None:
    page.locator(f'select[aria-label$="{side} picture"]').first.select_option(label=label)


def test_it_opens_from_disk_without_complaints_or_requests(
    chromium: playwright.Browser, report: Path
) -> None:
    page = chromium.new_page()
    complaints: list[str] = []
    requests: list[str] = []
    page.on("console", lambda message: complaints.append(message.text))
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.on("request", lambda request: requests.append(request.url))
    page.goto(report.as_uri())
    assert complaints == []
    assert [url for url in requests if not url.startswith("data:")] == [report.as_uri()]
    assert page.title() == "treasure and map, hidden in garden · keyss"
    assert page.evaluate("[...document.images].every((image) => image.complete && image.naturalWidth > 0)")
    page.close()


def test_the_slider_moves_with_the_keyboard(page: playwright.Page) -> None:
    assert colours(page) == (RED, BLUE)
    slider = page.locator(SLIDER)
    slider.press("Home")
    assert colours(page) == (BLUE, BLUE)
    for _ in range(30):
        slider.press("ArrowRight")
    assert colours(page) == (RED, BLUE)
    slider.press("End")
    assert colours(page) == (RED, RED)
    assert slider.get_attribute("aria-valuetext") == "100 % photo"


def test_the_slider_moves_with_the_mouse(page: playwright.Page) -> None:
    slider = page.locator(SLIDER)
    slider.scroll_into_view_if_needed()
    box = slider.bounding_box()
    assert box is not None
    page.mouse.click(box["x"] + 0.9 * box["width"], box["y"] + box["height"] / 2)
    assert colours(page) == (RED, RED)


def test_either_side_can_show_any_picture(page: playwright.Page) -> None:
    choose(page, "left", "plain model")
    assert colours(page) == (GREEN, BLUE)
    choose(page, "right", "photo")
    assert colours(page) == (GREEN, RED)
    choose(page, "right", "plain model")
    assert colours(page) == (GREEN, GREEN)


def test_the_difference(page: playwright.Page) -> None:
    page.locator(".choices input").first.click()
    assert colours(page)[1] == tuple(min(255, 4 * abs(a - b)) for a, b in zip(RED, BLUE, strict=True))
    choose(page, "left", "stego model")
    assert page.locator(".compare").first.locator(".shot.left.right").count() == 1


def test_all_pictures_are_shown_without_scripts_and_on_paper(
    chromium: playwright.Browser, page: playwright.Page, report: Path
) -> None:
    boxes = """[...document.querySelector('.compare').querySelectorAll('.shot')].map((shot) => {
      const box = shot.getBoundingClientRect();
      return [getComputedStyle(shot).clipPath, box.width > 50, box.height > 30, Math.round(box.left)];
    })"""

    def side_by_side(page: playwright.Page) -> None:
        shots = page.evaluate(boxes)
        assert [shot[:3] for shot in shots] == 3 * [["none", True, True]]
        assert len({shot[3] for shot in shots}) == 3

    page.emulate_media(media="print")
    side_by_side(page)
    without_scripts = chromium.new_page(java_script_enabled=False)
    without_scripts.goto(report.as_uri())
    side_by_side(without_scripts)
    without_scripts.close()


@pytest.mark.parametrize("width", [320, 390, 768, 1600])
def test_the_page_is_never_wider_than_the_window(page: playwright.Page, width: int) -> None:
    page.set_viewport_size({"width": width, "height": 900})
    assert page.evaluate("document.documentElement.scrollWidth <= window.innerWidth")
    assert page.evaluate("Math.max(...[...document.querySelectorAll('p')].map((p) => p.clientWidth))") > 250


def test_dark_and_light(page: playwright.Page) -> None:
    def brightness(of: str, name: str) -> float:
        color = page.evaluate(f"getComputedStyle(document.querySelector('{of}')).{name}")
        channels = [float(number) for number in re.findall(r"[\d.]+", color)[:3]]
        return sum(channels) / 3 / 255

    text, page_ = ("body", "color"), ("body", "backgroundColor")
    assert brightness(*text) < 0.5 < brightness(*page_)
    page.emulate_media(color_scheme="dark")
    assert brightness(*page_) < 0.2
    assert brightness(*text) > 0.5


def test_it_prints_on_a_few_pages(page: playwright.Page) -> None:
    data = page.pdf(format="A4", prefer_css_page_size=True)
    assert data.startswith(b"%PDF")
    assert 4 <= len(re.findall(rb"/Type\s*/Page\b(?!s)", data)) <= 20


@pytest.mark.parametrize("guarded", [True, False], ids=["with the policy", "without, as a control"])
def test_markup_that_slipped_in_could_do_nothing(
    page: playwright.Page, report: Path, tmp_path: Path, guarded: bool
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
        page.goto(changed.as_uri(), wait_until="domcontentloaded")
        arrived, _, _ = select.select([server], [], [], 1.0)
    assert (page.title() == "ran") is not guarded
    assert bool(arrived) is not guarded
    assert page.locator(".compare").first.evaluate("(group) => group.classList.contains('live')")
