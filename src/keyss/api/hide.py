"""`hide`: hide secrets in a cover, reveal them again, and measure the result."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from keyss.api.hide_arguments import (
    HideResult,
    Secret,
    SecretFile,
    check_arguments,
    check_not_given,
    method_for,
    read_sources,
    with_renders,
)
from keyss.api.hide_metrics import PlainModel, check_quality, hide_metrics
from keyss.channels import Publish, open_payload
from keyss.core.errors import UsageError
from keyss.core.gaussians import Gaussians
from keyss.core.scene import Scene, ViewOptions
from keyss.files.formats.ply import with_extras
from keyss.files.inputs import as_text, read_file
from keyss.files.models import read_model, reads_as
from keyss.keys import DerivedKey
from keyss.keys.derivation import SALT_BYTES
from keyss.keys.encryption import MAX_PAYLOAD_BYTES
from keyss.measure.hide_quality import compare
from keyss.measure.renders import sheet_of
from keyss.methods.hidden import HiddenFile, HiddenScene, pack_companion
from keyss.methods.method import Context, MethodOptions, Prepared, Source, Stego
from keyss.methods.plain_models import fit_bound, fit_plain_models
from keyss.methods.registry import DEFAULT, open_companion, open_model
from keyss.progress import Reporter, reporter as default_reporter
from keyss.rendering import Backend, resolve_device
from keyss.rendering.orbit import is_model, psnr_between
from keyss.runs.estimates import seconds_for
from keyss.runs.files import (
    CONFIG,
    LOOK,
    METRICS,
    STEGOS,
    PathLike,
    as_3dgs_model,
    bound_names,
    companion_names,
    path_of,
    plain_names,
    stego_name,
)
from keyss.runs.folder import HIDE_FILES, RunFolder
from keyss.runs.json_records import record_bytes
from keyss.runs.planning import check_room, cost_of
from keyss.runs.run_records import RunConfig, secret_ids, with_seed


def hide(
    cover: PathLike | Scene | Gaussians,
    secrets: Sequence[Secret] | Sequence[SecretFile],
    *,
    method: str | MethodOptions = DEFAULT,
    preset: str = "default",
    publish: Publish | None = None,
    views: ViewOptions = ViewOptions(),
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
    """Hide secrets in a cover, each under its own key, and check the result.

    Cover and secrets are scenes of photos, read as `views` says, or models of any format, which are rendered
    for measurements. Plain models of scenes are fitted unless they are given. `method`: a name, with the
    options of a `preset` ("quick", "default" or "full"), or options (`CarryOptions`, `KeyssOptions`).

    `publish="unchanged"` is for a file that must stay as it is: secrets go into low bits of a .ply, or of the
    integers of a quantised format (the options' `format`). `publish="converted"` is for one that may be
    converted: secrets go into the options' `channel`, and inspection finds them. The default is "unchanged"
    or, with a warning, "converted" if neither `publish` nor `format` is given and the cover has too little
    capacity. `publish` replaces that of the options.

    `out` (a folder) gets `publish/` with the stego model, and `private/` with fitted models, `config.json`,
    `metrics.json`, `look.png` (test views of cover and secrets before and after), companion files for methods
    that need them (`keyss.methods.hidden`), and checkpoints, from which `resume` continues. Without a seed
    in the options' `fit` the run uses a random one, which `config.json` records. With a seed, the same
    arguments and number of threads give the same bytes on a CPU.

    `bound`: fit upper bounds to compare with, plain 3DGS with equal Gaussians and training steps; otherwise
    `metrics.json` says which baselines had fewer steps. `dry_run`: check arguments, return only the plan.
    `reporter`: by default progress on the standard error stream; `keyss.progress.Reporter()` is silent.

    At the end, the published file is opened with the keys and compared with the plain models. Raises
    QualityError, publishes nothing and keeps checkpoints if a PSNR is below `min_psnr` (dB; by default 20,
    and 25 for secrets pruned without fine-tuning) or no better than that of empty renders. Raises other
    KeyssErrors too, and Interrupted on Ctrl-C.

    A list of `SecretFile` hides files in a model, with the default method; `cover_model`, `bound`,
    `min_psnr`, `resume` and `views` are for scenes only.
    """
    began, target, reporter = time.monotonic(), resolve_device(device), reporter or default_reporter()
    chosen, options = method_for(method, preset, secrets, target.type)
    options = replace(options, publish=publish) if publish else options
    check_arguments(out, min_psnr)
    place = None if out is None else Path(out)
    if files := [secret for secret in secrets if isinstance(secret, SecretFile)]:
        check_not_given(
            cover_model=cover_model, bound=bound, min_psnr=min_psnr, resume=resume, seed=options.fit.seed
        )
        return _hide_files(cover, files, options, place, overwrite, dry_run, reporter)
    given = [Secret(cover, "", cover_model), *(secret for secret in secrets if isinstance(secret, Secret))]
    keys = [secret.key for secret in given[1:]]
    options = replace(options, fit=with_seed(options.fit, place if resume else None, "options", "fit"))
    settings = RunConfig(
        method=chosen.name,
        cover=path_of(cover),
        secrets=tuple(path_of(secret.scene) for secret in given[1:]),
        models_given=tuple(one.model is not None or is_model(one.scene) for one in given),
        views=views,
        payloads=(),
        options=options,
    )
    inputs = [Path(path) for one in given for path in (one.scene, one.model) if isinstance(path, str | Path)]
    folder = None
    if place is not None and not dry_run:
        # Verifiers of the keys: guessing a key from one is as slow as from the stego model.
        salt = hashlib.sha256(b"keyss/v1/resume" + record_bytes(settings)).digest()[:SALT_BYTES]
        verifiers = [DerivedKey.of(key, salt).verifier().hex() for key in keys if key]
        models_given = [one.model and path_of(one.model) for one in given]
        folder = RunFolder(
            place,
            "hide",
            {**asdict(settings), "models": models_given, "bound": bound, "keys": verifiers},
            onto=("scenes",),
            writes=(*STEGOS, CONFIG),
            inputs=inputs,
            overwrite=overwrite,
            resume=resume,
        )
        began -= folder.earlier_seconds
    with reporter.waiting("reading the cover and the secrets", seconds_for("prepare", *inputs)):
        sources = read_sources(given, views)
        prepared = chosen.prepare(sources, options)
        trains = not dry_run and (prepared.trains or any(source.given is None for source in sources))
        sources = with_renders(given, sources, views, train=trains)
    cost = cost_of(prepared, sources, target, bound=bound)
    check_room(cost, place)
    if dry_run:
        return HideResult(plan=prepared.plan, cost=cost)
    with folder.work() if folder else nullcontext():
        if not resume and (prepared.grows or trains):
            size = f"hide: a file of up to {prepared.plan.megabytes:,.1f} MB, {cost}"
            for note in (
                *([size] if cost.is_long else []),
                *([prepared.plan.room] if prepared.plan.prunes else []),
                *prepared.plan.notes,
            ):
                reporter.note(note)
        context = Context(target, folder.checkpoints if folder and trains else None, resume, reporter)
        if any(source.given is None for source in sources):
            sources = fit_plain_models(sources, prepared.fits, context)
            prepared = chosen.prepare(sources, options, prepared)
        context = replace(context, entropy=_entropy(keys, prepared.options, sources))
        plain = list(map(PlainModel.of, sources, prepared.training))
        results: dict[str, Any] = {  # plain models that the user did not give as files
            name: source.model
            for name, source, one in zip(plain_names(len(keys)), sources, given, strict=True)
            if source.photos or isinstance(one.scene, Gaussians)
        }
        # Test renders replace given models, which frees memory for the revealed ones.
        handed, plain_cover = sources, sources[0].model
        sources = [source if source.photos else replace(source, given=None) for source in sources]
        stego = chosen.hide(handed, prepared, context)
        prepared = replace(prepared, capacity=None)
        published = with_extras(stego.gaussians, cover if cover_model is None else cover_model, plain_cover)
        del plain_cover
        with reporter.waiting("reading the published file, and comparing renders", cost.check_seconds):
            models = _write_and_read(stego, published, keys, folder)
            shown = [
                compare(model.to(target), source.given, source.scene, of_plain=not source.photos)
                for model, source in zip(models, sources, strict=True)
            ]
        check_quality(shown, min_psnr, models, plain, prepared, resumes=trains)
        longer = _fit_bounds(plain, sources, models, prepared, context) if bound else {}
        with reporter.waiting("measuring, and writing private files", cost.view_seconds):
            metrics = hide_metrics(stego, models, sources, shown, plain, longer, prepared, target)
            metrics = replace(metrics, seconds=round(time.monotonic() - began, 1))
            if folder:
                results |= {bound_names(len(keys))[index]: model for index, model in longer.items()}
                settings = replace(settings, payloads=secret_ids(metrics.seed, stego.opened))
                look = sheet_of([model.to(target) for model in models], sources)
                folder.write(results | {CONFIG: settings, METRICS: metrics, LOOK: look})
    return HideResult(stego.gaussians, metrics, survives=prepared.survives)


def _hide_files(
    cover: PathLike | Scene | Gaussians,
    secrets: Sequence[SecretFile],
    options: MethodOptions,
    out: Path | None,
    overwrite: bool,
    dry_run: bool,
    reporter: Reporter,
) -> HideResult:
    """Hide files in a model, and open them again to check; see `keyss.hide`."""
    if isinstance(cover, Scene) or not is_model(cover):
        raise UsageError("hiding a file needs a model as the cover; `keyss fit` makes one from photos")
    folder, inputs = None, [cover, *(secret.file for secret in secrets)]
    if out is not None and not dry_run:
        paths = [Path(path) for path in inputs if isinstance(path, str | Path)]
        folder = RunFolder(out, HIDE_FILES, writes=STEGOS, inputs=paths, overwrite=overwrite)
    with reporter.waiting("hiding", seconds_for("hide a file", cover)):
        files, model = [_read_secret(secret) for secret in secrets], as_3dgs_model(cover, "the cover")
        keyed = [(secret.key, file.payload()) for secret, file in zip(secrets, files, strict=True)]
        stego, survives = options.in_channel(
            model, lambda channel: (channel.prepare(model).embed(keyed), channel.survives)
        )
        with folder.work() if folder else nullcontext():
            published = stego
            if folder:
                name = stego_name(stego)
                path = folder.write({name: with_extras(stego, cover, model)}) / name
                published = stego if reads_as(path, stego) else read_model(path)
            if [HiddenFile.of(open_payload(published, secret.key)) for secret in secrets] != files:
                raise RuntimeError("the hidden files do not open again from the published file")
        psnr = psnr_between(model, stego)
    return HideResult(None if dry_run else stego, survives=survives, psnr=psnr)


def _read_secret(secret: SecretFile) -> HiddenFile:
    """Read the file. Raises InputError if it is missing or too large."""
    if isinstance(secret.file, bytes):
        return HiddenFile(secret.name, secret.file)
    path = Path(secret.file)
    return HiddenFile(secret.name or as_text(path.name), read_file(path, MAX_PAYLOAD_BYTES))


def _entropy(keys: Sequence[str], options: MethodOptions, sources: Sequence[Source]) -> bytes:
    """32 bytes derived from keys, options and models; infeasible to guess without the keys.

    The salt depends on all models, so that keys cannot be guessed in advance.
    """
    with ThreadPoolExecutor(len(sources)) as workers:
        digests = workers.map(Gaussians.digest, [source.model for source in sources])
        models = [digest.encode() for digest in digests]
    repeated = b" ".join([f"keyss/v1/repeat {options.fit.known_seed}".encode(), *models])
    salt = hashlib.sha256(repeated).digest()[:SALT_BYTES]
    parts = [DerivedKey.of(key, salt).expand("writer", 32) for key in keys if key]
    parts += [record_bytes(options), *models]
    return hashlib.sha256(b"".join(hashlib.sha256(part).digest() for part in parts)).digest()


def _write_and_read(
    stego: Stego, published: Gaussians, keys: Sequence[str], folder: RunFolder | None
) -> list[Gaussians]:
    """Write the files to give away, `published` among them, and read the stego model and the secrets back."""
    model, same = stego.gaussians, type(stego.gaussians) is Gaussians
    packed = [pack_companion(payload) for payload in stego.companions]
    if folder:
        companions = dict(zip(companion_names(len(packed)), packed, strict=True))
        name = stego_name(model)
        path = folder.write({name: published, **companions}) / name
        same = reads_as(path, model)
        model = model if same else read_model(path)
    opened: Sequence[HiddenScene]
    if packed:
        opened = [open_companion(data) for data in packed]
    elif stego.verified and same:
        opened = stego.opened  # opening the same bits again would change nothing
    else:
        opened = [open_model(model, key) for key in keys]
    return [model, *(secret.reveal(model) for secret in opened)]


def _fit_bounds(
    plain: Sequence[PlainModel],
    sources: Sequence[Source],
    models: Sequence[Gaussians],  # the stego model and the revealed ones
    prepared: Prepared,
    context: Context,
) -> dict[int, Gaussians]:
    """Upper bounds for scenes with more training steps than their plain models, by index."""
    fit, bounds = prepared.options.fit, {}
    for index, (before, source, model) in enumerate(zip(plain, sources, models, strict=True)):
        if before.is_bound or before.total_steps is None or not source.photos:
            continue
        # The upper bound of a pruned secret has the size of what is left.
        size = max(16, len(model)) if len(model) < before.gaussians else fit.max_gaussians
        config = replace(fit, iterations=before.total_steps, max_gaussians=size)
        bounds[index] = fit_bound(source.scene, config, index, context)
    return bounds
