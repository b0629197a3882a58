"""The audit of one hiding: all measures, one after the other, each kept as soon as it is there."""

from __future__ import annotations

import platform
import time
from collections.abc import Sequence
from dataclasses import asdict
from importlib.metadata import version as version_of
from typing import Any

from keyss._version import __version__
from keyss.audit.parts import PARTS
from keyss.audit.progress import PICTURES, Kept, Steps
from keyss.audit.subject import Subject, null_seeds, subject_of
from keyss.core.errors import UsageError
from keyss.files.output import OutputFolder
from keyss.fitting.loop import Interrupted, Reporter, SilentReporter
from keyss.rendering import Backend, resolve_device
from keyss.report import write_report
from keyss.runs.config import PathLike
from keyss.runs.files import bytes_writer, json_writer
from keyss.runs.opening import HidingRun, open_run

AUDIT, FOLDER = "audit.json", "audit"
FORMAT = 1
_LIBRARIES = ("torch", "numpy", "scipy", "scikit-learn", "pot", "gsplat", "numba")


def audit(
    run: PathLike,
    keys: Sequence[str],
    *,
    original: PathLike | None = None,
    null: int = 3,
    only: Sequence[str] = (),
    seed: int = 0,
    device: Backend = "auto",
    overwrite: bool = False,
    resume: bool = False,
    reporter: Reporter | None = None,
) -> dict[str, Any]:
    """Judge a folder that `hide` made, harder than by looking at it; see `keyss.audit.parts`.

    `keys`: those of all its secrets, in any order. `original`: a plain model of the cover, by default the
    run's own. `null`: number of plain models of the cover to compare with, trained from other seeds and kept
    in `private/null/`; at least 2. `only`: names of parts, by default all. The folder gets
    `audit/audit.json`, which is also returned, `audit/pictures/` and `report.html`; while it runs, finished
    parts are kept, and `resume` goes on after them. Raises KeyssError and its children, Interrupted on
    Ctrl-C.
    """
    if null < 2:
        raise UsageError(f"expected at least 2 plain models to compare with, got {null}")
    if unknown := sorted(set(only) - set(PARTS)):
        raise UsageError(f"no such part of an audit: {', '.join(unknown)}; there are {', '.join(PARTS)}")
    started, reporter = time.monotonic(), reporter or SilentReporter()
    opened = open_run(run, keys)
    output = OutputFolder(opened.folder / FOLDER, overwrite=overwrite, resume=resume)
    seeds = null_seeds(opened, null, seed)
    subject = subject_of(opened, original, seeds, resolve_device(device), reporter)
    kept = Kept(output.checkpoints(), _inputs(subject, seeds, seed))
    results: dict[str, Any] = {}
    pictures: dict[str, bytes] = {}
    chosen = [name for name in PARTS if not only or name in only]
    for index, name in enumerate(chosen):
        if not kept.has(name):
            steps = Steps(reporter, f"audit, {index + 1} of {len(chosen)}: {name}")
            try:
                kept.keep(name, PARTS[name](subject, seed, steps))
            except KeyboardInterrupt as error:
                raise Interrupted(kept.folder, index) from error
            finally:
                steps.finish(kept.has(name))
        sections, shown = kept.take(name)
        results |= sections
        pictures |= shown
    found = {
        "version": FORMAT,
        "keyss": __version__,
        "seconds": round(time.monotonic() - started, 1),
        "run": _facts(opened),
        "null": {"models": null, "seeds": seeds},
        "wrong_key": None if opened.metrics.wrong_key is None else asdict(opened.metrics.wrong_key),
        **results,
    }
    writers = {f"{PICTURES}/{name}": bytes_writer(data) for name, data in pictures.items()}
    output.fill({AUDIT: json_writer(found), **writers})
    write_report(opened.folder)
    return found


def _inputs(subject: Subject, seeds: Sequence[int], seed: int) -> dict[str, Any]:
    """What finished parts depend on."""
    return {
        "payloads": [secret.fingerprint() for secret in subject.run.opened],
        "stego": subject.stego.digest(),
        "original": subject.original.digest(),
        "scenes": [scene.digest() for scene in subject.scenes],
        "seeds": [*seeds, seed],
        "version": __version__,
    }


def _facts(run: HidingRun) -> dict[str, Any]:
    cover, *secrets = run.sources
    return {
        "path": str(run.folder),
        "method": run.config.method,
        "cover": cover,
        "secrets": secrets,
        "width": run.config.width,
        "gaussians": len(run.stego),
        "config": asdict(run.config.options),
        "versions": {"python": platform.python_version()} | {name: version_of(name) for name in _LIBRARIES},
    }
