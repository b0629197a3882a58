"""`hide`: secrets in a cover, measured as they come out again."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import msgspec
import torch

from keyss._verbs.asking import Secret, inputs_of, method_for
from keyss._verbs.together import begun, together
from keyss.channels.base import Payload
from keyss.core.errors import QualityError, UsageError
from keyss.core.gaussians import Gaussians, same_bits
from keyss.core.scene import Scene
from keyss.files.models import is_model_path, read_model
from keyss.fitting.config import FitConfig
from keyss.fitting.image_metrics import quality
from keyss.fitting.loop import Reporter
from keyss.fitting.ranks import here
from keyss.keys import DerivedKey, KeyDerivation
from keyss.keys.derivation import SALT_BYTES
from keyss.measure.hiding import RenderFidelity, Shown, measure_hiding, show
from keyss.methods.base import Context, KeyedSource, Method, MethodOptions, Opened, Source, Stego
from keyss.methods.handed import pack
from keyss.methods.plain_models import Bound, fit_bounds, plain_models
from keyss.methods.registry import open_handed
from keyss.rendering import Backend, resolve_device
from keyss.rendering.orbit import is_model
from keyss.runs.config import Background, PathLike, RunConfig, colour_of, path_of, secret_ids
from keyss.runs.files import (
    CONFIG,
    METRICS,
    MODEL,
    STEGOS,
    bound_names,
    handed_names,
    plain_names,
    stego_name,
    writers,
)
from keyss.runs.folder import RunFolder
from keyss.runs.metrics import FitMetrics, HideMetrics
from keyss.runs.opening import as_scene, open_in
from keyss.runs.planning import check_disk, plan_hiding, worth_planning
from keyss.runs.records import read_record, record_bytes

MIN_PSNR = 20.0  # dB against the plain model; below it, pictures are of another thing
_BETTER_THAN_NOTHING, _GOOD = 3.0, 40.0  # dB; of dark or small objects, empty pictures may pass for good ones


@dataclass(frozen=True)
class HideResult:
    """A hiding and how well it works."""

    stego: Gaussians  # to be published; with a key, all that revealing needs
    metrics: HideMetrics


@together
def hide(
    cover: PathLike | Scene | Gaussians,
    secrets: Sequence[Secret],
    *,
    method: str | MethodOptions = "learned",
    width: int | None = None,
    background: Background = None,
    skip_missing: bool = False,
    cover_model: PathLike | Gaussians | None = None,
    bound: bool = False,
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

    With `bound`, scenes that were trained for longer than their plain models are compared with plain 3DGS of
    as many Gaussians and as many training steps, fitted for that; without, `metrics.json` says which of its
    `baseline` had fewer steps.

    At the end what was written is opened with the keys and rendered beside the plain models. Where one comes
    to less than `min_psnr` (dB), or is no better than empty pictures, nothing is published, and QualityError
    is raised; checkpoints stay. Of several processes of torchrun the first writes, measures and reports.
    Raises KeyssError and its other children; Interrupted on Ctrl-C.
    """
    if out is not None and is_model_path(out):
        raise UsageError(
            f"{out}: expected the name of a folder; the model in it is a .ply, in whose low bits secrets "
            'lie, or with `method="carry"` what its `publish` says'
        )
    chosen, options = method_for(method, secrets)
    repeatable, ranks = options.fit.seed is not None, here()
    interrupted = Path(out) if resume and out is not None else None
    options = replace(options, fit=begun(options.fit, interrupted, "options", "fit"))
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
    if out is not None and ranks.first:
        told = asdict(settings) | {"models": [m and path_of(m) for m in models]}
        told |= {"bound": True} if bound else {}
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
    fitted = [_steps_of(model, options.fit) for model in models]
    if folder:
        check_disk(folder.path, chosen, options, inputs)
    trains = chosen.trains or any(each.model is None for each in inputs)
    scenes = [
        as_scene(
            source,
            width,
            background,
            train_pictures=trains,
            skip_missing=skip_missing,
            model=None if each.photos else each.model,
        )
        for source, each in zip(sources, inputs, strict=True)
    ]
    if reporter and ranks.first and trains and not resume and worth_planning(options.fit):
        place = folder.path if folder else None
        reporter.note(f"hide: {plan_hiding(chosen, options, inputs, scenes, target, place, bound=bound)}")
    with folder.work() if folder else nullcontext():
        context = Context(target, folder.checkpoints if folder and trains else None, resume, reporter)
        plain = plain_models(scenes, [each.model for each in inputs], options.fit, context)
        own, *others = map(Source, scenes, plain)
        if repeatable:
            context = replace(context, entropy=_entropy(keys, options, plain))
        elif ranks.count > 1:  # what they go on with, as with `bound`, is then the same
            context = replace(context, entropy=ranks.from_first(os.urandom(32)))
        stego = chosen.hide(own, list(map(KeyedSource, others, keys)), options, context)
        shown: list[Shown] = []
        if ranks.first:
            shown = [
                show(model.to(target), original.to(target), scene, of_plain=not each.photos)
                for model, original, scene, each in zip(
                    _as_read(stego, keys, folder), plain, scenes, inputs, strict=True
                )
            ]
            _check_quality(shown, min_psnr)
        photos = tuple(each.photos for each in inputs)
        bounds = list(map(Bound.of, options.training(len(scenes)), fitted))
        longer = _longer(bounds, scenes, plain, photos, stego, options, context) if bound else {}
        if ranks.first:
            metrics = _measured(
                chosen, stego, scenes, plain, photos, options, shown, target, bounds, fitted, longer
            )
        if folder:
            payloads = secret_ids(options.fit.known_seed, stego.opened)
            made = dict(zip(plain_names(len(secrets)), plain, strict=True))
            made |= {bound_names(len(secrets))[index]: model for index, model in longer.items()}
            settings = replace(settings, options=options, payloads=payloads)
            folder.write(writers({**made, CONFIG: settings, METRICS: metrics}))
    if ranks.count > 1:
        found = json.dumps(asdict(metrics) if ranks.first else None)  # which keeps what is not a number
        metrics = msgspec.convert(json.loads(ranks.from_first(found.encode())), HideMetrics)
    return HideResult(stego.gaussians, metrics)


def _key_checks(keys: Sequence[str], settings: RunConfig[MethodOptions]) -> list[str]:
    """By what a resumed run knows its keys: to guess one from it takes as long as from what is published."""
    salt = hashlib.sha256(b"keyss/v1/resume" + record_bytes(settings)).digest()[:SALT_BYTES]
    derivation = KeyDerivation(salt=salt)
    return [DerivedKey(key, derivation).verifier().hex() for key in keys if key]


def _entropy(keys: Sequence[str], options: MethodOptions, plain: Sequence[Gaussians]) -> bytes:
    """32 bytes that nobody knows without the keys; other inputs or options have others."""
    seed, settings = options.fit.known_seed, msgspec.to_builtins(options)
    if options.fit.views_per_step is None:  # came later than seeds, what these give stays as it was
        del settings["fit"]["views_per_step"]
    salt = hashlib.sha256(f"keyss/v1/repeat {seed}".encode()).digest()[:SALT_BYTES]
    parts = [DerivedKey(key, KeyDerivation(salt=salt)).expand("writer", 32) for key in keys if key]
    parts += [record_bytes(settings), *(model.digest().encode() for model in plain)]
    return hashlib.sha256(b"".join(hashlib.sha256(each).digest() for each in parts)).digest()


def _handed_files(payloads: Sequence[Payload], keys: Sequence[str]) -> dict[str, bytes]:
    """What is handed over, by the names of files in the run's folder."""
    packed = [pack(payload, key or None) for payload, key in zip(payloads, keys, strict=bool(payloads))]
    return dict(zip(handed_names(len(packed)), packed, strict=True))


def _as_read(stego: Stego, keys: Sequence[str], folder: RunFolder | None) -> list[Gaussians]:
    """The stego model and the secrets as a reader gets them, from the files that are to be given away."""
    model, handed = stego.gaussians, _handed_files(stego.handed, keys)
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


def _check_quality(shown: Sequence[Shown], least: float) -> None:
    """Raise QualityError where the cover or a secret does not come out as it should."""
    for index, each in enumerate(_fidelity(shown)):
        who = "the cover" if index == 0 else "the secret" if len(shown) == 2 else f"secret {index}"
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


def _fidelity(shown: Sequence[Shown]) -> tuple[RenderFidelity, ...]:
    """Of cover and secrets to their plain models, which all have one here."""
    return tuple(each.fidelity for each in shown if each.fidelity is not None)


def _steps_of(model: PathLike | Gaussians | None, fit: FitConfig) -> int | None:
    """Steps of the training of a plain model: one that is fitted here, or one that `fit` wrote."""
    if model is None:
        return fit.iterations
    if isinstance(model, Gaussians) or Path(model).name != MODEL:
        return None
    metrics = Path(model).parent / METRICS
    return read_record(metrics, FitMetrics).iterations if metrics.is_file() else None


def _longer(
    bounds: Sequence[Bound],
    scenes: Sequence[Scene],
    plain: Sequence[Gaussians],
    photos: Sequence[bool],
    stego: Stego,
    options: MethodOptions,
    context: Context,
) -> dict[int, Gaussians]:
    """Plain 3DGS of the scenes that were trained for longer than their plain models, by their index."""
    sizes = [len(stego.gaussians), *(len(each.reveal(stego.gaussians)) for each in stego.opened)]
    configs = {
        # A secret that lost Gaussians for want of room is compared with one that has no more.
        index: each.config(options.fit, size if size < len(model) else None)
        for index, (each, model, size) in enumerate(zip(bounds, plain, sizes, strict=True))
        if not each.equal and each.steps is not None and photos[index]
    }
    return fit_bounds(scenes, configs, context)


def _measured(
    method: Method,
    stego: Stego,
    scenes: Sequence[Scene],
    models: Sequence[Gaussians],  # plain ones of the scenes
    photos: tuple[bool, ...],  # whether the scenes have some
    options: MethodOptions,
    shown: Sequence[Shown],  # beside the plain models
    device: torch.device,
    bounds: Sequence[Bound],
    fitted: Sequence[int | None],  # steps of the plain models
    longer: Mapping[int, Gaussians],  # plain models with the steps of their bounds
) -> HideMetrics:
    """What `stego` comes to."""
    baselines = [longer.get(index, model) for index, model in enumerate(models)]
    beside_bounds = [
        replace(each, plain=quality(longer[index].to(device), scene.test, scene.background.to(device)))
        if index in longer
        else each
        for index, (each, scene) in enumerate(zip(shown, scenes, strict=True))
    ]
    measured = measure_hiding(
        stego.gaussians.to(device),
        stego.opened,
        scenes,
        baselines,
        steps=[each.steps if index in longer else fitted[index] for index, each in enumerate(bounds)],
        equal=[each.equal or index in longer for index, each in enumerate(bounds)],
        seed=options.fit.known_seed,
        shown=beside_bounds,
    )
    return HideMetrics(
        **vars(measured),
        method=method.name,
        gaussians=len(stego.gaussians),
        photos=photos,
        secret_gaussians=tuple(len(each.reveal(stego.gaussians)) for each in stego.opened),
        iterations=stego.iterations,
        steps=tuple(each.steps for each in bounds),
        seconds=round(stego.seconds, 1),
        width=scenes[0].train[0].camera.width,
        seed=options.fit.known_seed,
        against_plain=_fidelity(shown),
        details=stego.details,
    )
