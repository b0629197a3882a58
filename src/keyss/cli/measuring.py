"""The commands that judge: how well something is hidden, and what gives it away.

Everything heavy is imported inside the commands, so that `keyss --help` answers at once.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from keyss.cli.arguments import DeviceName, Overwrite, UnusedSeed

CpuOnly = Annotated[DeviceName, arg(help="Changes nothing here: the CPU computes.")]


def steganalyze(
    folder: Annotated[Positional[Path], arg(metavar="FOLDER", help="Folder of images, PNG for choice.")],
    *,
    csv: Annotated[Path, arg(metavar="FILE", help="Table to write: one row per image.")],
    threshold: Annotated[float, arg(metavar="T", help="Flag images whose fused score is above it.")] = 0.2,
    fast: Annotated[
        bool, arg(help="Stop with an image as soon as it looks clean; such scores compare with no others.")
    ] = False,
    overwrite: Overwrite = False,
    device: CpuOnly = "auto",
    seed: UnusedSeed = 0,
) -> None:
    """Look for LSB replacement in images as StegExpose does, score for score.

    example: keyss steganalyze images/ --csv scores.csv
    """
    import sys

    from keyss.cli.tables import print_steganalysis
    from keyss.files.atomic import write_bytes
    from keyss.files.output import check_output_file
    from keyss.measure.stegexpose import csv_bytes
    from keyss.measure.stegexpose import steganalyze as analyze
    from keyss.progress import reporter

    check_output_file(csv, overwrite)
    found = analyze(folder, threshold, fast, reporter=reporter())
    write_bytes(csv, csv_bytes(found.rows))
    print_steganalysis(found)
    print(f"{csv}: {len(found.rows)} image{'' if len(found.rows) == 1 else 's'}")
    if found.skipped:
        print(f"keyss: skipped what is no readable image: {_listed(found.skipped)}", file=sys.stderr)


def _listed(names: list[str], most: int = 5) -> str:
    """The first names, quoted since file names may hold anything, and how many more there are."""
    rest = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(map(repr, names[:most])) + rest
