"""The report in a real browser."""

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
    """A report with pictures of one colour each in its first slider."""
    data = found_in(run_folder)
    run = run_with(run_folder, tmp_path_factory.mktemp("coloured"), data)
    items = next(iter(data["images"]["pictures"].values()))
    for label, colour in {"photo": RED, "stego model": BLUE, "plain model": GREEN}.items():
        Image.new("RGB", (40, 30), colour).save(run / "private" / "audit" / "pictures" / items[label])
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
    """Colours of the first stage at a quarter and at three quarters of its width."""
    picture = Image.open(io.BytesIO(page.locator(".stage").first.screenshot())).convert("RGB")
    left, right = (
        picture.getpixel((int(share * picture.width), picture.height // 4)) for share in (0.25, 0.75)
    )
    assert isinstance(left, tuple)
    assert isinstance(right, tuple)
    return left, right


def test_opens_from_disk_without_errors_or_requests(chromium: playwright.Browser, report: Path) -> None:
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


@pytest.mark.slow
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


@pytest.mark.slow
def test_pictures_without_scripts_and_in_print(
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


@pytest.mark.slow
@pytest.mark.parametrize("guarded", [True, False], ids=["with the policy", "without, as a control"])
def test_injected_markup_is_harmless(
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
