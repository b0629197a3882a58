"""The commands for many hidings: sweeps, batches, and the keys of what was hidden under a master key.

Everything heavy is imported inside the commands, so that `keyss --help` answers at once.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import Positional, arg

from keyss.cli.arguments import Jobs, OutFolder, Ray, optional

if TYPE_CHECKING:
    from keyss.sweeps.sweep import Estimate


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
        optional(
            "FILE", "File with a key from which each cell gets its own (`keyss key-of`).", "one that is made"
        ),
    ] = None,
    dry_run: Annotated[
        bool, arg(help="Print the cells and estimates of their time and memory; write nothing.")
    ] = False,
) -> None:
    """Hide pairs of scenes by methods, options and seeds, each with each, and tabulate what comes out.

    The same command goes on after whatever ended it: cells that are done stay. See docs/sweeps.md.

    example: keyss sweep sweep.yaml -o runs/sweep --jobs 2

    example: keyss sweep sweep.yaml -o runs/sweep --dry-run
    """
    from keyss import api
    from keyss.cli.tables import print_files
    from keyss.core.errors import UsageError

    if retries < 0:
        raise UsageError(f"--retries: expected 0 or more, got {retries}")
    if dry_run:
        from keyss.sweeps.sweep import estimates

        _print_estimates(list(estimates(spec, out, master_key_file=master_key_file)), jobs)
        return
    result = api.sweep(spec, out, master_key_file=master_key_file, jobs=jobs, ray=ray, retries=retries)
    described = {
        "results.csv": "means over seeds, with 95 % confidence intervals",
        "results.parquet": "the same",
        "cells.csv": "the numbers of each cell",
        "private/master-key.txt": "what the keys of the cells follow from",
    }
    print_files(out, described)
    failures = [(each.name, each.failure.message if each.failure else None) for each in result.failed]
    _end(failures, len(result.ended), "cells")


def key_of(
    name: Annotated[Positional[str], arg(metavar="NAME", help="What stands in the column out of the batch.")],
    *,
    master_key_file: Annotated[Path, arg(metavar="FILE", help="File with the master key.")],
    out: Annotated[
        Path | None,
        optional(
            "FILE", "New file for the key, which nobody else can read.", "the standard output", aliases=["-o"]
        ),
    ] = None,
) -> None:
    """Tell the key of one asset that was hidden under a master key.

    example: keyss key-of statue-7 --master-key-file master.txt -o statue-7.key
    """
    from keyss.cli.keys import key_of_file, write_new_key
    from keyss.keys.master import MasterKey

    key = MasterKey(key_of_file(master_key_file)).key_of(name)
    if out is None:
        print(key)
        return
    write_new_key(out, key)
    print(f"{out}: the key of {name}")


def hide_assets(manifest: Path, out: Path, *, master_key_file: Path | None, **options: Any) -> None:
    """`keyss hide --batch`."""
    from keyss import api
    from keyss.cli.keys import key_of_file, warn_of_doubtful_keys
    from keyss.cli.tables import print_files

    if master_key_file is not None:
        warn_of_doubtful_keys([key_of_file(master_key_file)])
    result = api.hide_batch(manifest, out, master_key_file=master_key_file, **options)
    if skipped := sum(each.skipped for each in result.assets):
        print(f"{skipped} of {len(result.assets)} assets were done before")
    print_files(out, {"private/batch.csv": "what became of each asset"})
    _end([(each.out, each.error) for each in result.failed], len(result.assets), "assets")


def _end(failed: list[tuple[str, str | None]], count: int, what: str) -> None:
    """Say how many there are. Raises InputError where some failed."""
    from keyss.core.errors import InputError

    print(f"{count - len(failed)} of {count} {what} are done")
    for name, why in failed:
        print(f"failed: {name}: {why or 'its process died; see its log.txt'}")
    if failed:
        raise InputError(f"{len(failed)} of {count} {what} failed")


def _print_estimates(found: list[Estimate], jobs: int | None) -> None:
    from rich.table import Table
    from rich.text import Text

    from keyss.cli.tables import Console
    from keyss.progress import about
    from keyss.sweeps.engine import Resources

    table = Table(box=None, pad_edge=False)
    for head in ("cell", "what", "time, about", "memory"):
        table.add_column(head, overflow="fold")
    for each in found:
        cell, what = each.cell.id[:12], Text(each.cell.planned.job.name)
        if each.refused is not None:
            table.add_row(cell, what, "cannot work", Text(each.refused))
        elif each.done:
            table.add_row(cell, what, "done", "")
        else:
            table.add_row(cell, what, about(each.seconds), f"{each.memory / 1e9:.1f} GB")
    Console().print(table)
    due = [each for each in found if not each.done and each.refused is None]
    resources = Resources.divided(jobs, max((each.memory for each in due), default=1))
    cells = f"{len(found)} cell{'s' * (len(found) != 1)}"
    print(
        f"{cells}, {len(due)} to do: about {about(sum(each.seconds for each in due))} on this machine, were "
        f"all its cores at work; {resources.jobs} at once with {resources.threads} thread(s) each"
    )
    print("Nothing was written. Times are extrapolated from a few steps, and rough.")
