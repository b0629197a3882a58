"""The audit of one hiding: all measures, one after the other, each kept as soon as it is there."""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Sequence
from importlib.metadata import version as version_of

import msgspec

from keyss._version import __version__
from keyss.audit.parts import OF_3DGS_MODELS, PARTS
from keyss.audit.progress import FinishedParts, PartProgress
from keyss.audit.subject import AuditSubject, subject_of
from keyss.core.errors import Interrupted, UsageError, signal_of
from keyss.files.layout import usual_up
from keyss.fitting.loop import Reporter, SilentReporter
from keyss.methods import registry
from keyss.rendering import Backend, resolve_device
from keyss.report.page import report_bytes
from keyss.runs.audit_record import (
    AUDIT_FILE,
    AUDIT_FOLDER,
    PICTURES,
    Audit,
    AuditedRun,
    Controls,
    WrongKeyResult,
)
from keyss.runs.config import PathLike
from keyss.runs.files import REPORT, stego_in, writers
from keyss.runs.folder import RunFolder
from keyss.runs.opening import HidingRun, open_run

_LIBRARIES = ("torch", "numpy", "scipy", "scikit-learn", "pot", "gsplat", "numba")
KEPT = ("hide", "demo", "controls")  # what an audit leaves where it is


def audit(
    run: PathLike,
    keys: Sequence[str],
    *,
    original: PathLike | None = None,
    controls: int = 3,
    only: Sequence[str] = (),
    seed: int = 0,
    device: Backend = "auto",
    overwrite: bool = False,
    resume: bool = False,
    reporter: Reporter | None = None,
) -> Audit:
    """Judge a folder that `hide` made, harder than by looking at it; see `keyss.audit.parts`.

    `keys`: those of all its secrets, in any order. `original`: a plain model of the cover, by default the
    run's own. `controls`: number of plain models of the cover to compare with, trained from other seeds and
    kept in `private/controls/`; at least 2. `only`: names of parts, by default all. The folder gets
    `private/audit/` with `audit.json`, which is also returned, and pictures, and `private/report.html`; while
    it runs, finished parts are kept, and `resume` goes on after them. Raises KeyssError and its children,
    Interrupted on Ctrl-C.
    """
    if controls < 2:
        raise UsageError(f"expected at least 2 plain models to compare with, got {controls}")
    if unknown := sorted(set(only) - set(PARTS)):
        raise UsageError(f"no such part of an audit: {', '.join(unknown)}; there are {', '.join(PARTS)}")
    started, reporter = time.monotonic(), reporter or SilentReporter()
    opened = open_run(run, keys)
    standard = registry.get(opened.config.method).capabilities.standard
    if impossible := sorted(set(only) & OF_3DGS_MODELS) if not standard else []:
        raise UsageError(
            f"what the method {opened.config.method} publishes is no 3DGS model: there is nothing for "
            f"{' and '.join(impossible)} to look at; leave out `only`, or name other parts"
        )
    target = resolve_device(device)
    asked = {"original": original and os.path.realpath(original), "controls": controls, "only": only}
    folder = RunFolder(
        opened.folder,
        "audit",
        asked | {"seed": seed, "device": target.type, "payloads": opened.config.payloads},
        onto=KEPT,
        writes=(f"{AUDIT_FOLDER}/{AUDIT_FILE}", REPORT),
        overwrite=overwrite,
        resume=resume,
    )
    with folder.work():
        subject = subject_of(opened, original, controls, seed, target, reporter, folder)
        finished = FinishedParts(folder.checkpoints, _inputs(subject, seed))
        sections = {}
        pictures: dict[str, bytes] = {}
        possible = [name for name in PARTS if standard or name not in OF_3DGS_MODELS]
        chosen = [name for name in possible if not only or name in only]
        for index, name in enumerate(chosen):
            if not finished.has(name):
                progress = PartProgress(reporter, f"audit, {index + 1} of {len(chosen)}: {name}")
                try:
                    finished.keep(name, PARTS[name](subject, seed, progress))
                except KeyboardInterrupt as error:
                    raise Interrupted(finished.folder, None, signal_of(error)) from error
                finally:
                    progress.finish(finished.has(name))
            sections[name], own = finished.take(name)
            pictures |= own
        shown = opened.metrics.wrong_key
        wrong_key = None if shown is None else WrongKeyResult(shown, opened.metrics.chance_level)
        found = Audit(
            keyss=__version__,
            seconds=round(time.monotonic() - started, 1),
            run=_audited_run(opened),
            controls=Controls(controls, subject.seeds),
            wrong_key=wrong_key,
            **sections,
        )
        files = {f"{AUDIT_FOLDER}/{PICTURES}/{name}": data for name, data in pictures.items()}
        there = folder.write(writers({f"{AUDIT_FOLDER}/{AUDIT_FILE}": found, **files}))
        folder.write(writers({REPORT: report_bytes(found, there, stego_in(opened.folder))}))
    return found


def _inputs(subject: AuditSubject, seed: int) -> dict[str, object]:
    """What finished parts depend on."""
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
        width=run.config.width,
        gaussians=len(run.stego),
        photos=run.metrics.photos,
        standard=registry.get(run.config.method).capabilities.standard,
        config=msgspec.json.decode(msgspec.json.encode(run.config.options)),  # as it will be read again
        up=usual_up(cover),
        versions={"python": platform.python_version()} | {name: version_of(name) for name in _LIBRARIES},
    )
