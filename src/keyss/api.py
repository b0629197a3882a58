"""The verbs a person would say, over files or over objects: what the command line calls.

Each takes paths or what they hold, and writes files only where `out` is given.
"""

from __future__ import annotations

import hashlib
import warnings
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from itertools import combinations
from pathlib import Path
from typing import Literal

import torch
from torch import Tensor

from keyss.audit.run import audit as audit
from keyss.core.errors import KeyssWarning, QualityError, UsageError
from keyss.core.gaussians import DRAWN_OPACITY, Gaussians
from keyss.core.scene import Scene, View
from keyss.files.images import png_bytes
from keyss.files.models import check_model_output, read_model, write_model
from keyss.files.streams import is_standard
from keyss.fitting.config import FitConfig
from keyss.fitting.image_metrics import quality
from keyss.fitting.loop import Reporter
from keyss.fitting.plain import FitResult, fit_scene
from keyss.keys import DerivedKey, KeyDerivation
from keyss.keys.derivation import SALT_BYTES
from keyss.measure.hiding import RenderFidelity, measure_hiding, render_fidelity
from keyss.measure.images import renders_of
from keyss.methods import registry
from keyss.methods.base import Context, Frame, KeyedSource, Method, MethodOptions, SceneInput, Source, Stego
from keyss.methods.plain_models import plain_models
from keyss.rendering import Backend, resolve_device
from keyss.rendering.orbit import is_model
from keyss.report.page import write_report as write_report
from keyss.runs.config import Background, FitRunConfig, PathLike, RunConfig, colour_of, path_of, secret_ids
from keyss.runs.files import CONFIG, METRICS, MODEL, SIDECAR, STEGO, plain_names, writers
from keyss.runs.folder import RunFolder, check_not_published, recorded_seed, write_again
from keyss.runs.metrics import FitMetrics, HideMetrics
from keyss.runs.opening import as_model, as_scene, open_file, open_run, read_sidecar, sidecar_beside
from keyss.runs.planning import Plan, check_disk, plan_hiding
from keyss.runs.records import record_bytes, write_record
from keyss.runs.revealing import RevealResult, reveal_model
from keyss.runs.verifying import Verification, check_model, check_secret

WRONG_KEYS = 32
MIN_PSNR = 20.0  # dB against the plain model; below it, pictures are of another thing
_BETTER_THAN_NOTHING, _GOOD = 3.0, 40.0  # dB; of dark or small objects, empty pictures may pass for good ones
Split = Literal["test", "train", "all"]


@dataclass(frozen=True)
class Secret:
    """A scene, a .ply file or a model to hide, and the key that is to open it."""

    scene: PathLike | Scene | Gaussians
    key: str = field(repr=False)
    model: PathLike | Gaussians | None = None  # a plain 3DGS model of it, if there is one already


@dataclass(frozen=True)
class HideResult:
    """A hiding and how well it works."""

    stego: Gaussians  # to be published; with a key, all that revealing needs unless there is a sidecar
    sidecar: bytes | None  # the encrypted secrets, where they are not in the low bits of `stego`
    metrics: HideMetrics


def fit(
    scene: PathLike | Scene,
    *,
    config: FitConfig | None = None,
    width: int | None = None,
    background: Background = None,
    skip_missing: bool = False,
    device: Backend = "auto",
    out: PathLike | None = None,
    overwrite: bool = False,
    resume: bool = False,
    reporter: Reporter | None = None,
) -> FitResult:
    """Train plain 3DGS on a scene.

    `width`: photos are shrunk to it. `background`, `skip_missing`: see `load_scene`. `out` (a folder) gets
    `model.ply` and `private/` with `config.json` and `metrics.json`; while it runs, checkpoints from which
    `resume` goes on. Without a seed in `config` the run draws one from the system, and `config.json` records
    it; to be resumed it needs none.
    Raises KeyssError and its children; Interrupted on Ctrl-C.
    """
    recorded = recorded_seed(Path(out), "config", "seed") if resume and out is not None else None
    config = (config or FitConfig()).seeded(recorded)
    target = resolve_device(device)
    settings = FitRunConfig(
        scene=path_of(scene),
        width=width,
        background=colour_of(background),
        skip_missing=skip_missing,
        config=config,
    )
    folder = None
    if out is not None:
        told = asdict(settings) | {"device": target.type}
        folder = RunFolder(
            out, "fit", told, writes=(MODEL, CONFIG, METRICS), overwrite=overwrite, resume=resume
        )
    loaded = as_scene(scene, width, background, skip_missing=skip_missing)
    with folder.work() if folder else nullcontext():
        result = fit_scene(
            loaded,
            config,
            device=target,
            title=f"fit {loaded.name}",
            checkpoint=folder.checkpoints / "fit.safetensors" if folder else None,
            resume=resume,
            reporter=reporter,
        )
        if folder:
            test = quality(result.gaussians.to(target), loaded.test, loaded.background.to(target))
            metrics = FitMetrics(
                **asdict(test),
                gaussians=len(result.gaussians),
                iterations=config.iterations,
                seconds=round(result.seconds, 1),
                width=_width(loaded),
                seed=config.known_seed,
            )
            folder.write(writers({MODEL: result.gaussians, CONFIG: settings, METRICS: metrics}))
    return result


def hide(
    cover: PathLike | Scene | Gaussians,
    secrets: Sequence[Secret],
    *,
    method: str | MethodOptions = "learned",
    width: int | None = None,
    background: Background = None,
    skip_missing: bool = False,
    cover_model: PathLike | Gaussians | None = None,
    min_psnr: float = MIN_PSNR,
    device: Backend = "auto",
    out: PathLike | None = None,
    overwrite: bool = False,
    resume: bool = False,
    reporter: Reporter | None = None,
) -> HideResult:
    """Hide every secret in the cover, and measure the result on the test views.

    Cover and secrets are scenes, or `.ply` models, of which pictures are rendered. Plain models of all scenes
    come first unless they are given. `method`: a name for default options, or a method's own options
    (`LearnedOptions`, `CarryOptions`). `width`, `background`, `skip_missing`: see `load_scene`.
    Without a seed in the options' `fit` the run draws one from the system, and `config.json` records it; to
    be resumed it needs none.

    The secrets lie encrypted in the low bits of `stego.ply`; with `LearnedOptions(sidecar=True)` they are in
    a file `decoder.sealed`. `out` (a folder) gets these in `publish/`, and `private/` with the plain models,
    `config.json` and `metrics.json`; while it runs, checkpoints from which `resume` goes on.

    At the end what was written is opened with the keys and rendered beside the plain models. Where one comes
    to less than `min_psnr` (dB), or is no better than empty pictures, nothing is published, and QualityError
    is raised; checkpoints stay. Raises KeyssError and its other children; Interrupted on Ctrl-C.
    """
    chosen, options = _method(method, secrets)
    recorded = recorded_seed(Path(out), "options", "fit", "seed") if resume and out is not None else None
    options = replace(options, fit=options.fit.seeded(recorded))
    keys = [secret.key for secret in secrets]
    target = resolve_device(device)
    sources = [cover, *(secret.scene for secret in secrets)]
    models = [cover_model, *(secret.model for secret in secrets)]
    settings = RunConfig(
        method=chosen.name,
        cover=path_of(cover),
        secrets=tuple(path_of(secret.scene) for secret in secrets),
        models_given=tuple(
            model is not None or (not isinstance(source, Scene) and is_model(source))
            for source, model in zip(sources, models, strict=True)
        ),
        width=width,
        background=colour_of(background),
        skip_missing=skip_missing,
        payloads=(),
        options=options,
    )
    folder = None
    if out is not None:
        told = asdict(settings) | {"device": target.type, "models": [m and path_of(m) for m in models]}
        told["keys"] = _key_checks(keys, settings)
        folder = RunFolder(
            out,
            "hide",
            told,
            onto=("scenes",),
            writes=(STEGO, CONFIG),
            inputs=[Path(each) for each in (*sources, *models) if isinstance(each, str | Path)],
            overwrite=overwrite,
            resume=resume,
        )
    inputs = _inputs(sources, models)
    options = chosen.prepare(inputs, options)
    if folder:
        check_disk(folder.path, chosen, options, inputs)
    trains = chosen.trains or any(each.model is None for each in inputs)
    scenes = [
        as_scene(source, width, background, train_pictures=trains, skip_missing=skip_missing)
        for source in sources
    ]
    with folder.work() if folder else nullcontext():
        context = Context(target, folder.checkpoints if folder and trains else None, resume, reporter)
        plain = plain_models(scenes, [each.model for each in inputs], options.fit, context)
        own, *others = map(Source, scenes, plain)
        stego = chosen.hide(own, list(map(KeyedSource, others, keys)), options, context)
        against_plain = tuple(
            render_fidelity(model.to(target), original.to(target), scene)
            for model, original, scene in zip(_as_read(stego, keys, folder), plain, scenes, strict=True)
        )
        _check_quality(against_plain, min_psnr)
        photos = tuple(each.photos for each in inputs)
        metrics = _measured(chosen, stego, scenes, plain, photos, options, against_plain, target)
        if folder:
            payloads = secret_ids(options.fit.known_seed, stego.opened)
            made = dict(zip(plain_names(len(secrets)), plain, strict=True))
            settings = replace(settings, options=options, payloads=payloads)
            folder.write(writers({**made, CONFIG: settings, METRICS: metrics}))
    return HideResult(stego.gaussians, stego.sidecar, metrics)


def plan(
    cover: PathLike | Scene | Gaussians,
    secrets: Sequence[Secret],
    *,
    method: str | MethodOptions = "learned",
    width: int | None = None,
    background: Background = None,
    skip_missing: bool = False,
    cover_model: PathLike | Gaussians | None = None,
    device: Backend = "auto",
    out: PathLike | None = None,
) -> Plan:
    """What `hide` with these arguments will do, and what it will take: see `keyss.runs.planning`.

    Refuses what `hide` would refuse before its first step, renders and trains for some seconds to time it,
    and writes nothing. `out`: where the results would go; room for them is looked for. Raises
    KeyssError and its children.
    """
    chosen, options = _method(method, secrets)
    target = resolve_device(device)
    sources = [cover, *(secret.scene for secret in secrets)]
    models = [cover_model, *(secret.model for secret in secrets)]
    inputs = _inputs(sources, models)
    options = chosen.prepare(inputs, options)
    if out is not None:
        check_disk(Path(out), chosen, options, inputs)
    scenes = [
        as_scene(source, width, background, train_pictures=False, skip_missing=skip_missing)
        for source in sources
    ]
    return plan_hiding(chosen, options, inputs, scenes, target, None if out is None else Path(out))


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
    """The secret that `key` opens in a stego model, as an ordinary model.

    Which method hid it shows itself. `frame`: "secret" gives it in its own frame, so that its cameras fit it;
    "cover" leaves it where it was hidden, which a carried one never was. If Gaussians were lost, the others
    make up for them (`keyss.core.pruning_compensation`). `force` is for models that were quantised: it skips
    the check that the secret belongs to this one, and takes as little of it as there is.

    `decoder`: a sidecar, or its bytes; by default the one beside the model's file if it opens and belongs to
    it, else what lies in the model's low bits. `out` (a file) gets the revealed PLY. Raises WrongKeyError for
    a key that opens nothing (with `decoy` the cover comes instead, see `keyss.methods.decoy`), InputError for
    files that are not what they should be or do not belong together, and where less than a tenth of the
    secret is left. Warns (KeyssWarning) of more than a hundredth that is missing, and of a sidecar beside
    the file that was passed over. `reveal_counted` and `verify` tell how much there is.
    """
    found = reveal_counted(
        stego,
        key,
        decoder=decoder,
        frame=frame,
        decoy=decoy,
        force=force,
        device=device,
        out=out,
        overwrite=overwrite,
    )
    return found.gaussians


def reveal_counted(
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
) -> RevealResult:
    """`reveal`, with the number of Gaussians that were hidden in the result."""
    target = resolve_device(device)
    beside = None if isinstance(stego, Gaussians) else sidecar_beside(Path(stego))
    inputs = [Path(each) for each in (stego, decoder, beside) if isinstance(each, str | Path)]
    path = None if out is None else check_model_output(out, overwrite, inputs)
    if path is not None and not is_standard(path):
        check_not_published(path)
    found = reveal_model(
        as_model(stego),
        key,
        device=target,
        decoder=decoder,
        beside=beside,
        frame=frame,
        decoy=decoy,
        force=force,
    )
    if not force:
        found.check_usable()
    for sentence in found.warnings:
        warnings.warn(sentence, KeyssWarning, stacklevel=2)
    if path is not None:
        write_model(path, found.gaussians)
    return found


def verify(
    model: PathLike | Gaussians,
    key: str | None = None,
    *,
    decoder: PathLike | bytes | None = None,
    device: Backend = "auto",
) -> Verification:
    """Whether a model is sound and, with a key, whether all is there that the key opens; nothing is written.

    Without a key, nothing that comes back says whether something is hidden. `decoder`: see `reveal`. Raises
    InputError for a file that is no whole and finite model or not the one the secret was hidden in,
    WrongKeyError for a key that opens nothing, UsageError for a decoder without a key.
    """
    if key is None and decoder is not None:
        raise UsageError("a sidecar is verified with its key: give `key`, or leave out `decoder`")
    target = resolve_device(device)
    name = "model" if isinstance(model, Gaussians) else str(model)
    gaussians = as_model(model)
    secret = None
    if key is not None:
        beside = None if isinstance(model, Gaussians) else sidecar_beside(Path(model))
        found = reveal_model(gaussians, key, device=target, decoder=decoder, beside=beside)
        secret = check_secret(found)
    return Verification(name, check_model(gaussians), secret)


def render(
    model: PathLike | Gaussians,
    cameras: PathLike | Scene,
    *,
    split: Split = "test",
    width: int | None = None,
    background: Background = None,
    skip_missing: bool = False,
    device: Backend = "auto",
    out: PathLike | None = None,
    overwrite: bool = False,
) -> list[tuple[str, Tensor]]:
    """Pictures of a model from a scene's cameras: their names and uint8 images [H, W, 3].

    `width`, `background`, `skip_missing`: see `load_scene`; a photo that is left out has no camera. `out` (a
    folder) gets a PNG per camera.
    """
    target = resolve_device(device)
    inputs = [Path(model)] if isinstance(model, str | Path) else []
    folder = RunFolder(out, "render", inputs=inputs, overwrite=overwrite) if out is not None else None
    gaussians = as_model(model).to(target)
    scene = as_scene(cameras, width, background, skip_missing=skip_missing)
    views: dict[str, tuple[View, ...]] = {"test": scene.test, "train": scene.train, "all": scene.views}
    pictures = renders_of(gaussians, scene, views[split])
    if folder:
        with folder.work():
            folder.write(writers({name: png_bytes(image) for name, image in pictures}))
    return pictures


def evaluate(
    run: PathLike,
    keys: Sequence[str],
    *,
    wrong_keys: int | None = None,
    seed: int | None = None,
    device: Backend = "auto",
) -> HideMetrics:
    """Measure a folder that `hide` made again, from its files and the test views; rewrites its
    `metrics.json`.

    `keys`: those of all its secrets, in any order. `wrong_keys`: number of random wrong keys to measure, 32
    by default, drawn from `seed`, by default the run's own; only for methods whose keys condition a decoder.
    Raises WrongKeyError for a key that opens nothing, UsageError for a secret without a key.
    """
    target = resolve_device(device)
    opened = open_run(run, keys)
    if (wrong_keys, seed) != (None, None) and all(each.decode is None for each in opened.opened):
        raise UsageError(
            f"wrong keys show nothing of what the method {opened.config.method} hid: there is no decoder; "
            "leave out their number and seed"
        )
    measured = measure_hiding(
        opened.stego.to(target),
        opened.opened,
        opened.scenes(train_pictures=False),
        [None if model is None else model.to(target) for model in opened.plain_models()],
        wrong_keys=WRONG_KEYS if wrong_keys is None else wrong_keys,
        seed=opened.metrics.seed if seed is None else seed,
    )
    metrics = replace(opened.metrics, **vars(measured))
    write_again(opened.folder, "hide", METRICS, partial(write_record, record=metrics))
    return metrics


def _method(chosen: str | MethodOptions, secrets: Sequence[Secret]) -> tuple[Method, MethodOptions]:
    """A method and its options. Raises UsageError for as many secrets, or for keys, as it cannot have."""
    if isinstance(chosen, MethodOptions):
        method, options = registry.of_options(chosen), chosen
    else:
        method = registry.get(chosen)
        options = next(iter(method.presets.values()))
    if not 1 <= len(secrets) <= method.most_secrets:
        raise UsageError(
            f"expected 1 to {method.most_secrets} secrets for the method {method.name}, got {len(secrets)}"
        )
    _check_keys([secret.key for secret in secrets])
    return method, options


def _inputs(
    sources: Sequence[PathLike | Scene | Gaussians], models: Sequence[PathLike | Gaussians | None]
) -> list[SceneInput]:
    """Scenes and the plain models that are given with them, or that they are. Raises UsageError."""
    inputs = []
    for index, (source, model) in enumerate(zip(sources, models, strict=True)):
        photos = isinstance(source, Scene) or not is_model(source)
        if not photos:
            if model is not None and model is not source and path_of(model) != (path_of(source) or ""):
                argument = "model" if index else "cover_model"
                what = "a source in memory" if isinstance(source, Gaussians) else source
                raise UsageError(f"{what} is a model itself and needs no other: leave out `{argument}`")
            model = source  # type: ignore[assignment]
        found = None if model is None else as_model(model)
        if found is not None and not (found.opacities >= DRAWN_OPACITY).any():
            what = "the secret" if index else "the cover"
            raise UsageError(f"nothing of {what}'s model can be seen: all of its Gaussians are transparent")
        inputs.append(SceneInput(found, photos))
    return inputs


def _check_keys(keys: Sequence[str]) -> None:
    """Raise UsageError for keys that cannot be, or are the same to key derivation, before any work."""
    cheap = KeyDerivation(salt=bytes(16), time_cost=1, memory_kib=8 * 1024, parallelism=1)
    derived = [DerivedKey(key, cheap) for key in keys]
    for (i, a), (j, b) in combinations(enumerate(derived, 1), 2):
        if a.equals(b):
            raise UsageError(
                f"secrets {i} and {j} have the same key, which can open one of them only: give each its own "
                "(`keyss keygen` makes one)"
            )


def _key_checks(keys: Sequence[str], settings: RunConfig[MethodOptions]) -> list[str]:
    """By what a resumed run knows its keys: to guess one from it takes as long as from what is published."""
    salt = hashlib.sha256(b"keyss/v1/resume" + record_bytes(settings)).digest()[:SALT_BYTES]
    derivation = KeyDerivation(salt=salt)
    return [DerivedKey(key, derivation).verifier().hex() for key in keys]


def _as_read(stego: Stego, keys: Sequence[str], folder: RunFolder | None) -> list[Gaussians]:
    """The stego model and the secrets as a reader gets them, from the files that are to be published."""
    model, sidecar = stego.gaussians, stego.sidecar
    if folder:
        there = folder.write(writers({STEGO: model} | ({SIDECAR: sidecar} if sidecar else {})))
        model, sidecar = read_model(there / STEGO), read_sidecar(there / SIDECAR) if sidecar else None
    return [model, *(open_file(model, key, sidecar).reveal(model) for key in keys)]


def _check_quality(found: Sequence[RenderFidelity], least: float) -> None:
    """Raise QualityError where the cover or a secret does not come out as it should."""
    for index, each in enumerate(found):
        who = "the cover" if index == 0 else "the secret" if len(found) == 2 else f"secret {index}"
        if each.psnr < least:
            raise QualityError(
                f"{who} comes out at {each.psnr:.1f} dB against its plain model, below {least:g} dB: nothing "
                "was published; `min_psnr` sets the limit, and with `resume=True` nothing is trained again"
            )
        if least > 0 and each.psnr < min(each.nothing + _BETTER_THAN_NOTHING, _GOOD):
            raise QualityError(
                f"{who} comes out at {each.psnr:.1f} dB against its plain model, and empty pictures "
                f"at {each.nothing:.1f} dB: nothing was published; `min_psnr=0` publishes it all the same, "
                "and with `resume=True` nothing is trained again"
            )


def _measured(
    method: Method,
    stego: Stego,
    scenes: Sequence[Scene],
    models: Sequence[Gaussians],  # plain ones of the scenes
    photos: tuple[bool, ...],  # whether the scenes have some
    options: MethodOptions,
    against_plain: tuple[RenderFidelity, ...],
    device: torch.device,
) -> HideMetrics:
    """What `stego` comes to."""
    measured = measure_hiding(
        stego.gaussians.to(device),
        stego.opened,
        scenes,
        [model.to(device) for model in models],
        wrong_keys=WRONG_KEYS,
        seed=options.fit.known_seed,
    )
    return HideMetrics(
        **vars(measured),
        method=method.name,
        gaussians=len(stego.gaussians),
        photos=photos,
        secret_gaussians=tuple(len(each.reveal(stego.gaussians)) for each in stego.opened),
        iterations=stego.iterations,
        seconds=round(stego.seconds, 1),
        width=_width(scenes[0]),
        seed=options.fit.known_seed,
        against_plain=against_plain,
        details=stego.details,
    )


def _width(scene: Scene) -> int:
    return scene.train[0].camera.width
