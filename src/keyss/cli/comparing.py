"""The command that lays methods side by side.

Everything heavy is imported inside the command, so that `keyss --help` answers at once.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from tyro.conf import arg

from keyss.cli.arguments import Device, Iterations, MaxGaussians, OutFolder, Resume, Seed, Width, optional

QUICK = {"iterations": 500, "max_gaussians": 3000, "width": 100}


def compare(
    *,
    cover: Annotated[Path, arg(metavar="SCENE", help="Scene that everybody may see.")],
    secret: Annotated[Path, arg(metavar="SCENE", help="Scene to hide in it.")],
    methods: Annotated[
        str,
        optional(
            "NAMES",
            "Methods, or METHOD:PRESET, with commas between them. all: each one's first preset, and "
            "learned:paper, KeySS as published.",
            "all",
        ),
    ] = "all",
    out: OutFolder,
    quick: Annotated[
        bool, arg(help="500 steps, 3,000 Gaussians and a width of 100, where nothing else is said.")
    ] = False,
    iterations: Iterations = None,
    max_gaussians: MaxGaussians = None,
    width: Width = None,
    dry_run: Annotated[
        bool, arg(help="Print what would run and estimates of the time; write nothing.")
    ] = False,
    resume: Resume = False,
    device: Device = "auto",
    seed: Seed = None,
) -> None:
    """Hide one scene in another by every method there is, with the same budget: a table and a picture.

    The budget is steps for each scene, in all, and Gaussians. The method 3dgs is the bound: plain 3DGS of as
    many Gaussians and as many training steps.

    A key is made for those methods that have keys. What is done is not done again with --resume.

    example: keyss compare --cover SCENE_A --secret SCENE_B --quick -o runs/compared
    """
    from keyss import api
    from keyss.cli.tables import print_comparison, print_files, print_planned_runs
    from keyss.progress import reporter

    asked = {"iterations": iterations, "max_gaussians": max_gaussians, "width": width}
    budget = {name: QUICK[name] if value is None and quick else value for name, value in asked.items()}
    chosen = () if methods.strip() == "all" else [name.strip() for name in methods.split(",")]
    if dry_run:
        print_planned_runs(
            api.plan_comparison(cover, secret, methods=chosen, device=device, out=out, **budget)
        )
        print("What is measured beside these times takes up to a minute for each method.")
        return
    found = api.compare(
        cover,
        secret,
        methods=chosen,
        seed=seed,
        device=device,
        out=out,
        resume=resume,
        reporter=reporter(),
        **budget,
    )
    print_comparison(found)
    print_files(
        out,
        {
            "comparison.png": "a row for each method: cover, secret, error; it shows the secret",
            "comparison.md": "the table, in Markdown",
            "comparison.json": "the numbers, for programs",
        },
    )
