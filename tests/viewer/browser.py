"""The page in headless Chromium, and renders of the same pose."""

from __future__ import annotations

import io
import math
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs

import numpy as np
import pytest
import torch
from PIL import Image

from channels.lsb.trained_like import trained_like
from keyss.core import Camera, Gaussians
from keyss.rendering import render

ROOT = Path(__file__).parents[2]
WEB = ROOT / "web"
NAMES = ("chromium-headless-shell", "chromium", "google-chrome", "chromium-browser")
PROGRAM = next((path for name in NAMES if (path := shutil.which(name))), None)
SWITCHES = [
    *("--no-sandbox", "--disable-dev-shm-usage", "--disable-background-networking"),
    *("--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"),
]
IN_CHROMIUM = [pytest.mark.argon2, pytest.mark.skipif(PROGRAM is None, reason="no Chromium on PATH")]
PATIENCE = 120_000  # milliseconds
WIDTH, HEIGHT = 400, 300  # of the canvas, beside the panel
PANEL = 340
KEYS = ("the first key", "ein zweiter Schlüssel")
POSE = "#eye=1.5,-1.2,-6&target=0.2,0.1,0"
FAR = "#eye=3,-2.4,-12&target=0.2,0.1,0"  # engines limit the size of near Gaussians
CLOSE = 25.0  # dB on the canvas
Picture = np.ndarray[Any, np.dtype[np.float64]]


def bright_model(count: int, seed: int) -> Gaussians:
    """Gaussians with strongly view-dependent colours."""
    model = trained_like(count, seed)
    sh = model.sh * torch.tensor([8.0, *[4.0] * 15])[None, :, None]
    return replace(model, log_scales=0.5 * model.log_scales, sh=sh)


def camera_at(address: str, width: int, height: int) -> Camera:
    """The page's camera at a pose of its address, as `web/src/page/pose.ts` defines it."""
    numbers = {name: each[0].split(",") for name, each in parse_qs(address.rpartition("#")[2]).items()}
    axes = {"z": [0.0, 0, 1], "-y": [0.0, -1, 0]}
    up = axes.get(",".join(numbers.get("up", ["-y"])))
    eye, target, up = (
        torch.tensor([float(value) for value in values]).double()
        for values in (numbers["eye"], numbers["target"], up or numbers["up"])
    )
    forward = torch.nn.functional.normalize(target - eye, dim=0)
    right = torch.nn.functional.normalize(torch.linalg.cross(forward, up), dim=0)
    viewmat = torch.eye(4)
    viewmat[:3, :3] = torch.stack([right, torch.linalg.cross(forward, right), forward])
    viewmat[:3, 3] = -viewmat[:3, :3] @ eye.float()
    wide, high = (math.tan(math.radians(float(each) / 2)) for each in numbers.get("fov", ["1", "50"]))
    focal = height / 2 / max(high, wide * height / width)
    K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    return Camera(viewmat, K, width, height)


def render_pose(model: Gaussians, address: str, width: int = WIDTH, height: int = HEIGHT) -> Picture:
    """Our render [H, W, 3], 0 to 255, of the pose in a URL."""
    camera = camera_at(address, width, height)
    return (render(model, camera).clamp(0, 1) * 255).numpy().astype(np.float64)


def psnr(a: Picture, b: Picture) -> float:
    return float(10 * np.log10(255**2 / max(float(((a - b) ** 2).mean()), 1e-9)))


@dataclass
class Visit:
    """A tab with its requests and messages."""

    page: Any
    console_errors: list[str] = field(default_factory=list)
    requests: list[str] = field(default_factory=list)

    def goto(self, address: str) -> None:
        self.page.goto(address)
        self.settle()

    def settle(self) -> None:
        self.page.wait_for_selector("main[data-picture=settled]")

    def at(self, pose: str) -> None:
        """Move the camera, also if the URL has the pose already: secrets never change it."""
        self.page.frames[-1].evaluate(
            "pose => { location.hash = pose;"
            " dispatchEvent(new HashChangeEvent('hashchange', { newURL: location.href })) }",
            pose,
        )

    def picture(self) -> Picture:
        """The canvas [H, W, 3], 0 to 255, once it no longer changes."""
        frame = self.page.frames[-1]
        frame.evaluate("document.querySelector('.panel').style.visibility = 'hidden'")
        try:
            before, deadline = b"", time.monotonic() + PATIENCE / 1000
            while time.monotonic() < deadline:
                now = frame.locator("#picture").screenshot()
                if now == before:
                    break
                before = now
                self.page.wait_for_timeout(700)
        finally:
            frame.evaluate("document.querySelector('.panel').style.visibility = ''")
        return np.asarray(Image.open(io.BytesIO(before)).convert("RGB")).astype(np.float64)

    def try_key(self, key: str, *, thorough: bool = False) -> list[float]:
        """Enter a key and wait for its result; returns the values of the progress bar.

        The slow search of colours is stopped unless `thorough`; after a right key it goes on unseen.
        """
        self.page.fill("#key", key)
        seen = self.page.evaluate(
            """() => new Promise((resolve) => {
                const [main, shown] = [document.getElementById('main'), document.getElementById('progress')];
                const seen = window.seen = [];
                const noting = new MutationObserver(() => seen.push(shown.value));
                noting.observe(shown, { attributeFilter: ['value'] });
                new MutationObserver((_, observer) => {
                    if (main.getAttribute('aria-busy') === 'true') return;
                    observer.disconnect();
                    resolve([...seen]);
                }).observe(main, { attributeFilter: ['aria-busy'] });
                document.getElementById('form').requestSubmit();
            })"""
        )
        self.page.wait_for_selector("main:is([data-searching=thorough], [data-searching=silent])")
        if self.page.get_attribute("main", "data-searching") == "thorough" and not thorough:
            self.page.click("#stop")
            self.page.wait_for_selector("main[data-searching='']")
        if thorough:
            self.page.wait_for_selector("main[data-searching='']")
        self.settle()
        return list(dict.fromkeys(self.page.evaluate("window.seen") if thorough else seen))

    def assert_finds_nothing(self, key: str) -> list[float]:
        """Assert that a key changes nothing visible; returns the result of `try_key`."""
        before = self.picture()
        work = self.try_key(key)
        assert np.abs(self.picture() - before).mean() < 0.01 * 255
        assert self.page.locator("#revealed").is_hidden()
        assert self.page.locator("#progress").is_hidden()
        assert self.page.locator("[role=status]").inner_text() == "Search stopped: nothing found so far."
        assert self.page.locator("#problem").inner_text() == ""
        return work

    def save(self, button: str, path: Path) -> str:
        """Save the download of a button; returns its suggested name."""
        with self.page.expect_download() as download:
            self.page.click(button)
        download.value.save_as(path)
        return str(download.value.suggested_filename)


@contextmanager
def visit(browser: Any, **options: Any) -> Iterator[Visit]:
    """Open a tab, and assert that it logs no errors."""
    page = browser.new_page(**{"viewport": {"width": PANEL + WIDTH, "height": HEIGHT}} | options)
    page.set_default_timeout(PATIENCE)
    found = Visit(page)
    page.on("console", lambda each: found.console_errors.append(each.text) if each.type == "error" else None)
    page.on("pageerror", lambda error: found.console_errors.append(str(error)))
    page.on("request", lambda request: found.requests.append(request.url))
    yield found
    page.close()
    assert found.console_errors == []
