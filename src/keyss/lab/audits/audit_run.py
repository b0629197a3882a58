"""The audit of a run: measures part by part, and stores each result at once in `audit/audit.json`."""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from keyss.core import InputError, Interrupted, UsageError, import_extra
from keyss.files import write_bytes
from keyss.lab.audits.parts import PARTS, Part
from keyss.lab.audits.record import Audit
from keyss.lab.audits.report import report_of
from keyss.lab.audits.subject import Subject
from keyss.methods import registry
from keyss.progress import Reporter, reporter as default_reporter
from keyss.rendering import Backend, resolve_device
from keyss.runs import read_record, write_record
from keyss.runs.estimates import seconds_for
from keyss.runs.files import REPORT, PathLike, run_folder, stego_in
from keyss.runs.folder import PRIVATE, RunFolder, read_manifest
from keyss.runs.open_run import open_run, read_run

AUDIT, PICTURES = f"{PRIVATE}/audit/audit.json", f"{PRIVATE}/audit/pictures"  # relative to the run
EXTRA = ("ot", "sklearn")
KEPT = ("scenes", "hide", "demo", "controls")  # stages of a run whose files an audit keeps


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
    `private/report.md`. Other parts of an earlier audit with the same controls stay. The same call continues
    an interrupted audit after its finished parts. Raises KeyssError (BackendError without the extra `audit`)
    and KeyboardInterrupt.
    """
    if controls < 2:
        raise UsageError(f"expected at least 2 plain models to compare with, got {controls}")
    for module in EXTRA:
        import_extra(module, "audit", "audit a run")
    _, config, *_ = read_run(Path(run))
    parts = _chosen(only, config.method)
    started, reporter = time.monotonic(), reporter or default_reporter()
    with reporter.waiting("opening the secrets", len(keys) * seconds_for("reveal", stego_in(Path(run)))):
        opened = open_run(run, keys)
    subject = Subject(opened, resolve_device(device))
    settings = {"controls": controls, "only": only, "seed": seed, "device": subject.device.type}
    fit = opened.config.options.fit
    seeds = tuple(fit.seed_of(f"control {seed + index}") for index in range(controls))
    earlier = _earlier(opened.folder, seeds)
    adds = earlier is not None and not earlier.sections.keys() & parts.keys()
    running = read_manifest(opened.folder).running
    resume = running is not None and running.stage == "audit" and not overwrite
    folder = RunFolder(
        opened.folder,
        "audit",
        settings | {"payloads": opened.config.payloads},
        onto=KEPT,
        writes=(AUDIT, REPORT),
        overwrite=overwrite or (adds and running is None),
        resume=resume,
    )
    with folder.work():
        try:
            subject.fit_controls(seeds, folder, reporter)
        except Interrupted as error:  # its message says how to resume a fit
            raise KeyboardInterrupt(*error.args) from error
        record, pictures = folder.checkpoints / "audit.json", folder.checkpoints / "pictures"
        cover, *secrets = opened.sources
        result = Audit(
            method=opened.config.method,
            cover=cover,
            secrets=tuple(secrets),
            width=opened.config.views.width,
            gaussians=len(opened.stego),
            controls=seeds,
        )
        if earlier:
            kept = {name: part for name, part in earlier.sections.items() if name not in parts}
            result = replace(result, seconds=earlier.seconds, sections=kept)
        if record.exists():
            result = read_record(record, Audit)
        for number, (name, part) in enumerate(parts.items(), start=1):
            if name in result.sections:
                continue
            seconds = part.work.time(subject.view_seconds, len(subject.stego))
            with reporter.waiting(f"audit, {number} of {len(parts)}: {name}", seconds) as share:
                section, shown = part.measure(subject, seed, share)
            pictures.mkdir(exist_ok=True)
            names = {caption: f"{name}-{index}.png" for index, caption in enumerate(shown, start=1)}
            for caption, file in names.items():
                write_bytes(pictures / file, shown[caption])
            section = replace(section, pictures=names)
            result = replace(result, sections=result.sections | {name: section})
            write_record(record, result)
        sections = {name: result.sections[name] for name in PARTS if name in result.sections}
        seconds = round(result.seconds + time.monotonic() - started, 1)
        result = replace(result, sections=sections, seconds=seconds)
        folders = [opened.folder / PICTURES, pictures] if earlier else [pictures]
        files = [path for each in folders for path in each.glob("*.png")]  # new ones last
        contents = {f"{PICTURES}/{path.name}": path.read_bytes() for path in files}
        report = report_of(result, PICTURES.removeprefix(f"{PRIVATE}/"))
        folder.write({AUDIT: result, REPORT: report.encode(errors="replace"), **contents})
    return result


def _earlier(run: Path, controls: tuple[int, ...]) -> Audit | None:
    """The finished audit of a run with these controls, if there is one."""
    with suppress(InputError):
        found = read_audit(run)
        return found if found.controls == controls else None
    return None


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
