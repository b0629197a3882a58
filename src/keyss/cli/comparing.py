"""The command that compares methods.

Heavy modules are imported inside the function: `keyss --help` needs none of them.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from tyro.conf import arg

from keyss.cli.arguments import Device, Iterations, MaxGaussians, OutFolder, Width, optional

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
            "keyss:published, KeySS as the paper has it.",
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
    device: Device = "auto",
    seed: Annotated[int, arg(metavar="N", help="Seed of everything random.")] = 0,
) -> None:
    """Hide a scene by each method with the same budget, and tabulate the results.

    The budget is steps for each scene in total, and Gaussians. The method 3dgs is the bound: plain 3DGS of as
    many Gaussians and as many training steps. The same command resumes after any interruption.

    example: keyss compare --cover SCENE_A --secret SCENE_B --quick -o runs/compared
    """
    import keyss
    from keyss.cli.tables import print_comparison, print_files, print_forecast
    from keyss.many import Forecast
    from keyss.progress import reporter

    asked = {"iterations": iterations, "max_gaussians": max_gaussians, "width": width}
    budget = {name: QUICK[name] if value is None and quick else value for name, value in asked.items()}
    found = keyss.compare(
        cover,
        secret,
        methods=() if methods.strip() == "all" else [name.strip() for name in methods.split(",")],
        seed=seed,
        device=device,
        out=out,
        dry_run=dry_run,
        reporter=reporter(),
        **budget,
    )
    if isinstance(found, Forecast):
        print_forecast(found, 1)
        return
    print_comparison(found)
    print_files(
        out,
        {
            "comparison.png": "a row for each method: cover, secret, error; it shows the secret",
            "comparison.md": "the table, in Markdown",
            "comparison.json": "the numbers, for programs",
        },
    )
