"""The verbs a person would say, over files or over objects: what the command line calls.

Each takes paths or what they hold, and writes files only where `out` is given.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from torch import Tensor

from keyss._version import __version__
from keyss.audit.methods import as_opened, metrics_of
from keyss.core.errors import UsageError
from keyss.core.gaussians import Gaussians
from keyss.core.scene import Scene, View
from keyss.files.atomic import write_bytes
from keyss.files.output import OutputFolder, check_output_file
from keyss.files.ply import read_ply, write_ply
from keyss.fitting.config import FitConfig
from keyss.fitting.image_metrics import quality
from keyss.fitting.loop import Reporter
from keyss.fitting.plain import FitResult, fit_scene
from keyss.measure.hiding import measure_hiding
from keyss.measure.images import renders_of
from keyss.methods.carry import verb as carrying
from keyss.methods.carry.carrying import Carried
from keyss.methods.learned.config import HideConfig
from keyss.methods.learned.payload import HiddenSecret
from keyss.methods.learned.pipeline import hide_scenes
from keyss.methods.learned.revealing import Frame
from keyss.rendering import Backend, resolve_device
from keyss.rendering.orbit import is_model
from keyss.runs.files import (
    CONFIG,
    METRICS,
    MODEL,
    SIDECAR,
    STEGO,
    bytes_writer,
    json_bytes,
    json_writer,
    plain_names,
    ply_writer,
    png_writer,
)
from keyss.runs.opening import (
    Background,
    PathLike,
    as_model,
    as_scene,
    fingerprint,
    open_any,
    open_run,
    revealed,
    sidecar_beside,
)

Method = Literal["learned", "carry"]
Split = Literal["test", "train", "all"]


@dataclass(frozen=True)
class Secret:
    """A scene, a .ply file or a model to hide, and the key that is to open it."""

    scene: PathLike | Scene | Gaussians
    key: str
    model: PathLike | Gaussians | None = None  # a plain 3DGS model of it, if there is one already

    def __repr__(self) -> str:
        return f"Secret(scene={self.scene!r}, key=<hidden>)"


@dataclass(frozen=True)
class HideResult:
    """A hiding and how well it works."""

    stego: Gaussians  # to be published; with a key, all that revealing needs unless there is a sidecar
    sidecar: bytes | None  # the sealed secrets, where they are not in the low bits of `stego`
    metrics: dict[str, Any]


def fit(
    scene: PathLike | Scene,
    *,
    config: FitConfig | None = None,
    width: int | None = None,
    background: Background = None,
    device: Backend = "auto",
    out: PathLike | None = None,
    overwrite: bool = False,
    resume: bool = False,
    reporter: Reporter | None = None,
) -> FitResult:
    """Train plain 3DGS on a scene.

    `width`: photos are shrunk to it. `background`: see `load_scene`. `out` (a folder) gets `model.ply`,
    `config.json` and `metrics.json`; while it runs, checkpoints from which `resume` goes on.
    Raises KeyssError and its children; Interrupted on Ctrl-C.
    """
    config = config or FitConfig()
    target = resolve_device(device)
    folder = OutputFolder(out, overwrite=overwrite, resume=resume) if out is not None else None
    loaded = as_scene(scene, width, background)
    result = fit_scene(
        loaded,
        config,
        device=target,
        title=f"fit {loaded.name}",
        checkpoint=folder.checkpoints() / "fit.safetensors" if folder else None,
        resume=resume,
        reporter=reporter,
    )
    if folder is not None:
        test = quality(result.gaussians.to(target), loaded.test, loaded.background.to(target))
        metrics = {
            **asdict(test),
            "gaussians": len(result.gaussians),
            "iterations": config.iterations,
            "seconds": round(result.seconds, 1),
            "width": _width(loaded),
            "seed": config.seed,
            "version": __version__,
        }
        settings = {"scene": _name(scene), "width": width, "config": asdict(config), "version": __version__}
        folder.fill(
            {
                MODEL: ply_writer(result.gaussians),
                CONFIG: json_writer(settings),
                METRICS: json_writer(metrics),
            }
        )
    return result


def hide(
    cover: PathLike | Scene | Gaussians,
    secrets: Sequence[Secret],
    *,
    method: Method = "learned",
    config: HideConfig | None = None,
    width: int | None = None,
    background: Background = None,
    cover_model: PathLike | Gaussians | None = None,
    sidecar: bool = False,
    encoder: Callable[[str], Tensor] | None = None,
    thin: bool = False,
    dither: bool = False,
    device: Backend = "auto",
    out: PathLike | None = None,
    overwrite: bool = False,
    resume: bool = False,
    reporter: Reporter | None = None,
) -> HideResult:
    """Hide every secret in the cover, and measure the result on the test photos.

    Cover and secrets are scenes, or `.ply` models, of which pictures are rendered. Plain models of all scenes
    come first unless they are given. What a key opens lies sealed in the low bits of `stego.ply`, or with
    `sidecar` in a file `decoder.sealed`. `encoder`: from a key to the embedding [64] that conditions the
    decoder, such as a `keyss.methods.learned.clip_keys.ClipKeys`; by default Argon2id's. `out` (a folder)
    gets these, `config.json`, `metrics.json` and `private/` with the plain models; while it runs, checkpoints
    from which `resume` goes on. Raises KeyssError and its children; Interrupted on Ctrl-C.

    With the `method` "carry" the models themselves go into the low bits of the cover's
    (`keyss.methods.carry.verb`): nothing is trained but the models of scenes, cover and secrets may be .ply
    files or `Gaussians`, and of `config` only `fit` counts. `thin` leaves out of secrets that are too large
    what is least visible; `dither` gives new low bits to a cover whose are not random.
    """
    config = config or HideConfig()
    if not secrets:
        raise UsageError("expected at least one secret")
    if sidecar if method == "carry" else (thin or dither):
        raise UsageError("--thin and --dither are for --method carry, --sidecar is for the other")
    target = resolve_device(device)
    folder = OutputFolder(out, overwrite=overwrite, resume=resume) if out is not None else None
    if method == "carry":
        stego, metrics = carrying.hide(
            [(cover, cover_model), *((secret.scene, secret.model) for secret in secrets)],
            [secret.key for secret in secrets],
            carrying.PlainModels(width, background, config.fit, target, folder, resume, reporter),
            thin=thin,
            dithered=dither,
        )
        return HideResult(stego, None, metrics)
    sources = [cover, *(secret.scene for secret in secrets)]
    given = [
        source if model is None and not isinstance(source, Scene) and is_model(source) else model
        for source, model in zip(sources, [cover_model, *(secret.model for secret in secrets)], strict=True)
    ]
    plains = [None if model is None else as_model(model) for model in given]
    scenes = [as_scene(source, width, background) for source in sources]
    keys = [secret.key for secret in secrets]
    hidden = hide_scenes(
        scenes,
        keys,
        config,
        plains=plains,
        sidecar=sidecar,
        encoder=encoder,
        device=target,
        checkpoints=folder.checkpoints() if folder else None,
        resume=resume,
        reporter=reporter,
    )
    quality_found = measure_hiding(
        hidden.stego.to(target),
        [as_opened(each) for each in hidden.secrets],
        scenes,
        [plain.to(target) for plain in hidden.plains],
        seed=config.fit.seed,
    )
    metrics = metrics_of(quality_found, len(hidden.stego))
    metrics |= {
        "iterations": config.fit.iterations,
        "seconds": round(hidden.seconds, 1),
        "width": _width(scenes[0]),
        "seed": config.fit.seed,
        "version": __version__,
    }
    if folder is not None:
        settings = {
            "cover": _name(cover),
            "secrets": [_name(secret.scene) for secret in secrets],
            "models_given": [model is not None for model in given],
            "width": width,
            "background": None if background is None else [float(x) for x in background],
            "key_encoder": "argon2" if encoder is None else type(encoder).__name__,
            "payloads": [fingerprint(secret) for secret in hidden.secrets],
            "config": asdict(config),
            "version": __version__,
        }
        writers: dict[str, Callable[[Path], None]] = {
            STEGO: ply_writer(hidden.stego),
            CONFIG: json_writer(settings),
            METRICS: json_writer(metrics),
        }
        if hidden.sidecar is not None:
            writers[SIDECAR] = bytes_writer(hidden.sidecar)
        for name, plain in zip(plain_names(len(secrets)), hidden.plains, strict=True):
            writers[name] = ply_writer(plain)
        folder.fill(writers)
    return HideResult(hidden.stego, hidden.sidecar, metrics)


def reveal(
    stego: PathLike | Gaussians,
    key: str,
    *,
    decoder: PathLike | bytes | None = None,
    frame: Frame = "secret",
    decoy: bool = False,
    force: bool = False,
    device: Backend = "auto",
    out: PathLike | None = None,
    overwrite: bool = False,
) -> Gaussians:
    """The secret that `key` opens in a stego model, as an ordinary model; see `reveal_gaussians`.

    Which method hid it shows itself. A carried one was never in the cover's frame and comes in its own; if
    Gaussians were lost, the others are enlarged to make up for them (`keyss.core.pruning_compensation`).

    `decoder`: a sidecar, or its bytes; by default the one beside the model's file if there is one, else what
    lies in the model's low bits. `out` (a file) gets the revealed PLY. Raises WrongKeyError for a key that
    opens nothing (with `decoy` the cover comes instead, see `decoy_secret`), InputError for files that are
    not what they should be or do not belong together.
    """
    target = resolve_device(device)
    path = None if out is None else check_output_file(out, overwrite)
    model = as_model(stego)
    if decoder is None and not isinstance(stego, Gaussians):
        decoder = sidecar_beside(Path(stego))
    secret = open_any(model, key, decoder, decoy=decoy)
    found = revealed(model.to(target), secret, frame=frame, force=force)
    if path is not None:
        write_ply(path, found)
    return found


def render(
    model: PathLike | Gaussians,
    cameras: PathLike | Scene,
    *,
    split: Split = "test",
    width: int | None = None,
    background: Background = None,
    device: Backend = "auto",
    out: PathLike | None = None,
    overwrite: bool = False,
) -> list[tuple[str, Tensor]]:
    """Pictures of a model from a scene's cameras: their names and uint8 images [H, W, 3].

    `out` (a folder) gets a PNG per camera.
    """
    target = resolve_device(device)
    folder = OutputFolder(out, overwrite=overwrite) if out is not None else None
    gaussians = as_model(model).to(target)
    scene = as_scene(cameras, width, background)
    views: dict[str, tuple[View, ...]] = {"test": scene.test, "train": scene.train, "all": scene.views}
    pictures = renders_of(gaussians, scene, views[split])
    if folder is not None:
        folder.fill({name: png_writer(image) for name, image in pictures})
    return pictures


def evaluate(
    run: PathLike,
    keys: Sequence[str],
    *,
    wrong_keys: int = 32,
    seed: int = 0,
    device: Backend = "auto",
    reporter: Reporter | None = None,
) -> dict[str, Any]:
    """Measure a folder that `hide` made again, from its files and the photos; rewrites its `metrics.json`.

    `keys`: those of all its secrets, in any order. Raises WrongKeyError for a key that opens nothing,
    UsageError for a secret without a key.
    """
    target = resolve_device(device)
    opened = open_run(run, keys)
    learned = [each for each in opened.opened if isinstance(each, HiddenSecret)]
    carried = [each for each in opened.opened if isinstance(each, Carried)]
    if carried:
        metrics = carrying.evaluate(
            opened.metrics,
            opened.stego,
            carried,
            opened.sources,
            opened.width,
            opened.background,
            target,
        )
    else:
        bounds = [read_ply(opened.folder / name) for name in plain_names(len(learned))]
        found = measure_hiding(
            opened.stego.to(target),
            [as_opened(each) for each in learned],
            opened.scenes(),
            [bound.to(target) for bound in bounds],
            wrong_keys=wrong_keys,
            seed=seed,
        )
        metrics = opened.metrics | metrics_of(found, len(opened.stego))
    write_bytes(opened.folder / METRICS, json_bytes(metrics))
    return metrics


def _name(source: PathLike | Scene | Gaussians) -> str | None:
    """Where a scene can be found again, None for one in memory."""
    return None if isinstance(source, Scene | Gaussians) else str(Path(source).resolve())


def _width(scene: Scene) -> int:
    return scene.train[0].camera.width
