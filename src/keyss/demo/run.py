"""The demo: one made-up scene hidden in another, opened with the key and tried with wrong ones."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from keyss import api as verbs
from keyss.core.errors import WrongKeyError
from keyss.core.gaussians import Gaussians
from keyss.core.scene import Scene
from keyss.demo.photographs import write_demo_scene
from keyss.files.scenes import load_scene
from keyss.fitting.config import FitConfig
from keyss.fitting.image_metrics import mean_psnr
from keyss.fitting.loop import Interrupted, Reporter, SilentReporter
from keyss.methods.registry import CarryOptions, LearnedOptions
from keyss.rendering import Backend, resolve_device
from keyss.runs.files import STEGO, plain_names, writers
from keyss.runs.folder import RunFolder, clear
from keyss.runs.metrics import HideMetrics
from keyss.viewer.page import page_with

COVER, SECRET = "tea-table", "golden-knot"
VIEWS, WIDTH, HEIGHT = 48, 160, 120
OPTIONS = LearnedOptions(fit=FitConfig(iterations=1200, max_gaussians=10_000, evaluate_every=400))
WRONG_KEYS = ("open sesame", "0000000000000000", "Demo-key")
SECRET_PLY, WEB, COMPARISON, KEY, SCENES = "secret.ply", "web.spz", "comparison.png", "key.txt", "scenes"
VIEWER = "index.html"


@dataclass(frozen=True)
class DemoResult:
    """What the demo found."""

    metrics: HideMetrics  # as in metrics.json
    refused: int  # wrong keys that were tried and opened nothing


def run_demo(
    out: Path | str,
    *,
    seed: int = 0,
    device: Backend = "auto",
    overwrite: bool = False,
    options: LearnedOptions = OPTIONS,
    views: int = VIEWS,
    width: int = WIDTH,
    height: int = HEIGHT,
    reporter: Reporter | None = None,
) -> DemoResult:
    """Everything from photos to a comparison picture and a page to type the key into, in the folder `out`.

    The key is `demo-key-SEED`, known to everybody, and so is the seed: the pictures are to be the same every
    time, and nothing has to stay hidden. On the CPU, one seed gives the same `stego.ply` and
    `secret.ply` every time. Raises KeyssError and its children; whatever is raised, Ctrl-C included,
    nothing of the demo stays in the folder.
    """
    out, reporter = Path(out), reporter or SilentReporter()
    # Of all stages what an earlier demo left is replaced, and what was made of it since.
    scenes = RunFolder(out, "scenes", {"seed": seed}, overwrite=overwrite)
    try:
        with scenes.work():
            size = {"views": views, "width": width, "height": height, "seed": seed}
            scenes.write(
                {f"{SCENES}/{which}": partial(_photograph, reporter, size) for which in (COVER, SECRET)}
            )
        cover, secret = (load_scene(out / SCENES / which) for which in (COVER, SECRET))
        key = f"demo-key-{seed}"
        verbs.hide(
            out / SCENES / COVER,
            [verbs.Secret(out / SCENES / SECRET, key)],
            method=options.with_fit(seed=seed),
            bound=True,
            min_psnr=0,  # no result of a demo gets lost for being a quick one
            device=device,
            out=out,
            reporter=reporter,
        )
        metrics = verbs.evaluate(out, [key], device=device)
        results = RunFolder(out, "demo", onto=("scenes", "hide"))
        with results.work():
            revealed = verbs.reveal(out / STEGO, key, device=device)
            refused = sum(_is_refused(out / STEGO, wrong, device) for wrong in WRONG_KEYS)
            there = results.write(writers({WEB: _for_the_web(out, cover, secret, key, device)}))
            converted = verbs.reveal(there / WEB, key, device=device)
            picture = io.BytesIO()
            comparison = _comparison(out, revealed, converted, cover, secret, metrics, device)
            comparison.save(picture, "PNG", optimize=True)
            viewer = page_with((out / STEGO).read_bytes(), Path(STEGO).name, up="z")
            files = {SECRET_PLY: revealed, COMPARISON: picture.getvalue(), KEY: f"{key}\n".encode()}
            results.write(writers(files | {VIEWER: viewer}))
        return DemoResult(metrics, refused)
    except BaseException as error:
        clear(out)
        if isinstance(error, Interrupted):  # there is nothing left to continue from
            raise KeyboardInterrupt(*error.args) from error
        raise


def _photograph(reporter: Reporter, size: Mapping[str, int], folder: Path) -> None:
    reporter.start(f"photos of the {folder.name}", size["views"], 0)

    def progress(done: int, _: int) -> None:
        reporter.update(done, 0, {})

    write_demo_scene(folder, folder.name, progress=progress, **size)
    reporter.finish()


def _for_the_web(out: Path, cover: Scene, secret: Scene, key: str, device: Backend) -> Gaussians:
    """The plain secret in the plain cover, carried without training, so that it survives other formats."""
    plain_cover, plain_secret = (out / name for name in plain_names(1))
    return verbs.hide(
        cover,
        [verbs.Secret(secret, key, plain_secret)],
        method=CarryOptions(publish="any"),
        cover_model=plain_cover,
        min_psnr=0,
        device=device,
    ).stego


def _is_refused(stego: Path, key: str, device: Backend) -> bool:
    try:
        verbs.reveal(stego, key, device=device)
    except WrongKeyError:
        return True
    return False


def _comparison(
    out: Path,
    revealed: Gaussians,
    converted: Gaussians,
    cover: Scene,
    secret: Scene,
    metrics: HideMetrics,
    device: Backend,
) -> Image.Image:
    """Photos and renders of three test views side by side."""
    count = len(cover.test)
    rows = sorted({count // 6, count // 2, count - 1 - count // 6})

    def photos(scene: Scene) -> list[NDArray[np.uint8]]:
        return [scene.test[row].image.numpy() for row in rows]

    def renders(model: Path | Gaussians, scene: Scene) -> list[NDArray[np.uint8]]:
        images = verbs.render(model, scene, device=device)
        return [images[row][1].numpy() for row in rows]

    decoy = verbs.reveal(out / STEGO, WRONG_KEYS[0], decoy=True, device=device)
    target = resolve_device(device)
    shown, opened = metrics.cover.psnr, metrics.secrets[0].psnr
    wrong = mean_psnr(decoy.to(target), cover.test, cover.background.to(target))
    carried = mean_psnr(converted.to(target), secret.test, secret.background.to(target))
    columns = [
        ("cover: photo", "", photos(cover)),
        ("cover: published model", f"{shown:.1f} dB", renders(out / STEGO, cover)),
        ("secret: photo", "", photos(secret)),
        ("opened with the key", f"{opened:.1f} dB, trained for it", renders(revealed, secret)),
        ("opened from the .spz", f"{carried:.1f} dB, carried", renders(converted, secret)),
        ("with a wrong key", f"{wrong:.1f} dB against the cover", renders(decoy, cover)),
    ]
    return contact_sheet(columns)


def contact_sheet(
    columns: Sequence[tuple[str, str, Sequence[NDArray[np.uint8]]]], cell: int = 240
) -> Image.Image:
    """Columns of images [H, W, 3] of one size, scaled to `cell` pixels' width, under two lines of text."""
    first = columns[0][2][0]
    height = round(first.shape[0] * cell / first.shape[1])
    gap, head = cell // 40, cell // 6
    rows = len(columns[0][2])
    size = gap + len(columns) * (cell + gap), head + rows * (height + gap) + gap
    sheet = Image.new("RGB", size, "white")
    draw = ImageDraw.Draw(sheet)
    large, small = ImageFont.load_default(cell // 15), ImageFont.load_default(cell // 19)
    for index, (title, note, images) in enumerate(columns):
        x = gap + index * (cell + gap)
        draw.text((x, gap // 2), title, fill=(20, 20, 20), font=large)
        draw.text((x, gap // 2 + cell // 12), note, fill=(90, 90, 90), font=small)
        for row, image in enumerate(images):
            picture = Image.fromarray(image).resize((cell, height), Image.Resampling.LANCZOS)
            sheet.paste(picture, (x, head + row * (height + gap)))
    return sheet
