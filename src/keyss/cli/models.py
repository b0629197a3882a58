"""The commands for models and scenes as such: fitting, rendering, describing.

Everything heavy is imported inside the commands, so that `keyss --help` answers at once.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from keyss.cli.arguments import (
    Background,
    Device,
    Iterations,
    MaxGaussians,
    OutFolder,
    Overwrite,
    Resume,
    Seed,
    Width,
    schedule,
)


def fit(
    scene: Annotated[Positional[Path], arg(metavar="SCENE", help="Folder of posed photos.")],
    *,
    out: OutFolder,
    preset: Annotated[
        Literal["quick", "default", "paper"], arg(help="Size and length of the run.")
    ] = "default",
    iterations: Iterations = None,
    max_gaussians: MaxGaussians = None,
    width: Width = None,
    background: Background = None,
    resume: Resume = False,
    overwrite: Overwrite = False,
    device: Device = "auto",
    seed: Seed = None,
) -> None:
    """Fit a plain 3DGS model to the photos of a scene.

    example: keyss fit SCENE -o runs/cover
    """
    from dataclasses import replace

    from keyss import api
    from keyss.cli.tables import print_files, print_fit
    from keyss.fitting.config import PRESETS
    from keyss.progress import reporter
    from keyss.runs.files import METRICS
    from keyss.runs.metrics import FitMetrics
    from keyss.runs.records import read_record

    api.fit(
        scene,
        config=replace(PRESETS[preset], **schedule(iterations, max_gaussians, seed)),
        width=width,
        background=background,
        device=device,
        out=out,
        overwrite=overwrite,
        resume=resume,
        reporter=reporter(),
    )
    print_fit(read_record(out / METRICS, FitMetrics))
    print_files(out, {"model.ply": "the model", "private": "its numbers, and what ran"})


def render(
    model: Annotated[Positional[Path], arg(metavar="FILE", help="A 3DGS .ply.")],
    *,
    cameras: Annotated[Path, arg(metavar="SCENE", help="Scene folder whose cameras are used.")],
    out: Annotated[Path, arg(aliases=["-o"], metavar="FOLDER", help="Folder for the images.")],
    split: Annotated[Literal["test", "train", "all"], arg(help="Which of its cameras.")] = "test",
    width: Width = None,
    background: Background = None,
    overwrite: Overwrite = False,
    device: Device = "auto",
) -> None:
    """Render a model from the cameras of a scene.

    example: keyss render secret.ply --cameras SCENE_B -o images/
    """
    from keyss import api

    images = api.render(
        model,
        cameras,
        split=split,
        width=width,
        background=background,
        device=device,
        out=out,
        overwrite=overwrite,
    )
    print(f"{out}: {len(images)} image{'' if len(images) == 1 else 's'}")


def info(
    path: Annotated[
        Positional[Path], arg(metavar="FILE", help="A .ply, a scene folder, a sidecar or a result folder.")
    ],
    *,
    json_: Annotated[bool, arg(name="json", help="Print JSON.")] = False,
) -> None:
    """Tell what is in a model, a scene folder or a sidecar.

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
