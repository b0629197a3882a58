"""The commands that judge: how well something is hidden, and what gives it away.

Everything heavy is imported inside the commands, so that `keyss --help` answers at once.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal, get_args

from tyro.conf import Positional, UseAppendAction, arg

from keyss.cli.arguments import Device, KeyFiles, Overwrite, Resume, checked_seed, optional

PartName = Literal["images", "parameters", "stealth", "stegexpose", "leaks", "robustness", "speed"]
_PARTS = get_args(PartName)


def evaluate(
    run: Annotated[Positional[Path], arg(metavar="RUN", help="Result folder of `keyss hide`.")],
    *,
    key_file: KeyFiles = (),
    wrong_keys: Annotated[
        int | None, optional("N", "Number of random wrong keys to try.", "32, where there is a decoder")
    ] = None,
    device: Device = "auto",
    seed: Annotated[int | None, optional("N", "Seed of the wrong keys.", "the run's")] = None,
) -> None:
    """Measure a hiding run on test views, with the keys and with wrong ones.

    Test views are photos that were not trained on or, of a model, renders of it. Beside each number
    stands its bound, plain 3DGS of as many Gaussians and as many training steps, or where nobody fitted that
    (`keyss hide --bound` does), the plain model that the scene started from. Chance level is what the stego
    model itself reaches against the secret: a wrong key should not get above it.

    example: keyss evaluate runs/hidden --key-file key.txt
    """
    from keyss import api
    from keyss.cli.keys import hinting_at_white_space, keys_of_run
    from keyss.cli.tables import print_files, print_hiding
    from keyss.fitting.config import MOST_SEED

    chosen = keys_of_run(run, key_file)
    with hinting_at_white_space(chosen):
        metrics = api.evaluate(
            run,
            chosen,
            wrong_keys=wrong_keys,
            seed=None if seed is None else checked_seed(seed, MOST_SEED),
            device=device,
        )
    print_hiding(metrics)
    print_files(run, {"private/metrics.json": "the numbers"})


def steganalyze(
    folder: Annotated[Positional[Path], arg(metavar="FOLDER", help="Folder of images, PNG for choice.")],
    *,
    csv: Annotated[Path, arg(metavar="FILE", help="Table to write: one row per image.")],
    threshold: Annotated[float, arg(metavar="T", help="Flag images whose fused score is above it.")] = 0.2,
    fast: Annotated[
        bool, arg(help="Stop with an image as soon as it looks clean; such scores compare with no others.")
    ] = False,
    overwrite: Overwrite = False,
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


def audit(
    run: Annotated[Positional[Path], arg(metavar="RUN", help="Result folder of `keyss hide`.")],
    *,
    key_file: KeyFiles = (),
    original: Annotated[
        Path | None, optional("FILE", "Plain model of the cover to compare with.", "the run's own")
    ] = None,
    controls: Annotated[
        int, arg(metavar="N", help="Plain models of the cover from other seeds, to compare with; 2 or more.")
    ] = 3,
    only: Annotated[
        UseAppendAction[tuple[PartName, ...]],
        optional(
            "PART",
            f"A part: {', '.join(_PARTS[:-1])} or {_PARTS[-1]}; once for each.",
            "all of them",
        ),
    ] = (),
    resume: Resume = False,
    overwrite: Overwrite = False,
    device: Device = "auto",
    seed: Annotated[int, arg(metavar="N", help="Seed of everything random.")] = 0,
) -> None:
    """Judge a hiding: quality, stealth, attacks with and without a key, robustness, speed. Takes minutes.

    example: keyss audit runs/hidden --key-file key.txt
    """
    from keyss import api
    from keyss.cli.keys import hinting_at_white_space, keys_of_run
    from keyss.cli.tables import print_files, print_verdicts
    from keyss.progress import reporter

    chosen = keys_of_run(run, key_file)
    with hinting_at_white_space(chosen):
        api.audit(
            run,
            chosen,
            original=original,
            controls=controls,
            only=only,
            seed=checked_seed(seed),
            device=device,
            overwrite=overwrite,
            resume=resume,
            reporter=reporter(),
        )
    print_verdicts(run)
    print_files(
        run,
        {
            "private/report.html": "all of it, for people: look here first; it shows the secret",
            "private/audit/audit.json": "all of it, for programs",
        },
    )


def report(
    run: Annotated[Positional[Path], arg(metavar="RUN", help="Result folder that `keyss audit` has judged.")],
) -> None:
    """Write what an audit found as one HTML file that needs no network.

    example: keyss report runs/hidden
    """
    from keyss import api
    from keyss.cli.tables import print_files, print_verdicts

    path = api.write_report(run)
    print_verdicts(run)
    print_files(path.parent, {path.name: "open it in a browser; it shows the secret"})


def _listed(names: list[str], most: int = 5) -> str:
    """The first names, quoted since file names may hold anything, and how many more there are."""
    rest = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(map(repr, names[:most])) + rest
