"""The commands for many hidings: sweeps, batches, and the keys that follow from a master key.

Heavy modules are imported inside the function: `keyss --help` needs none of them.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from keyss.cli.arguments import Jobs, OutFolder, Ray, optional

if TYPE_CHECKING:
    pass


def sweep(
    spec: Annotated[
        Positional[Path], arg(metavar="SPEC", help="YAML file: pairs, methods and their options, seeds.")
    ],
    *,
    out: OutFolder,
    jobs: Jobs = None,
    ray: Ray = None,
    retries: Annotated[int, arg(metavar="N", help="How often a cell is tried again whose process died.")] = 2,
    master_key_file: Annotated[
        Path | None,
        optional("FILE", "Key file to derive each cell's key from (`keyss keygen --asset`).", "a new one"),
    ] = None,
    dry_run: Annotated[
        bool, arg(help="Print the cells and estimates of their time and memory; write nothing.")
    ] = False,
) -> None:
    """Hide over a grid of scenes, methods, options and seeds, and tabulate the results.

    The same command resumes after any interruption: cells that are done are skipped. See docs/sweeps.md.

    example: keyss sweep sweep.yaml -o runs/sweep --jobs 2

    example: keyss sweep sweep.yaml -o runs/sweep --dry-run
    """
    import keyss
    from keyss.cli.tables import print_files, print_forecast, print_outcome
    from keyss.core.errors import UsageError
    from keyss.many import Forecast

    if retries < 0:
        raise UsageError(f"--retries: expected 0 or more, got {retries}")
    result = keyss.sweep(
        spec,
        out,
        master_key_file=master_key_file,
        jobs=jobs,
        ray=ray,
        retries=retries,
        dry_run=dry_run,
    )
    if isinstance(result, Forecast):
        print_forecast(result, jobs)
        return
    described = {
        "results.csv": "means over seeds, with 95 % confidence intervals",
        "results.parquet": "the same",
        "cells.csv": "the numbers of each cell",
        "private/master-key.txt": "the key from which those of the cells are derived",
    }
    print_files(out, described)
    print_outcome(result, "cells")
