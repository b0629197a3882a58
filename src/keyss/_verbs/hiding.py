"""`hide`: secrets in a cover, measured as they come out again."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import torch

from keyss._verbs.asking import Secret, inputs_of, method_for
from keyss.channels.base import Payload
from keyss.core.errors import QualityError, UsageError
from keyss.core.gaussians import Gaussians, same_bits
from keyss.core.scene import Scene
from keyss.files.models import is_model_path, read_model
from keyss.fitting.loop import Reporter
from keyss.keys import DerivedKey, KeyDerivation
from keyss.keys.derivation import SALT_BYTES
from keyss.measure.hiding import RenderFidelity, measure_hiding, render_fidelity
from keyss.methods.base import Context, KeyedSource, Method, MethodOptions, Opened, Source, Stego
from keyss.methods.handed import pack
from keyss.methods.plain_models import plain_models
from keyss.methods.registry import open_handed
from keyss.rendering import Backend, resolve_device
from keyss.rendering.orbit import is_model
from keyss.runs.config import Background, PathLike, RunConfig, colour_of, path_of, secret_ids
from keyss.runs.files import CONFIG, METRICS, STEGOS, handed_names, plain_names, stego_name, writers
from keyss.runs.folder import RunFolder, recorded_seed
from keyss.runs.metrics import HideMetrics
from keyss.runs.opening import as_scene, open_in
from keyss.runs.planning import check_disk, plan_hiding, worth_planning
from keyss.runs.records import record_bytes

MIN_PSNR = 20.0  # dB against the plain model; below it, pictures are of another thing
_BETTER_THAN_NOTHING, _GOOD = 3.0, 40.0  # dB; of dark or small objects, empty pictures may pass for good ones


@dataclass(frozen=True)
class HideResult:
    """A hiding and how well it works."""

    stego: Gaussians  # to be published; with a key, all that revealing needs
    metrics: HideMetrics


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

    Cover and secrets are scenes, or models of any format, of which pictures are rendered. Plain models of all
    scenes come first unless they are given. `method`: a name for default options, or a method's own options
    (`LearnedOptions`, `CarryOptions`). `width`, `background`, `skip_missing`: see `load_scene`.
    Without a seed in the options' `fit` the run draws one from the system, and `config.json` records it; to
    be resumed it needs none. With one, the same arguments give the same bytes on a CPU with as many threads.

    The secrets lie encrypted in `stego.ply`, or what the options' `publish` says. `out` (a folder) gets it in
    `publish/`, and `private/` with the plain models, `config.json` and `metrics.json`, and with what methods
    hand over that need more than the published file (`keyss.methods.handed`); while it runs, checkpoints from
    which `resume` goes on.

    At the end what was written is opened with the keys and rendered beside the plain models. Where one comes
    to less than `min_psnr` (dB), or is no better than empty pictures, nothing is published, and QualityError
    is raised; checkpoints stay. Raises KeyssError and its other children; Interrupted on Ctrl-C.
    """
    if out is not None and is_model_path(out):
        raise UsageError(
            f"{out}: expected the name of a folder; the model in it is a .ply, in whose low bits secrets "
            'lie, or with `method="carry"` what its `publish` says'
        )
    chosen, options = method_for(method, secrets)
    repeatable = options.fit.seed is not None
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
            writes=(*STEGOS, CONFIG),
            inputs=[Path(each) for each in (*sources, *models) if isinstance(each, str | Path)],
            overwrite=overwrite,
            resume=resume,
        )
    inputs = inputs_of(sources, models)
    options = chosen.prepare(inputs, options)
    if folder:
        check_disk(folder.path, chosen, options, inputs)
    trains = chosen.trains or any(each.model is None for each in inputs)
    scenes = [
        as_scene(source, width, background, train_pictures=trains, skip_missing=skip_missing)
        for source in sources
    ]
    if reporter and trains and not resume and worth_planning(options.fit):
        place = folder.path if folder else None
        reporter.note(f"hide: {plan_hiding(chosen, options, inputs, scenes, target, place)}")
    with folder.work() if folder else nullcontext():
        context = Context(target, folder.checkpoints if folder and trains else None, resume, reporter)
        plain = plain_models(scenes, [each.model for each in inputs], options.fit, context)
        own, *others = map(Source, scenes, plain)
        if repeatable:
            context = replace(context, entropy=_entropy(keys, options, plain))
        stego = chosen.hide(own, list(map(KeyedSource, others, keys)), options, context)
        handed = _handed_files(stego.handed, keys)
        against_plain = tuple(
            render_fidelity(model.to(target), original.to(target), scene)
            for model, original, scene in zip(
                _as_read(stego, keys, handed, folder), plain, scenes, strict=True
            )
        )
        _check_quality(against_plain, min_psnr)
        photos = tuple(each.photos for each in inputs)
        metrics = _measured(chosen, stego, scenes, plain, photos, options, against_plain, target)
        if folder:
            payloads = secret_ids(options.fit.known_seed, stego.opened)
            made = dict(zip(plain_names(len(secrets)), plain, strict=True))
            settings = replace(settings, options=options, payloads=payloads)
            folder.write(writers({**made, CONFIG: settings, METRICS: metrics}))
    return HideResult(stego.gaussians, metrics)


def _key_checks(keys: Sequence[str], settings: RunConfig[MethodOptions]) -> list[str]:
    """By what a resumed run knows its keys: to guess one from it takes as long as from what is published."""
    salt = hashlib.sha256(b"keyss/v1/resume" + record_bytes(settings)).digest()[:SALT_BYTES]
    derivation = KeyDerivation(salt=salt)
    return [DerivedKey(key, derivation).verifier().hex() for key in keys if key]


def _entropy(keys: Sequence[str], options: MethodOptions, plain: Sequence[Gaussians]) -> bytes:
    """32 bytes that nobody knows without the keys; other inputs or options have others."""
    seed = options.fit.known_seed
    salt = hashlib.sha256(f"keyss/v1/repeat {seed}".encode()).digest()[:SALT_BYTES]
    parts = [DerivedKey(key, KeyDerivation(salt=salt)).expand("writer", 32) for key in keys if key]
    parts += [record_bytes(options), *(model.digest().encode() for model in plain)]
    return hashlib.sha256(b"".join(hashlib.sha256(each).digest() for each in parts)).digest()


def _handed_files(payloads: Sequence[Payload], keys: Sequence[str]) -> dict[str, bytes]:
    """What is handed over, by the names of files in the run's folder."""
    packed = [pack(payload, key or None) for payload, key in zip(payloads, keys, strict=bool(payloads))]
    return dict(zip(handed_names(len(packed)), packed, strict=True))


def _as_read(
    stego: Stego, keys: Sequence[str], handed: Mapping[str, bytes], folder: RunFolder | None
) -> list[Gaussians]:
    """The stego model and the secrets as a reader gets them, from the files that are to be given away."""
    model = stego.gaussians
    if folder:
        name = stego_name(model)
        model = read_model(folder.write(writers({name: model, **handed})) / name)
    opened: Sequence[Opened]
    if handed:
        opened = [open_handed(data, key or None) for data, key in zip(handed.values(), keys, strict=True)]
    elif stego.verified and same_bits(model, stego.gaussians):
        opened = stego.opened  # to open the same bits once more would show nothing new
    else:
        opened = [open_in(model, key) for key in keys]
    return [model, *(each.reveal(model) for each in opened)]


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
        width=scenes[0].train[0].camera.width,
        seed=options.fit.known_seed,
        against_plain=against_plain,
        details=stego.details,
    )
