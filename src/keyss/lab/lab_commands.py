"""The commands of the laboratory: `audit`, `compare`, `reproduce`, `sweep`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import Positional, UseAppendAction, arg

from keyss.cli.arguments import (
    Device,
    KeyFiles,
    OutFolder,
    Overwrite,
    Run,
    Width,
    check_exists,
    check_seed,
    optional,
    switch,
    verb,
)

if TYPE_CHECKING:
    from keyss.lab.many import Forecast

TableName = Literal["single", "multi", "masks", "combined", "pruning", "sinkhorn", "speed"]
QUICK = {"iterations": 500, "max_gaussians": 3000, "width": 100}
Seeds = Annotated[
    UseAppendAction[tuple[int, ...]],
    optional("N", "Seed of all random numbers; repeat for means and standard deviations.", "0"),
]
DryRun = Annotated[bool, switch("Print the runs with estimates of time and memory; write nothing.")]


def audit(
    run: Run,
    *,
    key_file: KeyFiles = (),
    controls: Annotated[
        int, arg(metavar="N", help="Plain models of the cover from other seeds, as controls; at least 2.")
    ] = 3,
    only: Annotated[
        UseAppendAction[tuple[str, ...]],
        optional(
            "PART",
            "Part to audit: images, parameters, stealth, stegexpose, leaks, robustness or speed; repeat for "
            "more.",
            "all",
        ),
    ] = (),
    overwrite: Overwrite = False,
    device: Device = "auto",
    seed: Annotated[int, arg(metavar="N", help="Seed of all random numbers.")] = 0,
) -> None:
    """Audit a run: quality, stealth, attacks, robustness and speed; takes minutes.

    Run the same command again to resume.

    example: keyss audit runs/hidden --key-file key.txt

    example: keyss audit runs/hidden --key-file key.txt --only stealth --only leaks
    """
    check_exists(run, keys=key_file)
    measure = verb("audit")
    from keyss import progress
    from keyss.cli.keys import keys_of_run
    from keyss.cli.tables import Console, print_columns, print_files, print_table
    from keyss.lab.audits import headline

    result = measure(
        run,
        keys_of_run(run, key_file),
        controls=controls,
        only=only,
        seed=check_seed(seed),
        device=device,
        overwrite=overwrite,
        reporter=progress.reporter(),
    )
    if progress.level >= 0:
        for table in result.unjudged:
            print_table(table.heads, table.rows)
        print_columns(
            [
                (each.word, f"{each.measure}: {each.value}; {each.beside}; limit: {each.limit}")
                for each in result.verdicts
            ]
        )
        Console().print(headline(result.verdicts), highlight=False)
    print_files(
        run,
        {
            "private/report.md": "the report: look here first; it shows the secret",
            "private/audit/audit.json": "the measurements",
        },
    )


def compare(
    *,
    cover: Annotated[Path, arg(metavar="SCENE", help="Public scene: folder of posed photos.")],
    secret: Annotated[Path, arg(metavar="SCENE", help="Scene to hide in it.")],
    methods: Annotated[
        str, optional("NAMES", "Methods, METHOD:PRESET or METHOD:VARIANT, separated by commas.", "all")
    ] = "all",
    out: OutFolder,
    quick: Annotated[bool, switch("500 steps, 3k Gaussians and a width of 100 by default.")] = False,
    iterations: Annotated[
        int | None, optional("N", "Training steps for each scene.", "the first method's, or see --quick")
    ] = None,
    max_gaussians: Annotated[
        int | None,
        optional("N", "Maximum number of Gaussians of a model.", "the first method's, or see --quick"),
    ] = None,
    width: Width = None,
    dry_run: DryRun = False,
    device: Device = "auto",
    seed: Seeds = (),
) -> None:
    """Hide a scene by each method with the same budget, and tabulate the results.

    The budget is a number of Gaussians, and of training steps for each scene. The method 3dgs is the upper
    bound: plain 3DGS with that budget. Methods that cannot run with it are listed, and are an error if
    `--methods` names them. Run the same command again to resume.

    example: keyss compare --cover SCENE_A --secret SCENE_B --quick -o runs/compared
    """
    check_exists(cover, secret)
    run = verb("compare")
    from keyss import progress
    from keyss.cli.tables import print_files, print_table
    from keyss.core.errors import InputError
    from keyss.lab.many import Forecast
    from keyss.lab.many.comparison import comparison_notes, comparison_tables

    given = {"iterations": iterations, "max_gaussians": max_gaussians, "width": width}
    budget = {name: QUICK[name] if value is None and quick else value for name, value in given.items()}
    named = [] if methods.strip() == "all" else [name.strip() for name in methods.split(",")]
    comparison = run(
        cover,
        secret,
        methods=named,
        seeds=tuple(map(check_seed, seed)) or (0,),
        device=device,
        out=out,
        dry_run=dry_run,
        reporter=progress.reporter(),
        **budget,
    )
    if isinstance(comparison, Forecast):
        _print_forecast(comparison)
        print("Controls are plain models of the cover with other seeds, with which secrecy is measured.")
        return
    for heads, *rows in comparison_tables(comparison) if progress.level >= 0 else ():
        print_table(heads, rows)
    described = {
        "comparison.png": "a row for each method: cover, secret, error; it shows the secret",
        **_scene_tables("comparison"),
        "comparison.json": "all numbers, for programs",
    }
    progress.say(*comparison_notes(comparison))
    print_files(out, described)
    if named and (failed := [row.name for row in comparison.methods if row.error]):
        raise InputError(f"not possible: {', '.join(failed)}")


def reproduce(
    table: Annotated[Positional[TableName], arg(help="Table of the paper.")],
    scenes: Annotated[
        Positional[tuple[Path, ...]],
        arg(metavar="[SCENE ...]", help="Scenes; each hides the next one.", help_behavior_hint=""),
    ] = (),
    *,
    full: Annotated[
        bool,
        switch("The scenes are the paper's: its pairs, 30k steps and 500k Gaussians, photos as they are."),
    ] = False,
    pairs: Annotated[
        UseAppendAction[tuple[str, ...]],
        optional(
            "COVER,SECRET",
            "Names of a cover and its secret, for multi COVER,SECRET,SECRET; repeat for more.",
            "each hides the next; with --full as published",
        ),
    ] = (),
    out: OutFolder,
    dry_run: DryRun = False,
    iterations: Annotated[int | None, optional("N", "Training steps.", "1k, or see --full")] = None,
    max_gaussians: Annotated[
        int | None, optional("N", "Maximum number of Gaussians of a model.", "9k, or see --full")
    ] = None,
    width: Annotated[
        int | None, optional("PIXELS", "Downscale wider photos to this width.", "120, or see --full")
    ] = None,
    device: Device = "auto",
    seed: Seeds = (),
) -> None:
    """Reproduce a table of the KeySS paper, and check its claims.

    A claim holds if all of its comparisons of means hold, and in part if half of them do. Tables in one
    folder share their runs. Run the same command again to resume.

    example: keyss reproduce single SCENE_A SCENE_B -o runs/paper

    example: keyss reproduce multi 360/* --full -o runs/paper-full
    """
    check_exists(*scenes)
    run = verb("reproduce")
    from keyss import progress
    from keyss.cli.tables import print_files, print_table
    from keyss.core.errors import InputError
    from keyss.lab.many import Forecast
    from keyss.lab.many.reproduction import reproduction_notes, reproduction_rows

    reproduction = run(
        table,
        scenes,
        full=full,
        pairs=pairs,
        iterations=iterations,
        max_gaussians=max_gaussians,
        width=width,
        seeds=tuple(map(check_seed, seed)) or (0,),
        device=device,
        out=out,
        dry_run=dry_run,
        reporter=progress.reporter(),
    )
    if isinstance(reproduction, Forecast):
        _print_forecast(reproduction)
        return
    heads, *rows = reproduction_rows(reproduction)
    if progress.level >= 0:
        print_table(heads, rows)
    means = f"Published and measured figures, on test views; means over {len(reproduction.pairs)} pair(s)."
    described = {
        **_scene_tables(table),
        f"{table}.json": "all figures, for programs",
        "trials": "the runs, which other tables share",
    }
    progress.say(*reproduction_notes(reproduction), means)
    print_files(out, described)
    if reproduction.failures:
        raise InputError(f"{len(reproduction.failures)} run(s) failed")


def sweep(
    spec: Annotated[
        Positional[Path], arg(metavar="SPEC", help="YAML file: pairs, methods and their options, seeds.")
    ],
    *,
    out: OutFolder,
    ray: Annotated[
        str | None, optional("ADDRESS", "Ray cluster to run on, or `local`.", "one after the other, here")
    ] = None,
    cores: Annotated[int, arg(metavar="N", help="With --ray: cores of each run.")] = 1,
    dry_run: DryRun = False,
) -> None:
    """Hide over a grid of scenes, methods, options and seeds, and tabulate the results.

    docs/experiments.md describes SPEC. Run the same command again to resume.

    example: keyss sweep sweep.yaml -o runs/sweep

    example: keyss sweep sweep.yaml -o runs/sweep --dry-run
    """
    check_exists(spec)
    run = verb("sweep")
    from keyss import progress
    from keyss.cli.tables import print_files
    from keyss.core.errors import InputError
    from keyss.lab.many import Forecast

    outcomes = run(spec, out, ray=ray, cores=cores, dry_run=dry_run, reporter=progress.reporter())
    if isinstance(outcomes, Forecast):
        _print_forecast(outcomes)
        return
    described = {
        **_scene_tables("scenes"),
        "results.csv": "all measures: mean and standard deviation over seeds",
        "trials.csv": "the numbers of each trial",
        "private/master-key.txt": "the key from which those of the trials are derived",
    }
    print_files(out, described)
    failed = [outcome for outcome in outcomes if outcome.error]
    progress.say(f"{len(outcomes) - len(failed)} of {len(outcomes)} trials are done")
    for outcome in failed:
        print(f"failed: {outcome.trial.name}: {outcome.error}")
    if failed:
        raise InputError(f"{len(failed)} of {len(outcomes)} trials failed")


def _scene_tables(stem: str) -> dict[str, str]:
    """Descriptions of two files."""
    scenes = "PSNR, SSIM and LPIPS, a row for each scene: mean and standard deviation over seeds"
    return {f"{stem}.csv": scenes, f"{stem}.tex": "the same, for LaTeX (booktabs)"}


def _print_forecast(forecast: Forecast) -> None:
    """Print the trials of a dry run, with estimates for those to do."""
    from keyss.cli.tables import print_table
    from keyss.progress import about

    rows = []
    for place, name in forecast.names.items():
        time, memory = "cannot work" if place in forecast.refused else "done", ""
        if (cost := forecast.costs.get(place)) is not None:
            time, memory = about(cost.seconds), f"{cost.memory_bytes / 1e9:.1f} GB"
        rows.append((name, time, memory))
    print_table(("run", "time, about", "memory"), rows)
    for place, reason in forecast.refused.items():
        print(f"{forecast.names[place]}: {reason}")
    print(
        f"{len(rows)} run{'s' * (len(rows) != 1)}, {len(forecast.costs)} to do: about "
        f"{about(sum(cost.seconds for cost in forecast.costs.values()))} on this machine."
    )
    print("Dry run: nothing was written. Times are rough; measurements are included.")
