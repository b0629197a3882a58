"""The audit of a run: measures part by part, and stores each result at once."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from keyss._version import __version__
from keyss.core import Interrupted, UsageError, import_extra, signal_of
from keyss.files import write_bytes
from keyss.files.images import png_bytes
from keyss.lab.audits.parts import NEED_A_3DGS_MODEL, PARTS, PartProgress
from keyss.lab.audits.record import AUDIT, PICTURES, Audit, AuditedRun, read_audit
from keyss.lab.audits.subject import Subject
from keyss.progress import Reporter
from keyss.rendering import Backend, resolve_device
from keyss.runs import read_record, write_record
from keyss.runs.files import REPORT, PathLike
from keyss.runs.folder import RunFolder, write_again
from keyss.runs.open_run import open_run

EXTRA = ("jinja2", "ot", "sklearn")
KEPT = ("hide", "demo", "controls")  # stages of a run whose files an audit keeps


def audit(
    run: PathLike,
    keys: Sequence[str] = (),
    *,
    report_only: bool = False,
    controls: int = 3,
    only: Sequence[str] = (),
    seed: int = 0,
    device: Backend = "auto",
    overwrite: bool = False,
    resume: bool = False,
    reporter: Reporter | None = None,
) -> Audit:
    """Measure quality, stealth, leaks, robustness and speed of a folder of `hide`.

    `keys`: one per secret, in any order. `report_only`: only write `private/report.html` again, from the
    run's audit; needs no keys. `controls`: number of plain models of the cover with other seeds to compare
    with; at least 2, kept in `private/controls/`. `only`: names of parts, by default all.

    The folder gets `private/audit/` with pictures and `audit.json`, which is also returned, and
    `private/report.html`. `resume` continues an interrupted audit after its finished parts. Raises KeyssError
    (BackendError without the extra `audit`), and Interrupted on Ctrl-C.
    """
    if report_only:
        return _write_report(Path(run))
    if controls < 2:
        raise UsageError(f"expected at least 2 plain models to compare with, got {controls}")
    if unknown := sorted(set(only) - set(PARTS)):
        raise UsageError(f"no such part of an audit: {', '.join(unknown)}; there are {', '.join(PARTS)}")
    for module in EXTRA:
        import_extra(module, "audit", "audit a run")
    started, reporter = time.monotonic(), reporter or Reporter()
    opened = open_run(run, keys)
    subject = Subject(opened, resolve_device(device))
    if impossible := sorted(set(only) & NEED_A_3DGS_MODEL) if not subject.standard else []:
        raise UsageError(
            f"the method {opened.config.method} does not publish a 3DGS model, which "
            f"{' and '.join(impossible)} measure: leave out `only`, or name other parts"
        )
    settings = {"controls": controls, "only": only, "seed": seed, "device": subject.device.type}
    folder = RunFolder(
        opened.folder,
        "audit",
        settings | {"payloads": opened.config.payloads},
        onto=KEPT,
        writes=(AUDIT, REPORT),
        overwrite=overwrite,
        resume=resume,
    )
    from keyss.lab.audits.report import report_bytes

    with folder.work(), _resumable(folder.checkpoints):
        seeds = [opened.config.options.fit.seed_of(f"control {seed + index}") for index in range(controls)]
        subject.fit_controls(seeds, folder, reporter)
        record, pictures = folder.checkpoints / "audit.json", folder.checkpoints / "pictures"
        result = read_record(record, Audit) if record.exists() else _nothing_measured(subject, seeds)
        chosen = [name for name in PARTS if _is_chosen(name, only, subject.standard)]
        for index, name in enumerate(chosen):
            if getattr(result, name) is not None:
                continue
            with PartProgress(reporter, f"audit, {index + 1} of {len(chosen)}: {name}") as progress:
                section, shown = PARTS[name](subject, seed, progress)
            pictures.mkdir(exist_ok=True)
            for file, picture in shown.items():
                write_bytes(pictures / file, png_bytes(picture))
            write_record(record, replace(result, **{name: section}))
            result = read_record(record, Audit)
        result = replace(result, seconds=round(time.monotonic() - started, 1))
        contents = {f"{PICTURES}/{path.name}": path.read_bytes() for path in pictures.glob("*.png")}
        there = folder.write({AUDIT: result, **contents})
        folder.write({REPORT: report_bytes(result, there)})
    return result


@contextmanager
def _resumable(checkpoints: Path) -> Iterator[None]:
    """Turn any interrupt into Interrupted, which says how to continue."""
    try:
        yield
    except Interrupted:
        raise
    except KeyboardInterrupt as error:
        saved = any(not path.name.startswith(".") for path in checkpoints.iterdir())
        raise Interrupted(checkpoints if saved else None, None, signal_of(error)) from error


def _write_report(run: Path) -> Audit:
    """Write the report of a run's audit again."""
    import_extra("jinja2", "audit", "write a report")
    from keyss.lab.audits.report import report_bytes

    result = read_audit(run)
    write_again(run, "audit", REPORT, report_bytes(result, run))
    return result


def _is_chosen(name: str, only: Sequence[str], standard: bool) -> bool:
    """True for a part to measure; `standard`: the run published a 3DGS model."""
    return (standard or name not in NEED_A_3DGS_MODEL) and (not only or name in only)


def _nothing_measured(subject: Subject, seeds: Sequence[int]) -> Audit:
    run = subject.run
    cover, *secrets = run.sources
    return Audit(
        keyss=__version__,
        seconds=0.0,
        run=AuditedRun(
            path=str(run.folder),
            method=run.config.method,
            cover=cover,
            secrets=tuple(secrets),
            width=run.config.views.width,
            gaussians=len(run.stego),
            standard=subject.standard,
        ),
        controls=tuple(seeds),
        wrong_key=run.metrics.wrong_key,
        chance_level=run.metrics.chance_level,
    )
