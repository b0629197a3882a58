"""Speed of the viewer's page in headless Chromium without a GPU: the table of docs/viewer.md.

    python benchmarks/page.py [--count 100000] [--runs 3]
    python benchmarks/page.py --pairs COVER.ply:SECRET.ply ... [--runs 4]  # times of right and wrong keys

A model of SH degree 3 with Gaussians of typical sizes, which carries a secret of 90 % as many Gaussians of
degree 0, is served like by `keyss view`. Measures, in seconds and processor seconds of the browser, the time
to the first image and to the complete one, and from a key to the end of the quick search, or to the first and
the complete image of the secret; frames per second while the camera turns; memory of the tab. Needs
playwright (the `test` extra) and Chromium.
"""

from __future__ import annotations

import argparse
import math
import random
import sys
import tempfile
import threading
import time
from dataclasses import replace
from pathlib import Path

import keyss
from keyss.core import Gaussians
from keyss.methods import CarryOptions
from keyss.viewer import ModelServer, export_html

import psutil
import torch
from playwright.sync_api import sync_playwright

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from viewer.browser import PANEL, PROGRAM, SWITCHES, Visit, bright_model, visit

WIDTH, HEIGHT = 800, 600
KEY = "correct horse battery staple 99"
DRAWN = "() => location.hash.includes('eye') && document.getElementById('picture').dataset.frames > 0"
TURN = """() => new Promise((resolve) => {
    const [start, canvas] = [performance.now(), document.getElementById('picture')];
    const drawn = () => Number(canvas.dataset.frames ?? 0);
    const before = drawn();
    let angle = 0;
    const turn = () => {
        angle += 0.03;
        const eye = [7 * Math.sin(angle), -1, -7 * Math.cos(angle)].map((each) => each.toFixed(3)).join(',');
        location.hash = `#eye=${eye}&target=0,0,0`;
        if (performance.now() - start < 5000) requestAnimationFrame(turn);
        else resolve((1000 * (drawn() - before)) / (performance.now() - start));
    };
    turn();
})"""

UNLOCK = """() => {
    window.first = 0;
    const [start, canvas] = [performance.now(), document.getElementById('picture')];
    let before = null;
    const look = () => {
        if (!document.getElementById('revealed').hidden) before ??= canvas.dataset.frames;
        if (before === null || canvas.dataset.frames === before) setTimeout(look, 5);
        else window.first = (performance.now() - start) / 1000;
    };
    document.getElementById('form').requestSubmit();
    look();
}"""


def sized_model(count: int, seed: int) -> Gaussians:
    """A model with the relative sizes of downloaded models of 90,000 and 150,000 Gaussians.

    In standard deviations of the positions: a median of 0.004 to 0.01, and 10 % above 0.04 to 0.06.
    """
    model = bright_model(count, seed)
    generator = torch.Generator().manual_seed(seed)
    normal = torch.randn(count, 3, generator=generator, dtype=torch.float64)  # random in all bits
    return replace(model, log_scales=(math.log(0.006 * float(model.means.std())) + 1.5 * normal).float())


def server_of(count: int, folder: Path) -> ModelServer:
    """Serve the page and a stego model."""
    cover, secret = sized_model(count, 0), sized_model(count * 9 // 10, 1).with_sh_degree(0)
    hidden = keyss.hide(
        cover, [keyss.Secret(secret, KEY)], views=keyss.ViewOptions(32), min_psnr=0, out=folder / "run"
    )
    print(f"{len(hidden.stego):,} Gaussians carry {len(secret):,}", flush=True)
    server = ModelServer(folder / "run/publish/model.ply")
    threading.Thread(target=server.run, daemon=True).start()
    return server


def memory(tab: Visit) -> float:
    """MiB of the JavaScript heap and its buffers."""
    client = tab.page.context.new_cdp_session(tab.page)
    client.send("HeapProfiler.collectGarbage")
    used = client.send("Runtime.getHeapUsage")
    return float(used["usedSize"] + used.get("backingStorageSize", 0)) / 2**20


def seconds_of(tab: Visit, key: str) -> float:
    """Seconds from a key to the complete image, without the thorough search."""
    start = time.perf_counter()
    tab.try_key(key)
    return time.perf_counter() - start


def processor_seconds() -> float:
    """Of the browser since it started."""
    times = [process.cpu_times() for process in psutil.Process().children(recursive=True)]
    return sum(each.user + each.system for each in times)


def key_times(pairs: list[str], runs: int) -> None:
    """Print seconds of `runs` right and wrong keys for each pair, in random order."""
    overlapping, order = 0, random.Random(0)
    with tempfile.TemporaryDirectory() as name, sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=PROGRAM, args=SWITCHES)
        for number, pair in enumerate(pairs):
            folder = Path(name) / str(number)
            cover, secret = pair.split(":")
            keyss.hide(
                cover,
                [keyss.Secret(secret, KEY)],
                method=CarryOptions(fine_tune="never"),
                views=keyss.ViewOptions(32),
                min_psnr=0,
                out=folder / "run",
            )
            page = export_html(folder / "run/publish/model.ply", folder / "page.html")[0]
            times: dict[str, list[float]] = {KEY: [], "another key": []}
            keys = runs * list(times)
            order.shuffle(keys)
            with visit(browser) as tab:
                tab.goto(page.as_uri())
                tab.try_key("the first key compiles")
                for key in keys:
                    times[key].append(seconds_of(tab, key))
            (low, high), (least, most) = ((min(each), max(each)) for each in times.values())
            overlapping += low <= most and least <= high
            print(f"{pair}: right {low:.2f} to {high:.2f} s, wrong {least:.2f} to {most:.2f} s", flush=True)
    print(f"{overlapping} of {len(pairs)} overlap")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--count", type=int, default=100_000)
    parser.add_argument("--pairs", nargs="*", metavar="COVER:SECRET")
    parser.add_argument("--runs", type=int, default=3)
    asked = parser.parse_args()
    if asked.pairs:
        return key_times(asked.pairs, asked.runs)
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as playwright:
        address = server_of(asked.count, Path(folder)).address
        browser = playwright.chromium.launch(executable_path=PROGRAM, args=SWITCHES)
        for run in range(asked.runs):
            with visit(browser) as tab:
                tab.page.set_viewport_size({"width": PANEL + WIDTH, "height": HEIGHT})
                start, before = time.perf_counter(), processor_seconds()
                tab.page.goto(address)
                for picture in ("first", "complete"):
                    if picture == "first":
                        tab.page.wait_for_function(DRAWN)
                    else:
                        tab.settle()
                    took, spent = time.perf_counter() - start, processor_seconds() - before
                    print(f"run {run}: {picture} picture {took:.1f} s ({spent:.1f} processor s)", flush=True)
                tab.page.wait_for_timeout(5000)  # about as long as it takes to type a key
                for word in ("wrong", "right", "wrong", "right", "wrong"):
                    start, before = time.perf_counter(), processor_seconds()
                    line = f"  {word} key"
                    if word == "right":
                        tab.page.fill("#key", KEY)
                        tab.page.evaluate(UNLOCK)
                        tab.page.wait_for_function("() => window.first")
                        first, spent = tab.page.evaluate("window.first"), processor_seconds() - before
                        line += f" {first:.1f} s ({spent:.1f} processor s) to the first picture,"
                        tab.settle()
                    else:
                        seconds_of(tab, "another key")
                    took, spent = time.perf_counter() - start, processor_seconds() - before
                    print(f"{line} {took:.1f} s ({spent:.1f} processor s), {memory(tab):.0f} MiB", flush=True)
                    if word == "right":
                        tab.page.click("#close")
                for _ in range(3):
                    tab.page.wait_for_timeout(2000)
                    print(f"  {tab.page.evaluate(TURN):.1f} frames per second while turning", flush=True)
        browser.close()


if __name__ == "__main__":
    main()
