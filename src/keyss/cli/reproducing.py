"""The command that reproduces the paper's tables.

Heavy modules are imported inside the function: `keyss --help` needs none of them.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import Positional, UseAppendAction, arg

from keyss.cli.arguments import Device, OutFolder, optional

if TYPE_CHECKING:
    from keyss.many import Reproduction

Name = Literal["single", "multi", "masks", "combined", "pruning", "sinkhorn", "speed"]
_SCALE = "see --data"


def reproduce(
    table: Annotated[Positional[Name], arg(help="Which table of the paper.")],
    scenes: Annotated[
        Positional[tuple[Path, ...]],
        arg(
            metavar="[SCENE ...]",
            help="Scenes that hide each other: each the next one.",
            help_behavior_hint="",
        ),
    ] = (),
    *,
    data: Annotated[
        Path | None,
        optional(
            "FOLDER",
            "Mip-NeRF 360, and playroom: the paper's scenes, at its sizes of 30,000 steps and 500,000 "
            "Gaussians.",
            "scenes are given; 1,000 steps, 9,000 Gaussians, 120 pixels",
        ),
    ] = None,
    pairs: Annotated[
        UseAppendAction[tuple[str, ...]],
        optional(
            "COVER,SECRET",
            "Which scene hides which, by their names; for multi COVER,SECRET,SECRET. Once for each.",
            "each hides the next; with --data as published",
        ),
    ] = (),
    most: Annotated[int | None, optional("N", "Only the first N of these pairs.", "all")] = None,
    out: OutFolder,
    download: Annotated[
        bool, arg(help="First download the scenes that --data lacks from their authors, up to 12.5 GB.")
    ] = False,
    dry_run: Annotated[
        bool, arg(help="Print what would run and estimates of the time; write nothing.")
    ] = False,
    iterations: Annotated[int | None, optional("N", "Steps of each training.", _SCALE)] = None,
    max_gaussians: Annotated[int | None, optional("N", "Cap on the size of a model.", _SCALE)] = None,
    width: Annotated[
        int | None, optional("PIXELS", "Photos wider than this are downscaled to it.", _SCALE)
    ] = None,
    device: Device = "auto",
    seed: Annotated[int, arg(metavar="N", help="Seed of everything random.")] = 0,
) -> None:
    """Reproduce a table of the KeySS paper, and check its claims.

    The same command resumes after any interruption, and tables in one folder share their runs. A claim holds
    if all of its comparisons of means hold, and in part if half of them do.

    example: keyss reproduce single SCENE_A SCENE_B -o runs/paper

    example: keyss reproduce multi --data 360_v2 --download -o runs/paper-full
    """
    import keyss
    from keyss.cli.tables import print_files, print_forecast
    from keyss.core.errors import InputError, UsageError
    from keyss.many import Forecast
    from keyss.progress import reporter

    if download and (dry_run or data is None):
        raise UsageError("--download: needs --data, and no --dry-run")
    found = keyss.reproduce(
        table,
        scenes,
        data=data,
        download=download,
        pairs=pairs,
        most=most,
        iterations=iterations,
        max_gaussians=max_gaussians,
        width=width,
        seed=seed,
        device=device,
        out=out,
        dry_run=dry_run,
        reporter=reporter(),
    )
    if isinstance(found, Forecast):
        print_forecast(found, 1)
        return
    _print_table(found)
    print_files(
        out,
        {
            f"{table}.md": "the table and the verdicts, in Markdown",
            f"{table}.json": "the same, for programs",
            "cells": "the runs, which other tables share",
        },
    )
    if found.failures:
        raise InputError(f"{len(found.failures)} run(s) failed")


def _print_table(found: Reproduction) -> None:
    from keyss.cli.tables import print_in_parts
    from keyss.many.paper.layout import cells

    print_in_parts(cells(found))
    for claim in found.claims:
        print(f"{claim.verdict} ({claim.holding} of {claim.parts}): {claim.text}")
    for name, why in found.failures.items():
        print(f"failed: {name}: {why}")
    print(
        "Published figures, and those measured here on photos that were not trained on; means over "
        f"{len(found.pairs)} pair(s)."
    )
