"""The page embedded in other sites, and its reader in other engines."""

from __future__ import annotations

import io
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from keyss.core import UsageError
from keyss.files import write_model
from keyss.viewer import export_html
from serving import serving
from viewer.browser import IN_CHROMIUM, KEYS, WEB, Visit, bright_model

pytestmark = IN_CHROMIUM

FOREIGN = Path(__file__).with_name("foreign.html").read_text()


@pytest.fixture(scope="module")
def foreign(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, str]]:
    """Folder and origin of another site."""
    folder = tmp_path_factory.mktemp("foreign")
    with serving(folder) as address:
        yield folder, address.rstrip("/")


@pytest.mark.slow
def test_element_on_another_site(tab: Visit, stego: Path, foreign: tuple[Path, str], tmp_path: Path) -> None:
    folder, origin = foreign
    export_html(stego, tmp_path, look={"embedder": origin, "host": origin})
    write_model(folder / "other.ply", bright_model(300, 2))
    with serving(tmp_path) as site:
        element = f"<script src='{site}embed.js'></script><keyss-viewer style='width: 700px' key-field"
        (folder / "own.html").write_text(f"{FOREIGN}{element} title='Of the studio'></keyss-viewer>")
        (folder / "other.html").write_text(f"{FOREIGN}{element} src='other.ply'></keyss-viewer>")
        tab.page.goto(f"{origin}/own.html")
        tab.page.wait_for_function("() => told.some(([name]) => name === 'load')")
        frame = tab.page.frames[1]
        assert frame.title().startswith("Of the studio")
        assert frame.locator("#controls").is_hidden()
        frame.fill("#key", KEYS[0])
        frame.press("#key", "Enter")
        tab.page.wait_for_function("() => told.some(([name]) => name === 'opened')")
        events = [each for each in tab.page.evaluate("told") if isinstance(each, list)]
        assert events == [["load", 4000], ["key-tried", None], ["opened", "model"]]
        tab.page.goto(f"{origin}/other.html")
        tab.page.wait_for_function("() => told.some(([name]) => name === 'load')")
        assert ["load", 300] in tab.page.evaluate("told")
        with serving(folder) as unnamed:
            tab.page.goto(f"{unnamed}own.html")
            tab.page.frames[1].wait_for_selector("main[data-picture=settled]")
            assert tab.page.evaluate("told") == []


@pytest.mark.slow
def test_sandboxed_frame(tab: Visit, stego: Path, foreign: tuple[Path, str]) -> None:
    folder, origin = foreign
    export_html(stego, folder / "page.html", look={"embedder": origin})
    (folder / "sandbox.html").write_text(
        f"{FOREIGN}<iframe sandbox='allow-scripts' src='page.html?noui&autorotate&title=T'>"
    )
    tab.page.goto(f"{origin}/sandbox.html")
    tab.page.wait_for_function("() => told.includes('load')")
    frame = tab.page.frames[1]
    assert frame.locator(".panel").bounding_box()["height"] < 1  # type: ignore[index]
    assert frame.locator("#rotate").get_attribute("aria-pressed") == "true"
    frame.locator("#picture").press("ArrowLeft")
    assert frame.locator("#rotate").get_attribute("aria-pressed") == "false"


@pytest.mark.slow
def test_poster(tab: Visit, stego: Path, tmp_path: Path) -> None:
    export_html(stego, tmp_path)
    Image.new("RGB", (8, 6), "red").save(tmp_path / "poster.png")
    with serving(tmp_path) as site:
        tab.page.route("**/stego.ply", lambda route: None)  # no answer
        tab.page.goto(f"{site}?poster=poster.png")
        tab.page.wait_for_function("() => document.getElementById('poster').naturalWidth === 8")
        assert tab.page.locator("#poster").is_visible()
        tab.page.unroute("**/stego.ply")
        tab.goto(f"{site}?poster=poster.png")
        tab.page.wait_for_selector("#poster", state="hidden")


@pytest.mark.parametrize(
    "wrong", ["https://a.example; script-src *", "a.example", "https://a.example/b", "*"]
)
def test_invalid_origins(stego: Path, tmp_path: Path, wrong: str) -> None:
    for name in ("host", "embedder"):
        with pytest.raises(UsageError, match="expected an origin"):
            export_html(stego, tmp_path / "page.html", look={name: wrong})


@pytest.mark.slow
@pytest.mark.skipif(not (WEB / "node_modules").exists(), reason="no web/node_modules: `make web` installs it")
@pytest.mark.parametrize("engine", ["playcanvas", "spark"])
def test_reader_in_other_engines(chromium: Any, stego: Path, tmp_path: Path, engine: str) -> None:
    modules = tmp_path / "examples" / "node_modules"
    subprocess.run(["node", "build.mjs", "--reader", str(tmp_path)], cwd=WEB, check=True)
    for name in ("playcanvas", "three", "@sparkjsdev"):
        modules.mkdir(exist_ok=True)
        (modules / name).symlink_to(WEB / "node_modules" / name)
    (modules / "keyss-reader").symlink_to(tmp_path)
    shutil.copy(stego, modules.parent / "model.ply")
    page = chromium.new_page()
    with serving(modules.parent) as address:
        page.goto(f"{address}{engine}.html")
        page.fill("input", KEYS[0])
        page.click("button")
        page.wait_for_function(
            "() => document.querySelector('output').value === '200 Gaussians'", timeout=120_000
        )
        page.wait_for_timeout(3000)
        picture = np.asarray(Image.open(io.BytesIO(page.locator("canvas").screenshot())).convert("RGB"))
    assert picture.max() > 60  # the background is black
    page.close()
