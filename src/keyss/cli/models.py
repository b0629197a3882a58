"""The commands for models and scenes as such: fitting, rendering, describing.

Everything heavy is imported inside the commands, so that `keyss --help` answers at once.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import Positional, UseAppendAction, arg

from keyss.cli.arguments import (
    Background,
    Device,
    Iterations,
    Live,
    MaxGaussians,
    OutFolder,
    Overwrite,
    Resume,
    Seed,
    SkipMissing,
    TensorBoard,
    ViewsPerStep,
    Width,
    optional,
    preset_sizes,
    schedule,
)


def fit(
    scene: Annotated[Positional[Path], arg(metavar="SCENE", help="Folder of posed photos.")],
    *,
    out: OutFolder,
    preset: str = "default",
    iterations: Iterations = None,
    max_gaussians: MaxGaussians = None,
    views_per_step: ViewsPerStep = None,
    width: Width = None,
    background: Background = None,
    skip_missing: SkipMissing = False,
    resume: Resume = False,
    overwrite: Overwrite = False,
    tensorboard: TensorBoard = False,
    live: Live = False,
    device: Device = "auto",
    seed: Seed = None,
) -> None:
    """Fit a plain model, ordinary 3DGS with nothing hidden, to the photos of a scene.

    example: keyss fit SCENE -o runs/cover

    example: keyss fit SCENE -o runs/cover --live
    """
    from dataclasses import replace

    from keyss import api
    from keyss.cli.live import watched
    from keyss.cli.ranks import answers
    from keyss.cli.tables import print_files, print_fit
    from keyss.cli.tensorboard import reporter
    from keyss.fitting.config import PRESETS
    from keyss.runs.files import METRICS
    from keyss.runs.metrics import FitMetrics
    from keyss.runs.records import read_record

    with watched(reporter(out, tensorboard=tensorboard), scene, live=live) as told:
        api.fit(
            scene,
            config=replace(PRESETS[preset], **schedule(iterations, max_gaussians, seed, views_per_step)),
            width=width,
            background=background,
            skip_missing=skip_missing,
            device=device,
            out=out,
            overwrite=overwrite,
            resume=resume,
            reporter=told,
        )
    if not answers():
        return
    print_fit(read_record(out / METRICS, FitMetrics))
    print_files(out, {"model.ply": "the model", "private": "its numbers, and what ran"})


def fit_with_presets() -> Callable[..., None]:
    """`fit` as it is to be parsed: with its presets, which take a second to load."""
    from keyss.fitting.config import PRESETS

    def command(*arguments: Any, **options: Any) -> None:
        fit(*arguments, **options)

    signature = inspect.signature(fit, eval_str=True)
    described = arg(help=f"Size and length of the run. {preset_sizes(PRESETS)}")
    preset: Any = Annotated[Literal[tuple(PRESETS)], described]
    parameters = signature.parameters | {"preset": signature.parameters["preset"].replace(annotation=preset)}
    command.__signature__ = signature.replace(parameters=list(parameters.values()))  # type: ignore[attr-defined]
    command.__name__, command.__doc__ = "fit", fit.__doc__
    command.__annotations__ = {name: each.annotation for name, each in parameters.items()}
    return command


def render(
    model: Annotated[
        Positional[Path], arg(metavar="FILE", help="A 3DGS model (.ply, .spz, .sog, ...), or - for stdin.")
    ],
    *,
    cameras: Annotated[
        Path | None,
        optional("SCENE", "Scene folder whose cameras are used.", "a film goes around the model"),
    ] = None,
    out: Annotated[
        Path | None, optional("FOLDER", "Folder for the images.", "only a film is made", aliases=["-o"])
    ] = None,
    video: Annotated[
        Path | None,
        optional("FILE", "Make a film, an .mp4, on a path that SCENE gives, if any.", "pictures are made"),
    ] = None,
    path: Annotated[
        Literal["around", "through"],
        arg(help="Of a film with cameras: around what they look at, or through them by their names."),
    ] = "around",
    wipe: Annotated[
        Path | None, optional("FILE", "In a film, a second model that a wipe uncovers.", "none")
    ] = None,
    seconds: Annotated[float, arg(metavar="S", help="Length of the film.")] = 8.0,
    split: Annotated[Literal["test", "train", "all"], arg(help="Which of its cameras.")] = "test",
    width: Width = None,
    background: Background = None,
    skip_missing: SkipMissing = False,
    overwrite: Overwrite = False,
    device: Device = "auto",
) -> None:
    """Render a model from the cameras of a scene, or film it.

    example: keyss render secret.ply --cameras SCENE_B -o images/

    example: keyss render stego.ply --wipe secret.ply --cameras SCENE_A --video film.mp4
    """
    from keyss import api
    from keyss.core.errors import UsageError

    if video is not None:
        if out is not None or split != "test":
            raise UsageError("--video writes a film and no pictures: leave out -o and --split")
        from keyss.progress import reporter

        frames = api.render_video(
            model,
            video,
            wipe=wipe,
            cameras=cameras,
            path=path,
            seconds=seconds,
            width=width,
            background=background,
            skip_missing=skip_missing,
            device=device,
            overwrite=overwrite,
            reporter=reporter(),
        )
        print(f"{video}: {frames} frames")
        return
    if cameras is None or out is None:
        raise UsageError("pictures need --cameras SCENE and -o FOLDER; a film needs --video FILE")
    if wipe is not None or seconds != 8.0 or path != "around":
        raise UsageError("--path, --wipe and --seconds are for films: give --video FILE")
    images = api.render(
        model,
        cameras,
        split=split,
        width=width,
        background=background,
        skip_missing=skip_missing,
        device=device,
        out=out,
        overwrite=overwrite,
    )
    print(f"{out}: {len(images)} image{'' if len(images) == 1 else 's'}")


def convert(
    model: Annotated[Positional[Path], arg(metavar="IN", help="A model of any format, or - for stdin.")],
    out: Annotated[Positional[Path], arg(metavar="OUT", help="The model to write: .ply, .spz, .sog, ...")],
    *,
    key_file: Annotated[
        UseAppendAction[tuple[Path, ...]],
        optional(
            "FILE", "File with a key whose secret must not be lost, once for each.", "none is looked for"
        ),
    ] = (),
    force: Annotated[bool, arg(help="Write it even if a secret is lost.")] = False,
    dry_run: Annotated[bool, arg(help="Say what it costs, and write nothing.")] = False,
    overwrite: Overwrite = False,
    device: Device = "auto",
) -> None:
    """Write a model in another format, and say what that costs.

    The end of OUT names the format: .ply, .compressed.ply, .spz, .sog, .glb or .splat; .ksplat and the
    meta.json of a SOG folder are read as well. All but .ply round, which loses what lies in low bits, and
    most change the order. The cost is the PSNR of pictures after, against those before, from around it.

    example: keyss convert cover.ply cover.spz

    example: keyss convert stego.ply stego.sog --key-file key.txt --dry-run
    """
    import sys

    from keyss import api
    from keyss.cli.keys import hinting_at_white_space, key_of_file
    from keyss.cli.tables import print_conversion
    from keyss.files.streams import is_standard

    chosen = [key_of_file(path) for path in key_file]
    with hinting_at_white_space(chosen):
        found = api.convert(
            model, out, chosen, force=force, dry_run=dry_run, overwrite=overwrite, device=device
        )
    print_conversion(str(out), found, dry_run=dry_run, file=sys.stderr if is_standard(out) else sys.stdout)


def info(
    path: Annotated[
        Positional[Path],
        arg(metavar="FILE", help="A model (- for stdin), a scene folder or a result folder."),
    ],
    *,
    json_: Annotated[bool, arg(name="json", help="Print JSON.")] = False,
) -> None:
    """Tell what is in a model or a scene folder.

    example: keyss info runs/hidden/publish/stego.ply
    """
    import json
    import sys

    from msgspec import to_builtins

    from keyss.cli.tables import print_facts
    from keyss.runs.describe import info as describe
    from keyss.runs.records import record_bytes

    facts = describe(path)
    if json_:
        text = record_bytes(facts).decode()
        try:
            text.encode(sys.stdout.encoding or "utf-8")
        except UnicodeEncodeError:
            text = json.dumps(json.loads(text), indent=2) + "\n"  # all of it in ASCII
        print(text, end="")
    else:
        print_facts(to_builtins(facts))
