"""The audit of a run: measures part by part, and stores each result at once in `audit/audit.json`."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

from keyss._version import __version__
from keyss.core import InputError, Interrupted, UsageError, import_extra, signal_of
from keyss.files import write_bytes
from keyss.files.images import png_bytes
from keyss.lab.audits.parts import (
    NEED_A_3DGS_MODEL,
    PARTS,
    ImagesResult,
    ParametersResult,
    Progress,
    RenderTime,
    StegExposeResult,
    Subject,
)
from keyss.lab.leaks.leak_scores import AttackResult
from keyss.lab.robustness.survival import ChangeResult
from keyss.lab.stealth.judging import StealthResult
from keyss.measure.hide_quality import WrongKeys
from keyss.progress import Reporter, Share
from keyss.rendering import Backend, resolve_device
from keyss.runs import read_record, write_record
from keyss.runs.estimates import seconds_for
from keyss.runs.files import REPORT, PathLike, run_folder, stego_in
from keyss.runs.folder import PRIVATE, RunFolder, write_again
from keyss.runs.open_run import open_run

AUDIT, PICTURES = f"{PRIVATE}/audit/audit.json", f"{PRIVATE}/audit/pictures"  # relative to the run
EXTRA = ("jinja2", "ot", "sklearn")
KEPT = ("hide", "demo", "controls")  # stages of a run whose files an audit keeps


@dataclass(frozen=True)
class AuditedRun:
    """The audited run."""

    path: str
    method: str
    cover: str  # a scene folder, or a model without photos; `secrets` too
    secrets: tuple[str, ...]
    width: int | None  # pixels, if photos were shrunk
    gaussians: int  # Gaussians of the stego model


@dataclass(frozen=True, kw_only=True)
class Audit:
    """The result of an audit; parts that did not run are None."""

    version: int = 5
    keyss: str  # version of the program
    seconds: float
    run: AuditedRun
    controls: tuple[int, ...]  # seeds of the plain models of the cover to compare with
    wrong_key: WrongKeys | None = None  # copied from the run's `metrics.json`, like the chance level
    chance_level: tuple[float, ...] = ()  # dB, the stego model against each secret's test views
    images: ImagesResult | None = None
    parameters: ParametersResult | None = None
    stealth: StealthResult | None = None
    stegexpose: StegExposeResult | None = None
    leaks: tuple[tuple[AttackResult, ...], ...] | None = None  # attacks on each secret
    robustness: tuple[ChangeResult, ...] | None = None
    speed: dict[str, RenderTime] | None = None


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
    with reporter.waiting("opening the secrets", len(keys) * seconds_for("reveal", stego_in(Path(run)))):
        opened = open_run(run, keys)
    subject = Subject(opened, resolve_device(device))
    excluded = set() if subject.standard else NEED_A_3DGS_MODEL
    if impossible := sorted(set(only) & excluded):
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
    from keyss.lab.audits.forecast import forecast_audit
    from keyss.lab.audits.report import report_bytes

    with folder.work(), _resumable(folder.checkpoints):
        seeds = [opened.config.options.fit.seed_of(f"control {seed + index}") for index in range(controls)]
        subject.fit_controls(seeds, folder, reporter)
        record, pictures = folder.checkpoints / "audit.json", folder.checkpoints / "pictures"
        result = read_record(record, Audit) if record.exists() else _nothing_measured(subject, seeds)
        chosen = chosen_parts(only, subject.standard)
        seconds = forecast_audit(opened.folder, controls=controls, only=only, device=device).seconds
        for index, name in enumerate(chosen):
            if getattr(result, name) is not None:
                continue
            title = f"audit, {index + 1} of {len(chosen)}: {name}"
            with reporter.waiting(title, seconds[name]) as share:
                section, shown = PARTS[name](subject, seed, _in_shares(share))
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


def chosen_parts(only: Sequence[str], standard: bool) -> list[str]:
    """Names of the parts of an audit; `standard`: the published file is a 3DGS model. Raises UsageError."""
    if unknown := sorted(set(only) - set(PARTS)):
        raise UsageError(f"no such part of an audit: {', '.join(unknown)}; there are {', '.join(PARTS)}")
    excluded = set() if standard else NEED_A_3DGS_MODEL
    return [name for name in PARTS if name in (only or PARTS) and name not in excluded]


def _in_shares(share: Share) -> Progress:
    return lambda done, of: share(done / of)


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
        ),
        controls=tuple(seeds),
        wrong_key=run.metrics.wrong_key,
        chance_level=run.metrics.chance_level,
    )
