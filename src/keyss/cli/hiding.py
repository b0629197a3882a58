"""The command that hides, which has the options of the method that is chosen.

Everything heavy is imported inside the commands, so that `keyss --help` answers at once.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import UseAppendAction, arg

from keyss.cli.arguments import (
    Background,
    Device,
    Iterations,
    Jobs,
    KeyFiles,
    Live,
    MasterKeyFile,
    MaxGaussians,
    OutFolder,
    Overwrite,
    Ray,
    Resume,
    Seed,
    SkipMissing,
    TensorBoard,
    ViewsPerStep,
    Width,
    optional,
    schedule,
)
from keyss.cli.hiding_options import DEFAULT_METHOD, own_options
from keyss.cli.sweeping import hide_assets

if TYPE_CHECKING:
    from keyss.channels.rooms import AnyChannel, Publish

_MIN_PSNR = 20.0  # as `keyss.api.hide` has it; its module would take a second to load
_HOW = ("byte for byte as it is", "as it is, or converted")  # to publish


def hide(
    *,
    cover: Annotated[
        Path | None,
        optional("SCENE", "Scene that everybody may see, or a model (.ply, .spz, ...).", "those of --batch"),
    ] = None,
    secret: Annotated[
        UseAppendAction[tuple[Path, ...]],
        optional("SCENE", "Scene or model to hide in it, once for each secret.", "files are hidden"),
    ] = (),
    secret_file: Annotated[
        UseAppendAction[tuple[Path, ...]],
        optional("FILE", "Any file to hide, in a cover that is a model; once for each.", "scenes are hidden"),
    ] = (),
    publish: Annotated[
        Literal["ply", "spz", "sog", "compressed-ply", "any"],
        arg(
            help="Where the model will be published. spz, sog, compressed-ply: such a file, passed on as it "
            "is, has room for small secrets only. any: a .ply that may be converted."
        ),
    ] = "ply",
    channel: Annotated[
        Literal["appended", "colours"] | None,
        optional(
            "{appended,colours}",
            "With --publish any, what survives: appended Gaussians hold everything, and everybody can see "
            "that they are there; colours hold little and show less.",
            "scenes are appended, and files lie in colours",
        ),
    ] = None,
    repair: Annotated[
        bool, arg(help="With --channel colours: a short fit afterwards, so that views look more as before.")
    ] = False,
    method: str = DEFAULT_METHOD,
    key_file: KeyFiles = (),
    batch: Annotated[
        Path | None,
        optional(
            "CSV",
            "Table of assets, each hidden by itself: columns cover, secret or secret_file, out (a folder in "
            "that of -o) and key_file.",
            "one hiding",
        ),
    ] = None,
    master_key_file: MasterKeyFile = None,
    jobs: Jobs = None,
    ray: Ray = None,
    out: OutFolder,
    preset: str = "best",
    iterations: Iterations = None,
    max_gaussians: MaxGaussians = None,
    views_per_step: ViewsPerStep = None,
    width: Width = None,
    background: Background = None,
    skip_missing: SkipMissing = False,
    cover_model: Annotated[
        Path | None, optional("FILE", "Plain model of the cover: 3DGS with nothing hidden.", "one is fitted")
    ] = None,
    secret_model: Annotated[
        UseAppendAction[tuple[Path, ...]],
        optional("FILE", "Plain model of a secret, once for each secret.", "they are fitted"),
    ] = (),
    bound: Annotated[
        bool,
        arg(
            help="Fit plain 3DGS of as many Gaussians and as many training steps to compare each scene with, "
            "where its plain model had fewer; takes as long again."
        ),
    ] = False,
    min_psnr: Annotated[
        float, arg(metavar="DB", help="Fail if cover or secret comes out worse, against its plain model.")
    ] = _MIN_PSNR,
    dry_run: Annotated[
        bool, arg(help="Print plan, room, and estimates of time, memory and disk; write nothing.")
    ] = False,
    resume: Resume = False,
    overwrite: Overwrite = False,
    tensorboard: TensorBoard = False,
    live: Live = False,
    device: Device = "auto",
    seed: Seed = None,
    **own: Any,
) -> None:
    """Hide secret scenes in a cover scene, each under its own key.

    Every method has options of its own: see `keyss hide --method METHOD --help`.

    example: keyss hide --cover SCENE_A --secret SCENE_B --key-file key.txt -o runs/hidden

    example: keyss hide --cover cover.ply --secret secret.ply --key-file key.txt -o runs/hidden

    example: keyss hide --cover cover.ply --secret-file letter.pdf --key-file key.txt -o runs/letter

    example: keyss hide --batch assets.csv --method carry --master-key-file master.txt -o runs/assets
    """
    from keyss import api
    from keyss.cli.keys import keys, warn_of_doubtful_keys
    from keyss.cli.live import watched
    from keyss.cli.ranks import answers, check_command
    from keyss.cli.tables import print_files, print_hiding, print_plan
    from keyss.cli.tensorboard import reporter
    from keyss.core.errors import UsageError
    from keyss.methods import registry
    from keyss.rendering.orbit import is_model
    from keyss.runs.files import HANDED, STEGOS

    if cover is None and batch is None:
        raise UsageError("nothing to hide in: give --cover SCENE, or --batch CSV for many")
    for flag, value in (("--master-key-file", master_key_file), ("--jobs", jobs), ("--ray", ray)):
        if batch is None and value is not None:
            raise UsageError(f"{flag} is for many hidings: give --batch CSV, or leave it out")
    check_command("hide --batch" if batch else "hide --secret-file", trains=not (batch or secret_file))
    if secret_file and cover is not None and batch is None:
        unused: dict[str, object] = {
            "--secret": secret,
            "--secret-model": secret_model,
            "--cover-model": cover_model,
        }
        unused |= {"--dry-run": dry_run, "--resume": resume, "--iterations": iterations}
        unused |= {"--tensorboard": tensorboard, "--live": live, "--bound": bound, "--width": width}
        unused |= {"--max-gaussians": max_gaussians, "--views-per-step": views_per_step}
        unused |= {"--seed": seed is not None, "--min-psnr": min_psnr != _MIN_PSNR}
        unused |= {f"--{name.replace('_', '-')}": value for name, value in own.items()}
        if given_too := [flag for flag, value in unused.items() if value]:
            raise UsageError(f"--secret-file: files are hidden by themselves; leave out {given_too[0]}")
        _hide_files(cover, secret_file, publish, channel or "colours", repair, key_file, out, overwrite)
        return
    if not secret and batch is None:
        raise UsageError("nothing to hide: give --secret SCENE or --secret-file FILE, once for each secret")
    if secret_model and len(secret_model) != len(secret):
        raise UsageError(
            f"expected no --secret-model or one for each of {len(secret)} secret(s), got {len(secret_model)}"
        )
    chosen = registry.get(method)
    known = own_options(chosen)
    changes = {
        name: parse(value) if (parse := known[name][1].parse) else value
        for name, value in own.items()
        if value is not None and value is not False
    }
    changes["publish"] = publish
    if channel:
        changes["channel"] = channel
    if repair:
        changes["repair"] = True
    options = chosen.presets[preset].adapted(**changes)
    options = options.with_fit(**schedule(iterations, max_gaussians, seed, views_per_step))
    if batch is not None:
        one: dict[str, object] = {"--cover": cover, "--secret": secret, "--secret-file": secret_file}
        one |= {"--key-file": key_file, "--cover-model": cover_model, "--secret-model": secret_model}
        one |= {"--dry-run": dry_run, "--tensorboard": tensorboard, "--live": live, "--resume": resume}
        one |= {"--bound": bound}
        if given_too := [flag for flag, value in one.items() if value]:
            raise UsageError(
                f"--batch: {given_too[0]} is for a single hiding; a batch that was interrupted goes on "
                "with the same command"
            )
        hide_assets(
            batch,
            out,
            method=options,
            master_key_file=master_key_file,
            width=width,
            background=background,
            skip_missing=skip_missing,
            min_psnr=min_psnr,
            device=device,
            jobs=jobs,
            ray=ray,
            overwrite=overwrite,
        )
        return
    assert cover is not None
    given = [cover_model or cover, *(secret_model or secret)]
    if not chosen.trains and all(map(is_model, given)):
        training = {
            "--preset": preset != next(iter(chosen.presets)),
            "--iterations": iterations is not None,
            "--max-gaussians": max_gaussians is not None,
            "--views-per-step": views_per_step is not None,
            "--live": live,
        }
        if idle := [flag for flag, is_given in training.items() if is_given]:
            raise UsageError(
                f"{' and '.join(idle)}: nothing is trained when --method {method} gets models of all scenes; "
                f"leave {'it' if len(idle) == 1 else 'them'} out"
            )
    models = secret_model or (None,) * len(secret)
    if chosen.capabilities.keys or key_file:
        opening = keys(key_file, len(secret), confirm=True)
        warn_of_doubtful_keys(opening)
    else:
        opening = [""] * len(secret)
    secrets = [
        api.Secret(scene, key, model) for scene, key, model in zip(secret, opening, models, strict=True)
    ]
    if dry_run:
        planned = api.plan(
            cover,
            secrets,
            method=options,
            width=width,
            background=background,
            skip_missing=skip_missing,
            cover_model=cover_model,
            bound=bound,
            device=device,
            out=out,
        )
        print_plan(planned)
        return
    with watched(reporter(out, tensorboard=tensorboard), cover, live=live) as told:
        result = api.hide(
            cover,
            secrets,
            method=options,
            width=width,
            background=background,
            skip_missing=skip_missing,
            cover_model=cover_model,
            bound=bound,
            min_psnr=min_psnr,
            device=device,
            out=out,
            overwrite=overwrite,
            resume=resume,
            reporter=told,
        )
    if not answers():
        return
    print_hiding(result.metrics)
    how = _HOW[publish == "any"]
    what = "the cover, with the secret in it" if chosen.trains or chosen.capabilities.keys else "the cover"
    print_files(
        out,
        {
            **dict.fromkeys(STEGOS, f"publish this, {how}: {what}"),
            HANDED: "hand this over to who may see the secret: `keyss reveal --handed`",
            "private": "keep this to yourself, or delete it: plain models of all scenes, numbers, what ran",
        },
    )
    if not chosen.capabilities.keys:
        print(f"The method {method} has no keys: whoever has both files sees the secret.")
        return
    files = "both files" if chosen.capabilities.hands_over else "file"
    print(
        "The key: send it over another channel than the file, and keep a copy: without it nothing is opened. "
        f"Whoever has {files} and key runs `keyss reveal`."
    )


def _hide_files(
    cover: Path,
    files: Sequence[Path],
    publish: Publish,
    channel: AnyChannel,
    repair: bool,
    key_file: Sequence[Path],
    out: Path,
    overwrite: bool,
) -> None:
    """`keyss hide --secret-file`."""
    from keyss import api
    from keyss.cli.keys import keys, warn_of_doubtful_keys
    from keyss.cli.tables import print_files
    from keyss.core.errors import UsageError
    from keyss.rendering.orbit import is_model
    from keyss.runs.files import STEGOS

    if not is_model(cover):
        raise UsageError(
            f"--secret-file needs a model as the cover, and {cover} is none; `keyss fit` makes one of photos"
        )
    opening = keys(key_file, len(files), confirm=True)
    warn_of_doubtful_keys(opening)
    secrets = [api.SecretFile(file, key) for file, key in zip(files, opening, strict=True)]
    result = api.hide_files(
        cover, secrets, publish=publish, channel=channel, repair=repair, out=out, overwrite=overwrite
    )
    for file, size in zip(files, result.sizes, strict=True):
        print(f"{file.name}: {size:,} bytes, opened again from what was written")
    print(f"The cover's views changed by {result.psnr:.0f} dB PSNR")
    print_files(out, dict.fromkeys(STEGOS, f"publish this, {_HOW[publish == 'any']}"))
