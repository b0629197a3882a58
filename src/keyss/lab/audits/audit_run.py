"""The audit of a run: measures part by part, and stores each result at once in `audit/audit.json`."""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import nullcontext, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from keyss.core import InputError, Interrupted, OutputError, UsageError, import_extra
from keyss.lab.audits.parts import PARTS, Part
from keyss.lab.audits.record import Audit
from keyss.lab.audits.report import report_of
from keyss.lab.audits.subject import Subject
from keyss.methods import registry
from keyss.progress import Reporter, reporter as default_reporter
from keyss.rendering import Backend, resolve_device
from keyss.runs import read_record
from keyss.runs.estimates import seconds_for
from keyss.runs.files import REPORT, PathLike, run_folder, stego_in
from keyss.runs.folder import CHECKPOINTS, PRIVATE, RunFolder
from keyss.runs.open_run import open_run, read_run

AUDIT, PICTURES = f"{PRIVATE}/audit/audit.json", f"{PRIVATE}/audit/pictures"  # relative to the run
EXTRA = ("ot", "sklearn")
KEPT = ("scenes", "hide", "demo", "controls", "audit")  # stages of a run whose files an audit keeps


def read_audit(run: Path) -> Audit:
    """Read a run's audit. Raises InputError if it is missing, broken, too large or of another version."""
    path = run / AUDIT
    if not path.exists():
        run_folder(run)
        raise InputError(f"{path}: there is no audit; `keyss audit {run}` makes one")
    return read_record(path, Audit)


def audit(
    run: PathLike,
    keys: Sequence[str] = (),
    *,
    controls: int = 3,
    only: Sequence[str] = (),
    seed: int = 0,
    device: Backend = "auto",
    overwrite: bool = False,
    reporter: Reporter | None = None,
) -> Audit:
    """Measure quality, stealth, leaks, robustness and speed of a folder of `hide`.

    `keys`: one per secret, in any order. `controls`: number of plain models of the cover with other seeds to
    compare with; at least 2, kept in `private/controls/`. `only`: names of parts, by default all.

    The folder gets `private/audit/` with pictures and `audit.json`, which is also returned, and
    `private/report.md`, after each part. Parts that an earlier audit with the same controls has are not
    measured again, unless `overwrite`. Raises KeyssError (BackendError without the extra `audit`) and
    KeyboardInterrupt.
    """
    if controls < 2:
        raise UsageError(f"expected at least 2 plain models to compare with, got {controls}")
    for module in EXTRA:
        import_extra(module, "audit", "audit a run")
    _, config, *_ = read_run(Path(run))
    parts, reporter = _chosen(only, config.method), reporter or default_reporter()
    with reporter.waiting("opening the secrets", len(keys) * seconds_for("reveal", stego_in(Path(run)))):
        opened = open_run(run, keys)
    fit = opened.config.options.fit
    seeds = tuple(fit.seed_of(f"control {seed + index}") for index in range(controls))
    cover, *secrets = opened.sources
    result = Audit(
        method=opened.config.method,
        cover=cover,
        secrets=tuple(secrets),
        width=opened.config.views.width,
        gaussians=len(opened.stego),
        controls=seeds,
    )
    if (opened.folder / AUDIT).exists():
        earlier = None
        with suppress(InputError) if overwrite else nullcontext():
            earlier = read_audit(opened.folder)
        if earlier is not None and earlier.controls == seeds:
            result = earlier
        elif not overwrite:
            raise OutputError(f"{run} has an audit with other controls: `overwrite=True` replaces it")
    subject = Subject(opened, resolve_device(device))
    settings = {"controls": controls, "seed": seed, "device": subject.device.type}
    settings |= {"payloads": opened.config.payloads}
    known: dict[str, Any] = {"onto": KEPT, "writes": (AUDIT, REPORT), "overwrite": overwrite}
    folder = partial(RunFolder, opened.folder, "audit", settings, **known)
    due = {name: part for name, part in parts.items() if overwrite or name not in result.sections}
    if due:
        resume = not overwrite and any((opened.folder / CHECKPOINTS).glob("[!.]*"))  # a control's training
        with folder(resume=resume).work() as place:
            try:
                subject.fit_controls(seeds, place, reporter)
            except Interrupted as error:  # its message says how to resume a fit
                reporter.note("interrupted: the same command resumes")
                raise KeyboardInterrupt(*error.args) from error
    for number, (name, part) in enumerate(due.items(), start=1):
        started, seconds = time.monotonic(), part.views * subject.view_seconds
        with folder().work() as place:
            with reporter.waiting(f"audit, {number} of {len(due)}: {name}", seconds) as share:
                section, shown = part.measure(subject, seed, share)
            files = {caption: f"{name}-{index}.png" for index, caption in enumerate(shown, start=1)}
            sections = result.sections | {name: replace(section, pictures=files)}
            result = replace(
                result,
                sections={each: sections[each] for each in PARTS if each in sections},
                seconds=round(result.seconds + time.monotonic() - started, 1),
            )
            report = report_of(result, PICTURES.removeprefix(f"{PRIVATE}/")).encode(errors="replace")
            pictures = {f"{PICTURES}/{file}": shown[caption] for caption, file in files.items()}
            place.write({AUDIT: result, REPORT: report, **pictures})
    return result


def _chosen(only: Sequence[str], method: str) -> dict[str, Part]:
    """The parts to measure. Raises UsageError for unknown ones, and for those that the method excludes."""
    if unknown := sorted(set(only) - set(PARTS)):
        raise UsageError(f"no such part of an audit: {', '.join(unknown)}; there are {', '.join(PARTS)}")
    standard = registry.get(method).capabilities.standard
    parts = {name: part for name, part in PARTS.items() if standard or not part.only_3dgs}
    if impossible := sorted(set(only) - set(parts)):
        raise UsageError(
            f"the method {method} does not publish a 3DGS model, which "
            f"{' and '.join(impossible)} measure: leave out `only`, or name other parts"
        )
    return {name: part for name, part in parts.items() if name in (only or parts)}
