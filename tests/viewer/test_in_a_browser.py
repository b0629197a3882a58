"""The viewer in headless Chromium, from disk and from `keyss view`, against our renders."""

from __future__ import annotations

import re
import subprocess
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import urljoin

import pytest

from cli.harness import PROGRAM as KEYSS
from keyss.core import Gaussians
from keyss.files import model_bytes, read_model, write_model
from viewer.browser import CLOSE, FAR, IN_CHROMIUM, KEYS, POSE, WEB, Visit, bright_model, psnr, render_pose

pytestmark = IN_CHROMIUM

AXE = WEB / "node_modules" / "axe-core" / "axe.min.js"


@pytest.fixture(scope="module")
def served(stego: Path) -> Iterator[str]:
    """The address of `keyss view`."""
    with subprocess.Popen([*KEYSS, "view", str(stego)], stdout=subprocess.PIPE, text=True) as process:
        try:
            line = process.stdout.readline()
            found = re.match(r"(http://127\.0\.0\.1:[0-9]+/\S+/) .*only on this machine", line)
            assert found, line
            yield found[1]
        finally:
            process.terminate()


def test_keys_leave_no_trace(tab: Visit, served: str) -> None:
    kept = "localStorage.length + sessionStorage.length + document.cookie.length + history.length"

    def noticeable() -> tuple[object, ...]:  # blob: URLs are not network requests
        asked = [url for url in tab.requests if not url.startswith("blob:")]
        return tab.page.title(), tab.page.evaluate(kept), asked

    tab.goto(served)
    tab.page.focus("#picture")
    for key in ("another key", KEYS[0]):
        tab.page.keyboard.press("ArrowLeft")  # the URL is updated later, whatever the key opens
        before = noticeable()
        tab.page.fill("#key", key)
        tab.page.press("#key", "Enter")
        address = tab.page.url
        tab.page.wait_for_selector("main:is([data-searching=thorough], [data-searching=silent])")
        tab.settle()
        tab.page.focus("#picture")
        for moved in ("ArrowLeft", "w") if key in KEYS else ():
            tab.page.keyboard.press(moved)
        tab.page.wait_for_timeout(1000)
        assert (noticeable(), tab.page.url) == (before, address)
    origin = urljoin(served, "/")
    assert all(url.startswith((served, f"blob:{origin}")) for url in tab.requests), tab.requests
    tab.page.reload()
    tab.settle()
    assert tab.page.locator("#revealed").is_hidden()


@pytest.mark.slow
def test_timing_does_not_reveal_secret(tab: Visit, page_file: Path) -> None:
    """The form is ready before decoding and rendering, whose time depends on the secret."""
    tab.goto(page_file.as_uri())
    tab.page.evaluate(
        """() => {
            const main = document.getElementById('main');
            window.ready = [];
            new MutationObserver(() => {
                if (main.getAttribute('aria-busy') === 'true') return;
                const open = !document.getElementById('open').disabled;
                window.ready.push(open && document.getElementById('revealed').hidden);
            }).observe(main, { attributeFilter: ['aria-busy'] });
        }"""
    )
    tab.try_key("wrong")
    tab.try_key(KEYS[0])
    assert tab.page.evaluate("window.ready") == [True, True]
    assert tab.page.locator("#revealed").is_visible()


def in_place_of_thorough_searches(tab: Visit, answer: str) -> None:
    """Let the questions of thorough searches be answered by a script instead of a worker."""
    tab.page.add_init_script(
        "Worker.prototype.postMessage = (ask => function (question, moved) {"
        f" if (question.model) {{ {answer} }} else ask.call(this, question, moved);"
        "})(Worker.prototype.postMessage)"
    )


def wait_until_said(tab: Visit, start: str) -> None:
    status = "start => document.getElementById('status').textContent.startsWith(start)"
    tab.page.wait_for_function(status, arg=start)


def test_no_key_waits_for_the_search_of_another(tab: Visit, page_file: Path) -> None:
    in_place_of_thorough_searches(tab, "")  # they never end
    tab.goto(page_file.as_uri())
    for key in ("another key", *KEYS):
        tab.page.fill("#key", key)
        tab.page.press("#key", "Enter")
        wait_until_said(tab, "The key reveals" if key in KEYS else "Nothing yet. Searching")
        searching = "silent" if key in KEYS else "thorough"
        tab.page.wait_for_selector(f"main[data-searching={searching}]")
        tab.page.evaluate("document.getElementById('status').textContent = ''")


def test_wrong_keys_are_explained(tab: Visit, page_file: Path, tmp_path: Path) -> None:
    in_place_of_thorough_searches(tab, "moved[0].postMessage({})")
    tab.goto(page_file.as_uri())
    write_model(tmp_path / "small.spz", bright_model(200, 1))
    for file in (None, tmp_path / "small.spz"):
        if file is not None:
            tab.page.set_input_files("#file", file)
            tab.page.wait_for_function(f"() => document.title.startsWith('{file.name}')")
            tab.settle()
        tab.page.fill("#key", "another key")
        tab.page.press("#key", "Enter")
        wait_until_said(tab, "This key")
        said = tab.page.locator("[role=status]").inner_text()
        assert re.fullmatch(r"[^.]+\.", said)
        assert all(each in said for each in ("wrong", "no secret", "changed", "check the key"))


def test_damaged_files(tab: Visit, page_file: Path, stego: Path, tmp_path: Path) -> None:
    def problem(data: bytes) -> str:
        """The message about a file."""
        (tmp_path / "model.ply").write_bytes(data)
        # The message of the previous file stays until this one is read.
        tab.page.evaluate("() => { document.getElementById('problem').textContent = ''; }")
        tab.page.set_input_files("#file", tmp_path / "model.ply")
        tab.page.wait_for_function("() => document.getElementById('problem').textContent !== ''")
        return str(tab.page.locator("#problem").inner_text())

    tab.goto(page_file.as_uri())
    whole = stego.read_bytes()
    for data in (whole[:5000], b"ply" + bytes(range(256)), b""):
        message = problem(data)
        assert re.fullmatch(r"This [^.]*\.?[^.]*\.", message), message
    model = bright_model(200, 1)
    header, _, rows = model_bytes("a.ply", model).partition(b"end_header\n")
    nan = header + b"end_header\n" + b"\xff" * len(rows)
    empty = header.replace(b"vertex 200", b"vertex 0") + b"end_header\n"
    for data in (nan, empty):
        assert re.search("^This file.*: export it again ", problem(data))
    drop = """([name, bytes]) => {
        const data = new DataTransfer();
        data.items.add(new File([Uint8Array.from(bytes)], name));
        const how = {dataTransfer: data, bubbles: true, cancelable: true};
        document.body.dispatchEvent(new DragEvent('drop', how));
    }"""
    tab.page.evaluate(drop, ["model.ply", list(whole)])
    tab.page.wait_for_function("() => document.getElementById('problem').textContent === ''")


@pytest.mark.slow
def test_slider(tab: Visit, page_file: Path, stego: Path, secrets: list[Gaussians], tmp_path: Path) -> None:
    models = dict(zip(("first", "second"), secrets, strict=True))
    models |= {"published": read_model(stego), "other": bright_model(300, 5)}
    write_model(tmp_path / "other.ply", models["other"])
    (tmp_path / "cut.ply").write_bytes(stego.read_bytes()[:5000])

    def assert_seen(expected: str, slider: str | None) -> None:
        tab.at(FAR)
        found = tab.picture()
        close = [name for name, model in models.items() if psnr(found, render_pose(model, FAR)) > CLOSE]
        assert close == ([] if slider == "0" else [expected])
        assert found.std() > 10
        assert tab.page.locator("#wiping").is_visible() == (slider is not None)
        assert slider is None or tab.page.input_value("#wipe") == slider

    tab.goto(page_file.as_uri())
    assert_seen("published", None)
    tab.try_key(KEYS[0])
    assert_seen("first", "100")
    tab.page.fill("#wipe", "0")
    assert_seen("published", "0")
    tab.try_key(KEYS[1])
    assert_seen("second", "100")
    tab.page.set_input_files("#file", tmp_path / "cut.ply")
    tab.page.wait_for_function("() => document.getElementById('problem').textContent !== ''")
    assert_seen("second", "100")
    tab.page.click("#close")
    assert_seen("published", None)
    tab.try_key(KEYS[0])
    assert_seen("first", "100")
    tab.page.set_input_files("#file", tmp_path / "other.ply")
    tab.page.wait_for_function("() => document.getElementById('facts').textContent.includes('other')")
    tab.settle()
    assert_seen("other", None)


@pytest.mark.slow
def test_keyboard(tab: Visit, page_file: Path) -> None:
    tab.goto(page_file.as_uri())
    reached: list[str] = []
    tab.page.focus("#picture")
    for _ in range(18):
        tab.page.keyboard.press("Tab")
        reached.append(tab.page.evaluate("document.activeElement.id || document.activeElement.tagName"))
    assert {"more", "key", "show", "open", "file", "home", "snapshot", "SUMMARY"} <= set(reached)
    tab.page.focus("#key")
    tab.page.keyboard.type(KEYS[0])
    tab.page.keyboard.press("Enter")
    tab.page.wait_for_selector("#revealed:not([hidden])")
    tab.page.wait_for_selector("main[aria-busy=false]")
    message = tab.page.locator("[role=status]").inner_text()
    assert message == "The key reveals a model of 200 Gaussians."
    assert tab.page.evaluate("document.activeElement.id") == "key"  # ready for the next key
    tab.page.focus("#close")
    tab.page.keyboard.press("Enter")
    assert tab.page.locator("#revealed").is_hidden()


@pytest.mark.slow
@pytest.mark.skipif(not AXE.exists(), reason="no axe-core: `make test-web` installs it")
@pytest.mark.parametrize("width", [390, 1280])
def test_accessibility(tab: Visit, page_file: Path, width: int) -> None:
    tab.page.set_viewport_size({"width": width, "height": 800})
    tab.goto(page_file.as_uri())
    if width < 600:
        tab.page.click("#keying > summary")
    tab.try_key(KEYS[0])
    if width < 600:
        tab.page.click("#more")
    for summary in tab.page.locator("#controls details > summary").all():
        summary.click()
    tab.page.evaluate(AXE.read_text())
    found = tab.page.evaluate("axe.run()")
    assert [each["id"] for each in found["violations"]] == []
    assert len(found["passes"]) > 10
    assert tab.page.evaluate("document.documentElement.scrollWidth <= window.innerWidth")


@pytest.mark.slow
def test_save_and_wipe(tab: Visit, page_file: Path, secrets: list[Gaussians], tmp_path: Path) -> None:
    tab.goto(page_file.as_uri() + POSE)
    tab.try_key(KEYS[0])
    tab.save("#download", tmp_path / "secret.ply")
    saved = read_model(tmp_path / "secret.ply")
    assert saved.digest() == secrets[0].digest()
    tab.at(POSE)
    whole = tab.picture()
    assert tab.page.input_value("#wipe") == "100"  # the secret is shown
    tab.page.fill("#wipe", "0")
    assert psnr(tab.picture(), whole) < CLOSE  # the published model
    tab.page.fill("#wipe", "50")
    assert tab.page.locator("#wiping").inner_text().split() == ["Published", "Secret"]
    half = tab.picture()
    border = half.shape[1] // 2
    assert psnr(half[:, border + 2 :], whole[:, border + 2 :]) > 40
    assert psnr(half[:, : border - 2], whole[:, : border - 2]) < CLOSE
    assert tab.save("#snapshot", tmp_path / "view.png") == "stego.png"
    assert (tmp_path / "view.png").read_bytes().startswith(b"\x89PNG")
    published = half[:, : border - 2]
    tab.page.click("#close")
    assert tab.page.locator("#revealed").is_hidden()
    assert psnr(tab.picture()[:, : border - 2], published) > 40  # the pose stays
