"""The demo: hides one synthetic scene in another, reveals it with its key, and tries wrong keys."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import keyss
from keyss.core import Gaussians, Interrupted, Scene, WrongKeyError
from keyss.core.arrays import Bytes
from keyss.files import load_scene
from keyss.files.atomic import public_mode
from keyss.fitting import FitConfig, mean_psnr
from keyss.measure.renders import contact_sheet
from keyss.methods import CarryOptions
from keyss.progress import Reporter, reporter as default_reporter
from keyss.rendering import Backend, resolve_device
from keyss.runs.files import STEGO, plain_names
from keyss.runs.folder import RunFolder, clear
from keyss.runs.run_records import HideMetrics
from keyss.viewer.look import look_of_scene
from keyss.viewer.page import page_with

COVER, SECRET = "tea-table", "golden-knot"
FOLDER = Path(__file__).parent / "scenes"  # each 48 photos of 160 x 120, their cameras, and 3,000 points
OPTIONS = CarryOptions(fit=FitConfig(iterations=400, max_gaussians=10_000, evaluate_every=100))
WRONG_KEYS = ("open sesame", "0000000000000000", "Demo-key")
SECRET_PLY, WEB, COMPARISON, KEY, SCENES = "secret.ply", "web.spz", "comparison.png", "key.txt", "scenes"
VIEWER = "index.html"
_OPEN_SECONDS = 12.0  # to open the published files and compare their pictures


@dataclass(frozen=True)
class DemoResult:
    """The measurements of the demo."""

    metrics: HideMetrics  # content of metrics.json
    refused: int  # number of wrong keys that opened nothing


def run_demo(
    out: Path | str,
    *,
    seed: int = 0,
    device: Backend = "auto",
    overwrite: bool = False,
    options: CarryOptions = OPTIONS,
    width: int | None = None,
    reporter: Reporter | None = None,
) -> DemoResult:
    """Hide one scene in the other, open it, and write a comparison picture and a viewer page to `out`.

    `width`: pixels to which photos are shrunk. The key is `demo-key-SEED`, which is public. On the CPU, the
    same seed gives the same `model.ply` and `secret.ply`. Raises KeyssError. On any exception, Ctrl-C
    included, the demo removes everything it wrote.
    """
    out, reporter = Path(out), reporter or default_reporter()
    # Replaces all files of an earlier demo, those of other stages included.
    scenes = RunFolder(out, "scenes", {"seed": seed}, overwrite=overwrite)
    try:
        with scenes.work():
            paths = [path for which in (COVER, SECRET) for path in sorted((FOLDER / which).rglob("*"))]
            photos = {f"{SCENES}/{path.relative_to(FOLDER)}": path for path in paths if path.is_file()}
            scenes.write({name: path.read_bytes() for name, path in photos.items()})
        cover, secret = (load_scene(out / SCENES / which, width=width) for which in (COVER, SECRET))
        key = f"demo-key-{seed}"
        keyss.hide(
            out / SCENES / COVER,
            [keyss.Secret(out / SCENES / SECRET, key)],
            method=options.with_fit(seed=seed),
            bound=True,
            min_psnr=0,  # a quick demo writes its result, however poor
            views=keyss.ViewOptions(width),
            device=device,
            out=out,
            reporter=reporter,
        )
        metrics = keyss.evaluate(out, [key], device=device, reporter=reporter)
        results = RunFolder(out, "demo", onto=("scenes", "hide"))
        with results.work(), reporter.waiting("opening it again, with right and wrong keys", _OPEN_SECONDS):
            revealed = keyss.reveal(out / STEGO, key, device=device).gaussians
            refused = sum(_is_refused(out / STEGO, wrong, device) for wrong in WRONG_KEYS)
            there = results.write({WEB: _hide_for_web(out, cover, secret, key, device)})
            converted = keyss.reveal(there / WEB, key, device=device).gaussians
            comparison = _comparison(out, revealed, converted, cover, secret, metrics, device)
            look = look_of_scene(out / SCENES / COVER)
            viewer = page_with((out / STEGO).read_bytes(), Path(STEGO).name, look)
            files = {SECRET_PLY: revealed, COMPARISON: comparison, KEY: f"{key}\n".encode()}
            results.write(files | {VIEWER: viewer})
        for name in (VIEWER, WEB):  # pages contain published models
            (out / name).chmod(public_mode())
        return DemoResult(metrics, refused)
    except BaseException as error:
        clear(out)
        if isinstance(error, Interrupted):  # nothing is left to resume
            raise KeyboardInterrupt(*error.args) from error
        raise


def _hide_for_web(out: Path, cover: Scene, secret: Scene, key: str, device: Backend) -> Gaussians:
    """Carry the plain secret in the plain cover so that it survives conversion to other formats."""
    plain_cover, plain_secret = (out / name for name in plain_names(1))
    hidden = keyss.hide(
        cover,
        [keyss.Secret(secret, key, plain_secret)],
        method=CarryOptions(publish="converted"),
        cover_model=plain_cover,
        min_psnr=0,
        device=device,
        reporter=Reporter(),
    )
    assert hidden.stego is not None
    return hidden.stego


def _is_refused(stego: Path, key: str, device: Backend) -> bool:
    try:
        keyss.reveal(stego, key, device=device)
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
) -> bytes:
    """Photos and renders of three test views side by side."""
    count = len(cover.test)
    rows = sorted({count // 6, count // 2, count - 1 - count // 6})

    def photos(scene: Scene) -> list[Bytes]:
        return [scene.test[row].image.numpy() for row in rows]

    def renders(model: Path | Gaussians, scene: Scene) -> list[Bytes]:
        images = keyss.render(model, scene, device=device)
        return [images[row][1].numpy() for row in rows]

    target = resolve_device(device)
    shown, opened = metrics.cover.psnr, metrics.secrets[0].psnr
    carried = mean_psnr(converted.to(target), secret.test, secret.background.to(target))
    columns = {
        "cover: photo": photos(cover),
        f"cover: published model\n{shown:.1f} dB": renders(out / STEGO, cover),
        "secret: photo": photos(secret),
        f"opened with the key\n{opened:.1f} dB": renders(revealed, secret),
        f"opened from the .spz\n{carried:.1f} dB": renders(converted, secret),
    }
    pictures = zip(*columns.values(), strict=True)
    return contact_sheet(
        list(columns), {f"view {row}": images for row, images in zip(rows, pictures, strict=True)}
    )
