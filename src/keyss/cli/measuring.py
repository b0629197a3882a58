"""The commands that measure: `evaluate` and `audit`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal, get_args

from tyro.conf import Positional, UseAppendAction, arg

from keyss.cli.arguments import (
    Device,
    KeyFiles,
    Overwrite,
    Resume,
    check_there,
    checked_seed,
    optional,
    switch,
)

PartName = Literal["images", "parameters", "stealth", "stegexpose", "leaks", "robustness", "speed"]
_A_RUN = "the folder of a run, as `keyss hide` writes it"
Run = Annotated[Positional[Path], arg(metavar="RUN", help="Result folder of `keyss hide`.")]


def evaluate(
    run: Run,
    *,
    key_file: KeyFiles = (),
    wrong_keys: Annotated[
        int | None, optional("N", "Number of random wrong keys, for methods with a decoder.", "32")
    ] = None,
    device: Device = "auto",
) -> None:
    """Measure PSNR, SSIM and LPIPS of a run again, with the right keys and wrong ones.

    Test views are photos that were held out of training or, for a model, renders of it. Each measurement is
    compared with its bound: plain 3DGS of as many Gaussians and as many training steps (`keyss hide --bound`
    fits it), or the plain model that the scene started from. The chance level is the PSNR of the stego model
    itself to the secret; a wrong key should not exceed it.

    example: keyss evaluate runs/hidden --key-file key.txt
    """
    check_there(run, expected=_A_RUN)
    import keyss
    from keyss.cli.keys import keys_of_run
    from keyss.cli.tables import print_files, print_hiding
    from keyss.fitting.lpips import HOW_TO_GET, MIN_SIZE

    metrics = keyss.evaluate(run, keys_of_run(run, key_file), wrong_keys=wrong_keys, device=device)
    print_hiding(metrics)
    if metrics.cover.lpips is None:
        print(f"{HOW_TO_GET}; photos must have at least {MIN_SIZE} x {MIN_SIZE} pixels.")
    print_files(run, {"private/metrics.json": "the measurements"})


def audit(
    run: Run,
    *,
    key_file: KeyFiles = (),
    original: Annotated[
        Path | None, optional("FILE", "Plain model of the cover to compare with.", "the run's own")
    ] = None,
    controls: Annotated[
        int, arg(metavar="N", help="Plain models of the cover from other seeds, as controls; at least 2.")
    ] = 3,
    only: Annotated[
        UseAppendAction[tuple[PartName, ...]],
        optional("PART", f"Part to audit: {', '.join(get_args(PartName))}; repeat for more.", "all"),
    ] = (),
    report_only: Annotated[bool, switch("Write the report again, of an interrupted audit too.")] = False,
    resume: Resume = False,
    overwrite: Overwrite = False,
    device: Device = "auto",
    seed: Annotated[int, arg(metavar="N", help="Seed of all random numbers.")] = 0,
) -> None:
    """Audit a run: quality, stealth, attacks, robustness and speed; takes minutes.

    example: keyss audit runs/hidden --key-file key.txt

    example: keyss audit runs/hidden --report-only
    """
    check_there(run, expected=_A_RUN)
    import keyss
    from keyss.cli.keys import keys_of_run
    from keyss.cli.tables import print_files, print_verdicts
    from keyss.progress import reporter

    if report_only:
        found = keyss.audit(run, report_only=True)
    else:
        found = keyss.audit(
            run,
            keys_of_run(run, key_file),
            original=original,
            controls=controls,
            only=only,
            seed=checked_seed(seed),
            device=device,
            overwrite=overwrite,
            resume=resume,
            reporter=reporter(),
        )
    print_verdicts(found)
    print_files(
        run,
        {
            "private/report.html": "the report: look here first; it shows the secret",
            "private/audit/audit.json": "the measurements",
        },
    )
