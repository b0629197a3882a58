"""The pictures of the documents, all from the demo: `make pictures`.

demo.jpg is the demo's own comparison; viewer.png the demo's page in Chromium, while its key is typed and
afterwards.
"""

from __future__ import annotations

import argparse
import io
import shutil
from pathlib import Path

from PIL import Image

from keyss.demo import COMPARISON, KEY, VIEWER

FOLDER = Path(__file__).parent
CHROMIUM = ("chromium-headless-shell", "chromium", "google-chrome", "chromium-browser")
SWITCHES = (
    "--no-sandbox",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
)
WINDOW = (900, 560)  # pixels of the page
WIDTH, HEIGHT, GAP = 640, 398, 6  # to which it is shrunk, twice
PATIENCE = 300_000  # milliseconds: nothing here has a GPU
MAX_BYTES = 200_000


def main() -> None:
    parser = argparse.ArgumentParser(description="Make the pictures of the documents from a run of the demo.")
    parser.add_argument("demo", type=Path, help="what `make demo` wrote")
    parser.add_argument("-o", type=Path, default=FOLDER, help="folder for the pictures")
    arguments = parser.parse_args()
    with Image.open(arguments.demo / COMPARISON) as comparison:
        comparison.convert("RGB").save(arguments.o / "demo.jpg", quality=85, optimize=True)
    (arguments.o / "viewer.png").write_bytes(page(arguments.demo))


def page(demo: Path) -> bytes:
    """A PNG of the page twice, of at most 200 kB. Ends the program where there is no Chromium."""
    from playwright.sync_api import sync_playwright

    program = next((path for name in CHROMIUM if (path := shutil.which(name))), None)
    if program is None:
        raise SystemExit(f"viewer.png needs Chromium: none of {', '.join(CHROMIUM)} is on PATH")
    with sync_playwright() as started:
        browser = started.chromium.launch(executable_path=program, args=SWITCHES, timeout=PATIENCE)
        tab = browser.new_page(viewport={"width": WINDOW[0], "height": WINDOW[1]})
        tab.set_default_timeout(PATIENCE)
        tab.goto((demo / VIEWER).resolve().as_uri())
        tab.wait_for_selector("main[data-picture=settled]")
        tab.click("#more")  # less of the panel, so that it hides less
        tab.fill("#key", (demo / KEY).read_text().strip())
        shots = [tab.screenshot()]
        tab.press("#key", "Enter")
        tab.wait_for_selector("#revealed:not([hidden])")
        tab.wait_for_selector("main[aria-busy=false]")
        tab.wait_for_timeout(1000)  # from the last movement to the fine picture
        shots.append(tab.screenshot())
        browser.close()
    both = Image.new("RGB", (2 * WIDTH + GAP, HEIGHT), "white")
    for index, shot in enumerate(shots):
        with Image.open(io.BytesIO(shot)) as picture:
            small = picture.convert("RGB").resize((WIDTH, HEIGHT), Image.Resampling.LANCZOS)
            both.paste(small, (index * (WIDTH + GAP), 0))
    for colours in (256, 128, 64, 32):
        data = io.BytesIO()
        both.quantize(colours, Image.Quantize.MEDIANCUT, dither=Image.Dither.FLOYDSTEINBERG).save(
            data, "PNG", optimize=True
        )
        if data.tell() <= MAX_BYTES:
            return data.getvalue()
    raise SystemExit(f"viewer.png has more than {MAX_BYTES:,} bytes in 32 colours")


if __name__ == "__main__":
    main()
