"""The audit of a run: measures part by part, and stores each result at once."""

from __future__ import annotations

import os
import platform
import time
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from importlib.metadata import version as version_of
from pathlib import Path

import msgspec

from keyss._version import __version__
from keyss.core import InputError, Interrupted, KeyssWarning, UsageError, import_extra, signal_of
from keyss.lab.audits.parts import OF_3DGS_MODELS, PARTS, AuditSubject, PartialAudit, PartProgress, subject_of
from keyss.lab.audits.record import AUDIT_FILE, AUDIT_FOLDER, PICTURES, Audit, AuditedRun, read_audit
from keyss.methods import registry
from keyss.progress import Reporter
from keyss.rendering import Backend, resolve_device
from keyss.runs.files import REPORT, PathLike
from keyss.runs.folder import CHECKPOINTS, RunFolder, read_manifest, write_again
from keyss.runs.open_run import HidingRun, open_run

_LIBRARIES = ("torch", "numpy", "scipy", "scikit-learn", "pot", "gsplat", "numba")
EXTRA = ("jinja2", "ot", "sklearn")
KEPT = ("hide", "demo", "controls")  # stages of a run whose files an audit keeps


def audit(
    run: PathLike,
    keys: Sequence[str] = (),
    *,
    report_only: bool = False,
    original: PathLike | None = None,
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
    run's audit or the finished parts of an interrupted one; needs no keys. `original`: a plain model of the
    cover, by default the run's own. `controls`: number of plain models of the cover with other seeds to
    compare with; at least 2, kept in `private/controls/`. `only`: names of parts, by default all.

    The folder gets `private/audit/` with pictures and `audit.json`, which is also returned, and
    `private/report.html`. `resume` continues an interrupted audit after its finished parts. Raises KeyssError
    (BackendError without the extra `audit`), and Interrupted on Ctrl-C.
    """
    if report_only:
        return _report(Path(run))
    if controls < 2:
        raise UsageError(f"expected at least 2 plain models to compare with, got {controls}")
    if unknown := sorted(set(only) - set(PARTS)):
        raise UsageError(f"no such part of an audit: {', '.join(unknown)}; there are {', '.join(PARTS)}")
    for module in EXTRA:
        import_extra(module, "audit", "audit a run")
    started, reporter = time.monotonic(), reporter or Reporter()
    opened = open_run(run, keys)
    standard = registry.get(opened.config.method).capabilities.standard
    if impossible := sorted(set(only) & OF_3DGS_MODELS) if not standard else []:
        raise UsageError(
            f"the method {opened.config.method} does not publish a 3DGS model, which "
            f"{' and '.join(impossible)} measure: leave out `only`, or name other parts"
        )
    target = resolve_device(device)
    settings = {"original": original and os.path.realpath(original), "controls": controls, "only": only}
    folder = RunFolder(
        opened.folder,
        "audit",
        settings | {"seed": seed, "device": target.type, "payloads": opened.config.payloads},
        onto=KEPT,
        writes=(f"{AUDIT_FOLDER}/{AUDIT_FILE}", REPORT),
        overwrite=overwrite,
        resume=resume,
    )
    from keyss.lab.audits.report import report_bytes

    with folder.work(), _resumable(folder.checkpoints):
        subject = subject_of(opened, original, controls, seed, target, reporter, folder)
        begun = Audit(
            keyss=__version__,
            seconds=0.0,
            run=_audited_run(opened),
            controls=subject.seeds,
            wrong_key=opened.metrics.wrong_key,
            chance_level=opened.metrics.chance_level,
        )
        partial_audit = PartialAudit(folder.checkpoints, begun, _inputs(subject, seed))
        chosen = _choose_parts(only, standard)
        for index, name in enumerate(chosen):
            if getattr(partial_audit.audit, name) is None:
                progress = PartProgress(reporter, f"audit, {index + 1} of {len(chosen)}: {name}")
                try:
                    partial_audit.add(name, PARTS[name](subject, seed, progress))
                finally:
                    progress.finish(getattr(partial_audit.audit, name) is not None)
        result = replace(partial_audit.audit, seconds=round(time.monotonic() - started, 1))
        pictures = {
            f"{AUDIT_FOLDER}/{PICTURES}/{path.name}": path.read_bytes()
            for path in partial_audit.pictures.glob("*.png")
        }
        there = folder.write({f"{AUDIT_FOLDER}/{AUDIT_FILE}": result, **pictures})
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


def _report(run: Path) -> Audit:
    """Write the report of a run's audit, finished or not."""
    import_extra("jinja2", "audit", "write a report")
    from keyss.lab.audits.report import report_bytes

    record = f"{AUDIT_FOLDER}/{AUDIT_FILE}"
    running = None if (run / record).exists() else read_manifest(run).running
    if running and not (run / CHECKPOINTS / record).exists():
        raise InputError(
            f"{run}: the {running.stage} was interrupted before there was anything to report: `resume=True` "
            "with the same arguments continues it"
        )
    place = run / CHECKPOINTS if running else run
    result = read_audit(place)
    if running:
        parts = _choose_parts(running.arguments["only"], result.run.standard)
        missing = [name for name in parts if getattr(result, name) is None]
        warnings.warn(
            f"the audit was interrupted before {', '.join(missing)}: `resume=True` with the same arguments "
            "continues it",
            KeyssWarning,
            stacklevel=2,
        )
    write_again(run, "audit", REPORT, report_bytes(result, place))
    return result


def _choose_parts(only: Sequence[str], standard: bool) -> list[str]:
    """The parts of an audit; `standard`: the run published a 3DGS model."""
    possible = [name for name in PARTS if standard or name not in OF_3DGS_MODELS]
    return [name for name in possible if not only or name in only]


def _inputs(subject: AuditSubject, seed: int) -> dict[str, object]:
    """All inputs of the parts."""
    return {
        "payloads": subject.run.config.payloads,
        "stego": subject.stego.digest(),
        "original": subject.original.digest(),
        "scenes": [scene.digest() for scene in subject.scenes],
        "seeds": [*subject.seeds, seed],
        "version": __version__,
    }


def _audited_run(run: HidingRun) -> AuditedRun:
    cover, *secrets = run.sources
    return AuditedRun(
        path=str(run.folder),
        method=run.config.method,
        cover=cover,
        secrets=tuple(secrets),
        width=run.config.views.width,
        gaussians=len(run.stego),
        standard=registry.get(run.config.method).capabilities.standard,
        config=msgspec.json.decode(msgspec.json.encode(run.config.options)),  # like `read_audit`
        versions={"python": platform.python_version()} | {name: version_of(name) for name in _LIBRARIES},
    )
