"""`hide`: hide secrets in a cover, reveal them again, and measure the result."""

from __future__ import annotations

import hashlib
import math
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import torch

from keyss.api.fit import with_seed
from keyss.api.hide_arguments import HideResult, Secret, method_for, sources_of
from keyss.api.hide_checks import check_quality
from keyss.channels import ConvertedChannel, Format, Publish
from keyss.core.errors import UsageError
from keyss.core.gaussians import Gaussians
from keyss.core.scene import Scene, ViewOptions
from keyss.files.formats.ply import with_extras
from keyss.files.models import is_model_path, read_model, reads_as
from keyss.fitting.image_metrics import quality
from keyss.keys import DerivedKey
from keyss.keys.derivation import SALT_BYTES
from keyss.measure.hide_quality import Shown, compare, measure_hiding
from keyss.measure.renders import sheet_of
from keyss.methods.companion import pack
from keyss.methods.hidden import HiddenScene
from keyss.methods.method import Context, Method, MethodOptions, Source, Stego, role_of
from keyss.methods.plain_models import Bound, fit_bounds, fit_plain_models
from keyss.methods.registry import DEFAULT, open_companion, open_model
from keyss.progress import Reporter
from keyss.rendering import Backend, resolve_device
from keyss.rendering.orbit import from_above, is_model
from keyss.runs.estimates import seconds_to_prepare
from keyss.runs.files import (
    CONFIG,
    LOOK,
    METRICS,
    MODEL,
    STEGOS,
    Background,
    PathLike,
    as_scene,
    bound_names,
    companion_names,
    path_of,
    plain_names,
    stego_name,
)
from keyss.runs.folder import RunFolder
from keyss.runs.json_records import read_record, record_bytes
from keyss.runs.planning import check_room, cost_of
from keyss.runs.run_records import FitMetrics, HideMetrics, RunConfig, secret_ids


def hide(
    cover: PathLike | Scene | Gaussians,
    secrets: Sequence[Secret],
    *,
    method: str | MethodOptions = DEFAULT,
    publish: Publish | None = None,
    format: Format | None = None,
    channel: ConvertedChannel | None = None,
    preset: str | None = None,
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
    Plain models of scenes are fitted unless they are given. `method`: a name, with the length of training of
    `preset` ("quick", "default" or "full") on the device, or the options of a method (`CarryOptions`,
    `KeyssOptions`). `publish`, `format` and `channel`, if given, replace those of the options. "unchanged" is
    for a file that must not change: secrets go unnoticed in low bits of a "ply", or in the integers of an
    "spz", "sog" or "compressed-ply", or of a model decoded from one. By default `format` is the cover's; if
    nothing can be hidden in it unnoticed, `publish` becomes "converted", with a warning. Such files may be
    converted: secrets are in the channel "appended" (more Gaussians, which are visible in the file) or
    "colours" (less capacity). `width`, `background`, `skip_missing`: see `load_scene`.

    `out` (a folder) gets `publish/` with the stego model, and `private/` with fitted models, `config.json`,
    `metrics.json`, `look.png` (test views of cover and secrets before and after), companion files for methods
    that need them (`keyss.methods.companion`), and checkpoints, from which `resume` continues. Without a seed
    in the options' `fit` the run uses a random one, which `config.json` records. With a seed, the same
    arguments and number of threads give the same bytes on a CPU.

    `bound`: fit upper bounds to compare with, plain 3DGS with equal Gaussians and training steps; otherwise
    `metrics.json` says which baselines had fewer steps. `dry_run`: check arguments, return only the plan.

    At the end, the published file is opened with the keys and compared with the plain models. Raises
    QualityError, publishes nothing and keeps checkpoints if a PSNR is below `min_psnr` (dB; by default 20,
    and 25 for secrets pruned without fine-tuning) or no better than that of empty renders. Raises other
    KeyssErrors too, and Interrupted on Ctrl-C.
    """
    target = resolve_device(device)
    chosen, options = method_for(method, secrets, preset, target.type)
    asked: dict[str, Any] = {"publish": publish, "format": format, "channel": channel}
    options = replace(options, **{name: value for name, value in asked.items() if value})
    _check_arguments(out, min_psnr)
    began, place = time.monotonic(), None if out is None else Path(out)
    options = replace(options, fit=with_seed(options.fit, place if resume else None, "options", "fit"))
    given, keys = [cover, *(secret.scene for secret in secrets)], [secret.key for secret in secrets]
    models = [cover_model, *(secret.model for secret in secrets)]
    views = ViewOptions.of(width, background, skip_missing)
    settings = _settings(chosen, given, models, views, options)
    folder = None
    if place is not None and not dry_run:
        folder = _folder(place, settings, given, models, keys, bound, overwrite, resume)
        began -= folder.earlier_seconds

    reporter = reporter or Reporter()
    with reporter.waiting("reading the cover and the secrets", seconds_to_prepare([*given, *models])):
        sources = sources_of(given, models, keys, views)
        options = chosen.prepare(sources, options)
        plain_steps = _plain_steps(sources, models, options)
        trains = not dry_run and (options.trains or any(each.given is None for each in sources))
        sources = [
            source
            if source.photos
            else replace(source, loaded=as_scene(each, views, train_pictures=trains, model=source.given))
            for each, source in zip(given, sources, strict=True)
        ]
    cost = cost_of(options, sources, target, bound=bound)
    check_room(cost, place)
    if dry_run:
        return HideResult(plan=chosen.plan(sources, options), cost=cost)

    with folder.work() if folder else nullcontext():
        if not resume and (options.channel_in().grows or trains):
            plan = chosen.plan(sources, options)
            for line in (f"hide: a file of up to {plan.megabytes:,.1f} MB, {cost}", *plan.notes):
                reporter.note(line)
        context = Context(target, folder.checkpoints if folder and trains else None, resume, reporter)
        sources, options = _fit_models(chosen, sources, options, context)
        plain = [each.model for each in sources]
        context = replace(context, entropy=_entropy(keys, options, plain))
        stego = chosen.hide(sources[0], sources[1:], options, context)

        published = with_extras(stego.gaussians, cover if cover_model is None else cover_model, plain[0])
        plain_sizes, made = [(len(each), each.sh_degree) for each in plain], _models_to_write(given, plain)
        # Images of given models take their place from here on, which frees memory for the revealed ones.
        sources = [each if each.photos else replace(each, given=None) for each in sources]
        del plain
        with reporter.waiting("reading the published file, and comparing renders", cost.check_seconds):
            read = _write_and_read(stego, published, keys, folder)
            shown = [
                compare(
                    model.to(target),
                    each.given and each.given.to(target),
                    each.scene,
                    of_plain=not each.photos,
                )
                for model, each in zip(read, sources, strict=True)
            ]
        sizes = [(len(model), count) for model, (count, _) in zip(read, plain_sizes, strict=True)]
        check_quality(shown, min_psnr, sizes, options, resumes=trains)

        bounds = list(map(Bound.of, options.training(len(sources)), plain_steps))
        longer = _fit_bounds(bounds, sources, stego, options, context) if bound else {}
        metrics = _measure(
            stego, sources, options, shown, target, bounds, plain_steps, plain_sizes, longer, began
        )
        if folder:
            settings = replace(
                settings, options=options, payloads=secret_ids(options.fit.known_seed, stego.opened)
            )
            names = bound_names(len(secrets))
            made |= {names[index]: model for index, model in longer.items()}
            roles = [role_of(index, len(sources)) for index in range(len(sources))]
            columns = [
                (role, each.scene if each.photos else from_above(each.scene), model.to(target))
                for role, each, model in zip(roles, sources, read, strict=True)
            ]
            folder.write({**made, CONFIG: settings, METRICS: metrics, LOOK: sheet_of(columns)})
    return HideResult(stego.gaussians, metrics, survives=options.channel_in().survives)


def _check_arguments(out: PathLike | None, min_psnr: float | None) -> None:
    if out is not None and is_model_path(out):
        raise UsageError(
            f"{out}: expected the name of a folder; the format of the model in it follows from `publish`"
        )
    if min_psnr is not None and not math.isfinite(min_psnr):
        raise UsageError(f"`min_psnr`: expected a number of dB, got {min_psnr}")


def _settings(
    method: Method,
    given: Sequence[PathLike | Scene | Gaussians],
    models: Sequence[PathLike | Gaussians | None],
    views: ViewOptions,
    options: MethodOptions,
) -> RunConfig[MethodOptions]:
    """The content of `config.json` known at the start."""
    return RunConfig(
        method=method.name,
        cover=path_of(given[0]),
        secrets=tuple(map(path_of, given[1:])),
        models_given=tuple(
            model is not None or (not isinstance(source, Scene) and is_model(source))
            for source, model in zip(given, models, strict=True)
        ),
        views=views,
        payloads=(),
        options=options,
    )


def _folder(
    place: Path,
    settings: RunConfig[MethodOptions],
    given: Sequence[PathLike | Scene | Gaussians],
    models: Sequence[PathLike | Gaussians | None],
    keys: Sequence[str],
    bound: bool,
    overwrite: bool,
    resume: bool,
) -> RunFolder:
    """The folder of the run; `resume` needs equal settings, models and keys."""
    arguments = asdict(settings) | {"models": [m and path_of(m) for m in models]}
    arguments |= {"bound": True} if bound else {}
    arguments["keys"] = _key_checks(keys, settings)
    return RunFolder(
        place,
        "hide",
        arguments,
        onto=("scenes",),
        writes=(*STEGOS, CONFIG),
        inputs=[Path(each) for each in (*given, *models) if isinstance(each, str | Path)],
        overwrite=overwrite,
        resume=resume,
    )


def _key_checks(keys: Sequence[str], settings: RunConfig[MethodOptions]) -> list[str]:
    """Verifiers of the keys, to resume; guessing a key from one is as slow as from the stego model."""
    salt = hashlib.sha256(b"keyss/v1/resume" + record_bytes(settings)).digest()[:SALT_BYTES]
    return [DerivedKey.of(key, salt).verifier().hex() for key in keys if key]


def _plain_steps(
    sources: Sequence[Source], models: Sequence[PathLike | Gaussians | None], options: MethodOptions
) -> list[int | None]:
    """Training steps of the plain models; None: a given model, unknown."""
    return [
        config.iterations if each.given is None else _steps_of(model)
        for each, model, config in zip(sources, models, options.fits(len(sources)), strict=True)
    ]


def _steps_of(model: PathLike | Gaussians | None) -> int | None:
    """Training steps of a given plain model, if `fit` wrote it."""
    if model is None or isinstance(model, Gaussians) or Path(model).name != MODEL:
        return None
    metrics = Path(model).parent / METRICS
    return read_record(metrics, FitMetrics).iterations if metrics.is_file() else None


def _fit_models(
    method: Method, sources: list[Source], options: MethodOptions, context: Context
) -> tuple[list[Source], MethodOptions]:
    """Fit missing plain models, and prepare the options for them."""
    if all(each.given is not None for each in sources):
        return sources, options
    fitted = fit_plain_models(sources, options.fits(len(sources)), context)
    return fitted, method.prepare(fitted, options)


def _entropy(keys: Sequence[str], options: MethodOptions, plain: Sequence[Gaussians]) -> bytes:
    """32 bytes derived from keys, options and models; infeasible to guess without the keys.

    The salt depends on all models, so that keys cannot be guessed in advance.
    """
    with ThreadPoolExecutor(len(plain)) as workers:
        models = [digest.encode() for digest in workers.map(Gaussians.digest, plain)]
    repeated = b" ".join([f"keyss/v1/repeat {options.fit.known_seed}".encode(), *models])
    salt = hashlib.sha256(repeated).digest()[:SALT_BYTES]
    parts = [DerivedKey.of(key, salt).expand("writer", 32) for key in keys if key]
    parts += [record_bytes(options), *models]
    return hashlib.sha256(b"".join(hashlib.sha256(each).digest() for each in parts)).digest()


def _models_to_write(
    given: Sequence[PathLike | Scene | Gaussians], plain: Sequence[Gaussians]
) -> dict[str, Gaussians]:
    """Plain models by file name, without those that the user gave as files."""
    return {
        name: model
        for name, model, source in zip(plain_names(len(given) - 1), plain, given, strict=True)
        if isinstance(source, Scene | Gaussians) or not is_model(source)
    }


def _write_and_read(
    stego: Stego, published: Gaussians, keys: Sequence[str], folder: RunFolder | None
) -> list[Gaussians]:
    """Write the files to give away, `published` among them, and read the stego model and the secrets back."""
    model, same = stego.gaussians, type(stego.gaussians) is Gaussians
    packed = [pack(payload) for payload in stego.companions]
    if folder:
        companion = dict(zip(companion_names(len(packed)), packed, strict=True))
        name = stego_name(model)
        path = folder.write({name: published, **companion}) / name
        same = reads_as(path, model)
        model = model if same else read_model(path)
    opened: Sequence[HiddenScene]
    if packed:
        opened = [open_companion(data) for data in packed]
    elif stego.verified and same:
        opened = stego.opened  # opening the same bits again would change nothing
    else:
        opened = [open_model(model, key) for key in keys]
    return [model, *(each.reveal(model) for each in opened)]


def _fit_bounds(
    bounds: Sequence[Bound],
    sources: Sequence[Source],
    stego: Stego,
    options: MethodOptions,
    context: Context,
) -> dict[int, Gaussians]:
    """Upper bounds for scenes with more training steps than their plain models, by index."""
    sizes = [len(stego.gaussians), *(len(each.reveal(stego.gaussians)) for each in stego.opened)]
    configs = {
        # The upper bound of a pruned secret has the size of what is left.
        index: bound.config(options.fit, size if size < len(source.model) else None)
        for index, (bound, source, size) in enumerate(zip(bounds, sources, sizes, strict=True))
        if not bound.equal and bound.steps is not None and source.photos
    }
    return fit_bounds([each.scene for each in sources], configs, context)


def _measure(
    stego: Stego,
    sources: Sequence[Source],
    options: MethodOptions,
    shown: Sequence[Shown],  # renders compared with those of the plain models
    device: torch.device,
    bounds: Sequence[Bound],
    plain_steps: Sequence[int | None],
    plain_sizes: Sequence[tuple[int, int]],  # Gaussians and SH degrees of the plain models
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
        beside_bounds,
        gaussians=[
            len(longer[index]) if index in longer else count for index, (count, _) in enumerate(plain_sizes)
        ],
        steps=[each.steps if index in longer else plain_steps[index] for index, each in enumerate(bounds)],
        equal=[each.equal or index in longer for index, each in enumerate(bounds)],
        seed=options.fit.known_seed,
    )
    return HideMetrics(
        **vars(measured),
        method=options.method,
        gaussians=len(stego.gaussians),
        photos=tuple(each.photos for each in sources),
        secret_gaussians=tuple(map(len, secrets)),
        secret_degrees=tuple(
            (each.sh_degree, degree) for each, (_, degree) in zip(secrets, plain_sizes[1:], strict=True)
        ),
        iterations=stego.iterations,
        steps=tuple(each.steps for each in bounds),
        seconds=round(time.monotonic() - began, 1),
        width=scenes[0].train[0].camera.width,
        seed=options.fit.known_seed,
        against_plain=tuple(each.fidelity for each in shown if each.fidelity is not None),
        details=stego.details,
    )
