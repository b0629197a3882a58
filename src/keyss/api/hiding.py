"""`hide`: secrets in a cover, revealed again and measured."""

from __future__ import annotations

import hashlib
import math
import time
import warnings
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import torch

from keyss.api.asking import HideResult, Secret, check_keys, method_for, sources_of
from keyss.api.fitting import seeded
from keyss.channels import AnyChannel, Channel, Format, Publish, channel_for, open_content
from keyss.core.errors import KeyssWarning, QualityError, UsageError
from keyss.core.gaussians import Gaussians, same_bits
from keyss.core.scene import Scene, ViewOptions
from keyss.files.models import is_model_path, read_model
from keyss.files.ply_extras import with_extras
from keyss.files.reading import read_file
from keyss.fitting.image_metrics import quality
from keyss.keys import DerivedKey
from keyss.keys.derivation import SALT_BYTES
from keyss.keys.encryption import MAX_PAYLOAD_BYTES
from keyss.measure.hiding import RenderFidelity, Shown, measure_hiding, show
from keyss.methods.base import Context, MethodOptions, Source, Stego
from keyss.methods.handed import pack
from keyss.methods.opened import HiddenFile, Opened
from keyss.methods.plain_models import Bound, fit_bounds, with_plain_models
from keyss.methods.registry import DEFAULT, open_handed, open_model
from keyss.progress import Reporter
from keyss.rendering import Backend, resolve_device
from keyss.rendering.difference import psnr_between
from keyss.rendering.orbit import is_model
from keyss.runs.config import FitMetrics, HideMetrics, RunConfig, secret_ids
from keyss.runs.files import (
    CONFIG,
    METRICS,
    MODEL,
    STEGOS,
    Background,
    PathLike,
    as_3dgs_model,
    as_scene,
    bound_names,
    handed_names,
    path_of,
    plain_names,
    stego_name,
)
from keyss.runs.folder import RunFolder
from keyss.runs.planning import check_disk, in_a_line, plan_hiding, worth_planning
from keyss.runs.records import read_record, record_bytes

MIN_PSNR = 20.0  # dB to the plain model; below it, renders show something else
MIN_PRUNED_PSNR = 25.0  # the same for secrets that lost Gaussians without a refit
# Below this PSNR to the plain model a difference is seen; but nothing is lost where photos are matched nearly
# as well, to so many dB, and so much SSIM.
_FAR, _NEARLY_PSNR, _NEARLY_SSIM = 30.0, 3.0, 0.1
# dB; empty renders of dark or small objects can have a high PSNR, and of invisible ones the highest
_BETTER_THAN_NOTHING, _GOOD, _EMPTY = 3.0, 40.0, 119.0


def hide(
    cover: PathLike | Scene | Gaussians,
    secrets: Sequence[Secret],
    *,
    method: str | MethodOptions = DEFAULT,
    publish: Publish | None = None,
    format: Format | None = None,
    channel: AnyChannel | None = None,
    width: int | None = None,
    background: Background = None,
    skip_missing: bool = False,
    cover_model: PathLike | Gaussians | None = None,
    bound: bool = False,
    min_psnr: float | None = None,
    device: Backend = "auto",
    out: PathLike | None = None,
    overwrite: bool = False,
    resume: bool = False,
    dry_run: bool = False,
    reporter: Reporter | None = None,
) -> HideResult:
    """Hide secrets in a cover, each under its own key, and measure the result on the test views.

    Cover and secrets are scenes of photos, or models of any format, which are rendered for measurements.
    Plain models of scenes are fitted unless they are given. Secrets can also be files, in a cover that is a
    model. `method`: a name, or the options of a method (`CarryOptions`, `KeyssOptions`). `publish`, `format`
    and `channel`, if given, replace those of the options. "as-is" hides where nobody sees it, in a file that
    must stay unchanged: in low bits of a "ply", or in the integers of an "spz", "sog" or "compressed-ply", or
    of a model that was decoded from one. Without a `format` that is the cover's, and where nothing goes in
    unnoticed, "any" with a warning. "any" hides in what survives conversion, which is the channel "appended"
    (more Gaussians, which are visible in the file) or "colours" (less room). `width`, `background`,
    `skip_missing`: see `load_scene`.

    `out` (a folder) gets `publish/` with the stego model, and `private/` with fitted models, `config.json`,
    `metrics.json`, the files to hand over for methods that need them (`keyss.methods.handed`), and
    checkpoints, from which `resume` continues. Without a seed in the options' `fit` the run uses a random
    one, which `config.json` records. With one, the same arguments give the same bytes on a CPU with as many
    threads.

    `bound`: fit plain 3DGS of as many Gaussians and training steps to compare with; otherwise `metrics.json`
    says which baselines had fewer steps. `dry_run`: check arguments, and return only the plan; of
    files, the PSNR.

    At the end the published file is opened with the keys, and rendered beside the plain models. If a PSNR is
    below `min_psnr` (dB; by default 20, and 25 for secrets that were pruned without a refit), or no better
    than that of empty pictures, nothing is published, and QualityError is raised; checkpoints stay.
    Raises other KeyssErrors too, and Interrupted on Ctrl-C.
    """
    if any(secret.file is not None for secret in secrets):
        for name, value in {"resume": resume, "bound": bound}.items():
            if value:
                raise UsageError(f"hiding files does not use `{name}`: leave it out")
        if isinstance(cover, Scene) or not is_model(cover):
            raise UsageError("hiding a file needs a model as the cover; `keyss fit` makes one from photos")
        model = as_3dgs_model(cover, "the cover")
        where = channel_for(publish or "as-is", channel or "colours", format, model)
        found = _hide_files(cover, model, secrets, where, None if dry_run else out, overwrite)
        return replace(found, stego=None) if dry_run else found
    if out is not None and is_model_path(out):
        raise UsageError(
            f"{out}: expected the name of a folder; the format of the model in it follows from `publish`"
        )
    if min_psnr is not None and not math.isfinite(min_psnr):
        raise UsageError(f"`min_psnr`: expected a number of dB, got {min_psnr}")
    chosen, options = method_for(method, secrets)
    asked: dict[str, Any] = {"publish": publish, "format": format, "channel": channel}
    options = replace(options, **{name: value for name, value in asked.items() if value})
    began = time.monotonic()
    interrupted = Path(out) if resume and out is not None else None
    options = replace(options, fit=seeded(options.fit, interrupted, "options", "fit"))
    keys = [secret.key for secret in secrets]
    target = resolve_device(device)
    given = [cover, *(secret.source for secret in secrets)]
    models = [cover_model, *(secret.model for secret in secrets)]
    settings = RunConfig(
        method=chosen.name,
        cover=path_of(cover),
        secrets=tuple(path_of(secret.source) for secret in secrets),
        models_given=tuple(
            model is not None or (not isinstance(source, Scene) and is_model(source))
            for source, model in zip(given, models, strict=True)
        ),
        views=ViewOptions.of(width, background, skip_missing),
        payloads=(),
        options=options,
    )
    folder = None
    place = None if out is None else Path(out)
    if place is not None and not dry_run:
        arguments = asdict(settings) | {"models": [m and path_of(m) for m in models]}
        arguments |= {"bound": True} if bound else {}
        arguments["keys"] = _key_checks(keys, settings)
        folder = RunFolder(
            place,
            "hide",
            arguments,
            onto=("scenes",),
            writes=(*STEGOS, CONFIG),
            inputs=[Path(each) for each in (*given, *models) if isinstance(each, str | Path)],
            overwrite=overwrite,
            resume=resume,
        )
        began -= folder.earlier_seconds
    sources = sources_of(given, models, keys, settings.views)
    options = chosen.prepare(sources, options)
    configs = options.fits(len(sources))
    plain_steps = [
        config.iterations if each.given is None else _steps_of(model)
        for each, model, config in zip(sources, models, configs, strict=True)
    ]
    if place is not None:
        check_disk(place, options, sources)
    trains = not dry_run and (options.trains or any(each.given is None for each in sources))
    sources = [
        each
        if each.photos
        else replace(each, loaded=as_scene(source, settings.views, train_pictures=trains, model=each.given))
        for source, each in zip(given, sources, strict=True)
    ]
    if dry_run:
        return HideResult(plan=plan_hiding(chosen, options, sources, target, place, bound=bound))
    long = (trains and worth_planning(options.fit)) or options.place.grows
    with folder.work() if folder else nullcontext():
        if reporter and not resume and long:
            planned = plan_hiding(chosen, options, sources, target, place, bound=bound)
            for line in (f"hide: {in_a_line(planned)}", *planned.notes):
                reporter.note(line)
        context = Context(target, folder.checkpoints if folder and trains else None, resume, reporter)
        sources = with_plain_models(sources, configs, context)
        if any(each.given is None for each in sources):
            with warnings.catch_warnings():  # the first call has given them
                warnings.simplefilter("ignore", KeyssWarning)
                options = chosen.prepare([replace(each, given=each.model) for each in sources], options)
        plain = [each.model for each in sources]
        context = replace(context, entropy=_entropy(keys, options, plain))
        stego = chosen.hide(sources[0], sources[1:], options, context)
        published = with_extras(stego.gaussians, cover if models[0] is None else models[0], plain[0])
        read = _as_read(stego, published, keys, folder)
        shown = [
            show(model.to(target), each.model.to(target), each.scene, of_plain=not each.photos)
            for model, each in zip(read, sources, strict=True)
        ]
        sizes = [(len(model), len(each.model)) for model, each in zip(read, sources, strict=True)]
        again = ", and `resume=True` skips the training that is done" * trains
        _check_quality(shown, min_psnr, sizes, options, again)
        bounds = list(map(Bound.of, options.training(len(sources)), plain_steps))
        longer = _fit_bounds(bounds, sources, stego, options, context) if bound else {}
        metrics = _measured(stego, sources, options, shown, target, bounds, plain_steps, longer, began)
        if folder:
            payloads = secret_ids(options.fit.known_seed, stego.opened)
            made = {
                name: model
                for name, model, source in zip(plain_names(len(secrets)), plain, given, strict=True)
                if isinstance(source, Scene | Gaussians) or not is_model(source)  # the file itself is one
            }
            made |= {bound_names(len(secrets))[index]: model for index, model in longer.items()}
            settings = replace(settings, options=options, payloads=payloads)
            folder.write({**made, CONFIG: settings, METRICS: metrics})
    return HideResult(stego.gaussians, metrics)


def _hide_files(
    cover: PathLike | Gaussians,
    model: Gaussians,
    secrets: Sequence[Secret],
    place: Channel,
    out: PathLike | None,
    overwrite: bool,
) -> HideResult:
    """`hide` of files. Opens them again from what was written, as a reader does."""
    check_keys([each.key for each in secrets])
    folder = None
    if out is not None:
        read = [cover, *(each.file for each in secrets)]
        inputs = [Path(each) for each in read if isinstance(each, str | Path)]
        folder = RunFolder(out, "hide files", writes=STEGOS, inputs=inputs, overwrite=overwrite)
    hidden = [_hidden_file(each) for each in secrets]
    keys = [each.key for each in secrets]
    payloads = [(key, each.payload()) for key, each in zip(keys, hidden, strict=True)]
    try:
        stego = place.prepare(model).embed(payloads)
    except UsageError as error:
        if place.grows:
            raise
        raise UsageError(f'{error}; `publish="any", channel="appended"` has room for all') from error
    with folder.work() if folder else nullcontext():
        name = stego_name(stego)
        there = folder.write({name: with_extras(stego, cover, model)}) if folder else None
        as_read = read_model(there / name) if there else stego
        if [HiddenFile.of(open_content(as_read, key)) for key in keys] != hidden:
            raise RuntimeError("the hidden files do not open again from the published file")
    return HideResult(stego, psnr=psnr_between(model, stego))


def _hidden_file(secret: Secret) -> HiddenFile:
    """Raises InputError for a file that is missing or too large to be hidden, UsageError for no file."""
    if secret.file is None or secret.scene is not None or secret.model is not None:
        raise UsageError("expected secrets that are all files, or all scenes: hide the others by themselves")
    if isinstance(secret.file, bytes):
        return HiddenFile(secret.name, secret.file)
    path = Path(secret.file)
    return HiddenFile(secret.name or path.name, read_file(path, MAX_PAYLOAD_BYTES))


def _key_checks(keys: Sequence[str], settings: RunConfig[MethodOptions]) -> list[str]:
    """Verifiers of the keys for resumed runs; guessing a key from one is as slow as from the stego model."""
    salt = hashlib.sha256(b"keyss/v1/resume" + record_bytes(settings)).digest()[:SALT_BYTES]
    return [DerivedKey.of(key, salt).verifier().hex() for key in keys if key]


def _entropy(keys: Sequence[str], options: MethodOptions, plain: Sequence[Gaussians]) -> bytes:
    """32 bytes that follow from keys, options and models, and that cannot be guessed without the keys.

    The salt depends on all models, so that no table of keys can be made before the secrets are known.
    """
    with ThreadPoolExecutor(len(plain)) as workers:
        models = [digest.encode() for digest in workers.map(Gaussians.digest, plain)]
    repeated = b" ".join([f"keyss/v1/repeat {options.fit.known_seed}".encode(), *models])
    salt = hashlib.sha256(repeated).digest()[:SALT_BYTES]
    parts = [DerivedKey.of(key, salt).expand("writer", 32) for key in keys if key]
    parts += [record_bytes(options), *models]
    return hashlib.sha256(b"".join(hashlib.sha256(each).digest() for each in parts)).digest()


def _as_read(
    stego: Stego, published: Gaussians, keys: Sequence[str], folder: RunFolder | None
) -> list[Gaussians]:
    """The stego model and the secrets, from the files that are given away; `published` is one of them."""
    model, given = stego.gaussians, bool(stego.handed)
    packed = [pack(payload, key or None) for payload, key in zip(stego.handed, keys, strict=given)]
    if folder:
        handed = dict(zip(handed_names(len(packed)), packed, strict=True))
        name = stego_name(model)
        model = read_model(folder.write({name: published, **handed}) / name)
    opened: Sequence[Opened]
    if packed:
        opened = [open_handed(data, key or None) for data, key in zip(packed, keys, strict=True)]
    elif stego.verified and same_bits(model, stego.gaussians):
        opened = stego.opened  # the same bits were opened before
    else:
        opened = [open_model(model, key) for key in keys]
    return [model, *(each.reveal(model) for each in opened)]


def _check_quality(
    shown: Sequence[Shown],
    min_psnr: float | None,
    sizes: Sequence[tuple[int, int]],
    options: MethodOptions,
    again: str,
) -> None:
    """Raise QualityError if the cover or a secret is too far from its plain model; warn if it is far.

    `sizes`: Gaussians of each and of its plain model. `again`: of the message, what `resume` does.
    """
    for index, (render, (count, before)) in enumerate(zip(shown, sizes, strict=True)):
        each, plain, own = render.fidelity, render.plain, render.quality
        if each is None or plain is None:
            continue
        who = "the cover" if index == 0 else "the secret" if len(shown) == 2 else f"secret {index}"
        cut = count < before
        least = MIN_PRUNED_PSNR if cut and not options.trains else MIN_PSNR
        limit = least if min_psnr is None else min_psnr
        kept = f" with {count:,} of {before:,} Gaussians" if cut else ""
        found = f"{who}{kept} is at {each.psnr:.1f} dB PSNR to its plain model"
        way = '; `publish="any"` keeps all of them, and shows that there is a secret' * (
            cut and options.publish != "any"
        )
        if each.psnr < limit:
            raise QualityError(
                f"{found}, below {limit:g} dB: nothing was published; a lower `min_psnr` publishes it"
                f"{again}{way}"
            )
        if limit > 0 and (
            each.psnr < min(each.nothing + _BETTER_THAN_NOTHING, _GOOD) or each.nothing > _EMPTY
        ):
            raise QualityError(
                f"{found}, and empty renders are at {each.nothing:.1f} dB: nothing was published; "
                f"`min_psnr=0` publishes it anyway{again}{way}"
            )
        lost = own.psnr < plain.psnr - _NEARLY_PSNR and each.psnr < _FAR
        if min_psnr is None and (lost or own.ssim < plain.ssim - _NEARLY_SSIM):
            ssims = f"SSIM {own.ssim:.2f} where the plain model has {plain.ssim:.2f}"
            warnings.warn(f"{found}, {ssims}{way}", KeyssWarning, stacklevel=3)


def _fidelity(shown: Sequence[Shown]) -> tuple[RenderFidelity, ...]:
    """PSNR of cover and secrets to their plain models."""
    return tuple(each.fidelity for each in shown if each.fidelity is not None)


def _steps_of(model: PathLike | Gaussians | None) -> int | None:
    """Steps of the training of a plain model that is given, if `fit` wrote it."""
    if model is None or isinstance(model, Gaussians) or Path(model).name != MODEL:
        return None
    metrics = Path(model).parent / METRICS
    return read_record(metrics, FitMetrics).iterations if metrics.is_file() else None


def _fit_bounds(
    bounds: Sequence[Bound],
    sources: Sequence[Source],
    stego: Stego,
    options: MethodOptions,
    context: Context,
) -> dict[int, Gaussians]:
    """Plain 3DGS of scenes with more training steps than their plain models, by index."""
    sizes = [len(stego.gaussians), *(len(each.reveal(stego.gaussians)) for each in stego.opened)]
    configs = {
        # A secret that was pruned to fit is compared with a model of that size.
        index: bound.config(options.fit, size if size < len(source.model) else None)
        for index, (bound, source, size) in enumerate(zip(bounds, sources, sizes, strict=True))
        if not bound.equal and bound.steps is not None and source.photos
    }
    return fit_bounds([each.scene for each in sources], configs, context)


def _measured(
    stego: Stego,
    sources: Sequence[Source],
    options: MethodOptions,
    shown: Sequence[Shown],  # renders compared with those of the plain models
    device: torch.device,
    bounds: Sequence[Bound],
    plain_steps: Sequence[int | None],
    longer: Mapping[int, Gaussians],  # plain models with as many steps as the bounds
    began: float,  # time.monotonic() at the start of the run
) -> HideMetrics:
    """The measurements of a hiding."""
    scenes = [each.scene for each in sources]
    secrets = [each.reveal(stego.gaussians) for each in stego.opened]
    beside_bounds = list(shown)
    for index, model in longer.items():
        scene = scenes[index]
        plain = quality(model.to(device), scene.test, scene.background.to(device))
        beside_bounds[index] = replace(shown[index], plain=plain)
    measured = measure_hiding(
        stego.gaussians.to(device),
        stego.opened,
        scenes,
        [longer.get(index, each.model) for index, each in enumerate(sources)],
        steps=[each.steps if index in longer else plain_steps[index] for index, each in enumerate(bounds)],
        equal=[each.equal or index in longer for index, each in enumerate(bounds)],
        seed=options.fit.known_seed,
        shown=beside_bounds,
    )
    return HideMetrics(
        **vars(measured),
        method=options.method,
        gaussians=len(stego.gaussians),
        photos=tuple(each.photos for each in sources),
        secret_gaussians=tuple(map(len, secrets)),
        secret_degrees=tuple(
            (each.sh_degree, source.model.sh_degree)
            for each, source in zip(secrets, sources[1:], strict=True)
        ),
        iterations=stego.iterations,
        steps=tuple(each.steps for each in bounds),
        seconds=round(time.monotonic() - began, 1),
        width=scenes[0].train[0].camera.width,
        seed=options.fit.known_seed,
        against_plain=_fidelity(shown),
        details=stego.details,
    )
