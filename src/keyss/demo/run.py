"""The demo: hides one synthetic scene in another, reveals it with its key, and tries wrong keys."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import torch

import keyss
from keyss.core import Gaussians, Interrupted, Scene, WrongKeyError
from keyss.files import load_scene
from keyss.files.atomic import public_mode
from keyss.fitting import FitConfig, mean_psnr
from keyss.fitting.image_metrics import subsample_views
from keyss.measure.renders import contact_sheet, renders_of
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


def run_demo(
    out: Path | str,
    *,
    seed: int = 0,
    device: Backend = "auto",
    overwrite: bool = False,
    options: CarryOptions = OPTIONS,
    width: int | None = None,
    reporter: Reporter | None = None,
) -> HideMetrics:
    """Hide one scene in the other, open it, and write a comparison picture and a viewer page to `out`.

    `width`: pixels to which photos are shrunk. The key is `demo-key-SEED`, which is public. On the CPU, the
    same seed gives the same `model.ply` and `secret.ply`. Returns the content of `metrics.json`. Raises
    KeyssError, and RuntimeError if a wrong key opens anything. On any exception, Ctrl-C included, the demo
    removes everything it wrote.
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
            for wrong in WRONG_KEYS:
                with suppress(WrongKeyError):
                    keyss.reveal(out / STEGO, wrong, device=device)
                    raise RuntimeError(f"the wrong key {wrong!r} opens the published model")
            there = results.write({WEB: _hide_for_web(out, cover, secret, key, device)})
            converted = keyss.reveal(there / WEB, key, device=device).gaussians
            target = resolve_device(device)
            carried = mean_psnr(converted.to(target), secret.test, secret.background.to(target))
            shown = f"cover: published model\n{metrics.cover.psnr:.1f} dB"
            columns = [
                ("cover: photo", cover, None),
                (shown, cover, keyss.read_model(out / STEGO)),
                ("secret: photo", secret, None),
                (f"opened with the key\n{metrics.secrets[0].psnr:.1f} dB", secret, revealed),
                (f"opened from the .spz\n{carried:.1f} dB", secret, converted),
            ]
            comparison = _comparison(columns, target)
            look = look_of_scene(out / SCENES / COVER)
            viewer = page_with((out / STEGO).read_bytes(), Path(STEGO).name, look)
            files = {SECRET_PLY: revealed, COMPARISON: comparison, KEY: f"{key}\n".encode()}
            results.write(files | {VIEWER: viewer})
        for name in (VIEWER, WEB):  # pages contain published models
            (out / name).chmod(public_mode())
        return metrics
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


def _comparison(columns: Sequence[tuple[str, Scene, Gaussians | None]], device: torch.device) -> bytes:
    """Photos, or renders of models, of three test views side by side."""
    pictures = []
    for _, scene, model in columns:
        views = subsample_views(scene.test, 3)
        if model is None:
            pictures.append([view.image.numpy() for view in views])
        else:
            renders = renders_of(model.to(device), [view.camera for view in views], scene.background)
            pictures.append([image.numpy() for _, image in renders])
    rows = zip(*pictures, strict=True)
    return contact_sheet(
        [head for head, _, _ in columns], {f"view {row}": images for row, images in enumerate(rows, 1)}
    )
