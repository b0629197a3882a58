"""The command that makes the paper's tables again.

Everything heavy is imported inside the command, so that `keyss --help` answers at once.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import Positional, UseAppendAction, arg

from keyss.cli.arguments import Device, OutFolder, Seed, optional

if TYPE_CHECKING:
    from keyss.reproduction.record import Reproduction

Name = Literal["single", "multi", "masks", "combined", "pruning", "sinkhorn", "speed"]
_SCALE = "the scale's"


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
    scale: Annotated[
        Literal["small", "full"],
        arg(help="small: 1,000 steps, 9,000 Gaussians, 120 pixels of width. full: the paper's sizes."),
    ] = "small",
    data: Annotated[
        Path | None, optional("FOLDER", "Mip-NeRF 360, and playroom, for --scale full.", "scenes are given")
    ] = None,
    pairs: Annotated[
        UseAppendAction[tuple[str, ...]],
        optional(
            "COVER,SECRET",
            "Which scene hides which, by their names; of multi COVER,SECRET,SECRET. Once for each.",
            "each hides the next; at full scale as published",
        ),
    ] = (),
    most: Annotated[int | None, optional("N", "Only the first N of these pairs.", "all")] = None,
    out: OutFolder,
    download: Annotated[
        bool,
        arg(
            help="First fetch the scenes that --data lacks of those needed, from where their authors have "
            "them: up to 12.5 GB for most, at full scale."
        ),
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
    seed: Seed = None,
) -> None:
    """Lay a table of the KeySS paper beside what is measured here, and say which of its claims hold.

    The same command goes on after whatever ended it, and tables in one folder share their runs. A claim
    holds where all comparisons of means that it is made of do, and in part where half of them do.

    example: keyss reproduce single SCENE_A SCENE_B -o runs/paper

    example: keyss reproduce multi --scale full --data 360_v2 --download -o runs/paper-full
    """
    from keyss import api
    from keyss.cli.tables import print_files, print_planned_runs
    from keyss.core.errors import InputError, UsageError
    from keyss.progress import reporter

    asked = api.PaperTable(
        table,
        scenes,
        scale=scale,
        data=data,
        pairs=pairs,
        most=most,
        iterations=iterations,
        max_gaussians=max_gaussians,
        width=width,
        device=device,
    )
    if download and dry_run:
        raise UsageError("--dry-run writes nothing: leave out --download, or download first")
    if download:
        api.download_scenes(asked, reporter=reporter())
    if dry_run:
        print_planned_runs(api.plan_reproduction(asked, out=out))
        return
    found = api.reproduce(asked, seed=seed, out=out, reporter=reporter())
    _print_table(found)
    print_files(
        out,
        {
            f"{table}.md": "the table and what the claims come to, in Markdown",
            f"{table}.json": "the same, for programs",
            "runs": "what was run: further tables use it",
        },
    )
    if found.failures:
        raise InputError(f"{len(found.failures)} run(s) failed")


def _print_table(found: Reproduction) -> None:
    from keyss.cli.tables import Console, new_table
    from keyss.reproduction.record import cells

    heads, *rows = cells(found)
    width = 5  # columns side by side, as wide as terminals are
    for start in range(1, len(heads), width):
        part = new_table(heads[0], *heads[start : start + width], texts=1)
        for row in rows:
            part.add_row(row[0], *row[start : start + width])
        Console().print(part)
    for claim in found.claims:
        print(f"{claim.verdict} ({claim.holding} of {claim.parts}): {claim.text}")
    for name, why in found.failures.items():
        print(f"failed: {name}: {why}")
    print(
        "Published figures, and those measured here on photos that were not trained on: means over "
        f"{len(found.pairs)} pair(s)."
    )
