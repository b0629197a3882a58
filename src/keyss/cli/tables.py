"""Final output of commands."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console as RichConsole
from rich.table import Table
from rich.text import Text

from keyss import progress
from keyss.files.inputs import is_standard
from keyss.methods.method import role_of
from keyss.progress import clock
from keyss.runs.json_records import record_bytes

if TYPE_CHECKING:
    from keyss.api.convert import Conversion
    from keyss.fitting.image_metrics import ImageQuality
    from keyss.runs.describe import InterruptedRun, ModelInfo, RunInfo, SceneInfo
    from keyss.runs.planning import Cost
    from keyss.runs.revealing import Verification
    from keyss.runs.run_records import FitMetrics, HideMetrics


# Columns of the table of a hiding, with what its legend says of them.
_HEADS = {
    "PSNR": "PSNR in dB",
    "SSIM": "SSIM: 1 if equal",
    "LPIPS": "LPIPS (AlexNet): lower is better",
    "bound": "bound: PSNR of plain 3DGS with the same steps",
    "loss": "loss: bound - PSNR",
    "start": "start: PSNR of a plain model with fewer steps, no bound (`keyss hide --bound` fits one)",
    "Gaussians": "",
    "plain": "plain: Gaussians of the plain model",
    "steps": "steps: training steps",
}
# What `info` says of a number: {0} is its text, {1} the number.
_MEANINGS = {
    "bounding_box": "{0}: two corners, in the model's units",
    "nearly_transparent": "{1:.0%} of the Gaussians, those with opacities below 0.05",
    "extent": "{0}: distance of the farthest camera from their middle plus a tenth, in the scene's units",
}
_ROUNDED = 20 * math.log10(255 * math.sqrt(12))  # PSNR of the error of rounding to 8 bits
_SHOWS = 1.0  # dB below the secret at which a wrong key shows as much
_HARMS = 2.0  # dB that wrong keys may cost the cover


class Console(RichConsole):
    """Passes broken pipes on to the entry point."""

    def on_broken_pipe(self) -> None:
        raise  # the BrokenPipeError that is being handled


def print_hiding(metrics: HideMetrics, *, brief: bool = False) -> None:
    """Print the measurements of a hiding: a row per scene, then the rest unless `brief`."""
    count = len(metrics.photos)
    names = [role_of(index, count) for index in range(count)]
    rows = _scene_rows(metrics)
    heads = [head for head in _HEADS if any(head in row for row in rows)]
    views, first = "on renders of the given models", names
    if any(metrics.photos):
        views = "on test photos"
        first = [name + " (renders)" * (not shown) for name, shown in zip(names, metrics.photos, strict=True)]
    table = [[name, *(row.get(head, "") for head in heads)] for name, row in zip(first, rows, strict=True)]
    print_table([views, *heads], table)
    wrong_keys = [] if brief else _lines_on_wrong_keys(metrics, names)
    rounded = ""
    if not all(metrics.photos):
        rounded = f" Renders that differ only by rounding to 8 bits have {_ROUNDED:.0f} dB or more."
    lines = [_legend(heads) + rounded, *wrong_keys, *_lines_on_files(metrics, names)]
    if not brief:
        units = {"capacity": "Gaussians", "capacity_bytes": "bytes"}
        capacities = {unit: metrics.details[name] for name, unit in units.items() if name in metrics.details}
        lines += [f"Capacity of the cover: {number:,} {unit}." for unit, number in capacities.items()]
    for line in lines:
        print(line)


def _scene_rows(metrics: HideMetrics) -> list[dict[str, str]]:
    """A row for the cover and each secret, by the heads of its columns."""
    baseline, rows = metrics.baseline, []
    for photos, quality, plain, equal, size, plain_size, steps in zip(
        metrics.photos,
        [metrics.cover, *metrics.secrets],
        [baseline.cover, *baseline.secrets],
        baseline.equal,
        [metrics.gaussians, *metrics.secret_gaussians],
        baseline.gaussians,
        metrics.steps,
        strict=True,
    ):
        row = _quality(quality) | {"Gaussians": f"{size:,}"}
        if plain_size not in (None, size):
            row["plain"] = f"{plain_size:,}"
        if photos and steps is not None:  # renders of a given model have no upper bound
            row["steps"] = f"{steps:,}"
        if photos and plain is not None and equal:
            row |= {"bound": f"{plain.psnr:.2f}", "loss": f"{plain.psnr - quality.psnr:z.2f}"}
        elif photos and plain is not None:
            row["start"] = f"{plain.psnr:.2f}"
        rows.append(row)
    return rows


def _legend(heads: Iterable[str]) -> str:
    return "; ".join(text for head in heads if (text := _HEADS.get(head))) + "."


def _quality(of: ImageQuality) -> dict[str, str]:
    """Cells by the heads of their columns."""
    lpips = {} if of.lpips is None else {"LPIPS": f"{of.lpips:.3f}"}
    return {"PSNR": f"{of.psnr:.2f}", "SSIM": f"{of.ssim:.3f}"} | lpips


def print_cost(cost: Cost, rows: Sequence[tuple[str, str]] = (), notes: Iterable[str] = ()) -> None:
    """Print estimates of a run, between `rows` and `notes` on it."""
    of = [f"{role_of(index, len(cost.steps))} {steps:,}" for index, steps in enumerate(cost.steps)]
    if len(of) == 1:  # a fit has no roles
        of = [f"{cost.steps[0]:,}"]
    print_columns(
        [
            *rows,
            *([("training", f"steps: {', '.join(of)}")] if any(cost.steps) else []),
            ("cost", str(cost)),
            *(("note", note) for note in notes),
        ]
    )
    print("Dry run: nothing was written. Times are rough.")


def _lines_on_wrong_keys(metrics: HideMetrics, names: Sequence[str]) -> list[str]:
    """For methods with a decoder, lines on wrong keys and chance."""
    if (wrong := metrics.wrong_key) is None:
        return []
    pairs = zip(names[1:], wrong.vs_secrets, strict=True)
    highest = ", ".join(f"{psnrs.max:.2f} to the {name}" for name, psnrs in pairs)
    cover = f"{wrong.vs_cover.mean:.2f} to the cover, at least {wrong.vs_cover.min:.2f}"
    chance = ", ".join(f"{psnr:.2f}" for psnr in metrics.chance_level)
    scenes = zip(names[1:], wrong.vs_secrets, metrics.secrets, strict=True)
    cost = metrics.cover.psnr - wrong.vs_cover.mean
    unlearnt = [name for name, psnrs, quality in scenes if psnrs.max > quality.psnr - _SHOWS]
    return [
        f"PSNR of {wrong.keys} wrong keys: on average {cover}; at most {highest}.",
        f"Chance level: {chance}, the published model's PSNR to the secret; `keyss audit` judges by it.",
        *(f"Wrong keys show as much of the {name} as its key: train longer." for name in unlearnt),
        *([f"Wrong keys cost the cover {cost:.1f} dB: train longer."] if cost > _HARMS else []),
    ]


def _lines_on_files(metrics: HideMetrics, names: Sequence[str]) -> list[str]:
    """A line on each secret that lost something."""
    lines = []
    kept = zip(
        names[1:],
        metrics.secret_gaussians,
        metrics.baseline.gaussians[1:],
        metrics.secret_degrees,
        strict=True,
    )
    for name, count, before, (degree, full) in kept:
        if degree == full and before in (None, count):
            continue
        of = f" of {before:,}" if before and before >= count else ""
        cut = f", SH degree {degree} of {full}" if degree < full else ""
        subject = f"The {name}" if len(names) == 2 else name.capitalize()
        lines.append(f"{subject} kept {count:,}{of} Gaussians{cut}.")
    return lines


def print_fit(metrics: FitMetrics) -> None:
    """Print the numbers of a plain fit."""
    row = _quality(metrics) | {"Gaussians": f"{metrics.gaussians:,}", "steps": f"{metrics.iterations:,}"}
    row["seconds"] = f"{metrics.seconds:.0f}"
    print_table(["on test photos", *row], [["plain model", *row.values()]])
    print(_legend(row))


def print_info(described: RunInfo | InterruptedRun | ModelInfo | SceneInfo) -> None:
    """Print the description of `keyss info`."""
    from keyss.runs.describe import RunInfo

    if not isinstance(described, RunInfo):
        facts = {name: value for name, value in vars(described).items() if value is not None}
        capacity = facts.pop("capacity", ())
        rows = [
            (name.replace("_", " "), _MEANINGS.get(name, "{0}").format(_text(value), value))
            for name, value in facts.items()
        ]
        print_columns([*rows, *(("capacity", line) for line in capacity)])
        if "bounding_box" in facts and not capacity:
            print("`keyss info --capacity` says what it can hide, and `keyss verify` checks it.")
        return
    from keyss.runs.run_records import HideMetrics

    metrics = described.metrics
    how = f" by the method {metrics.method}" if isinstance(metrics, HideMetrics) else ""
    # Without separators, a seed can be given to --seed.
    made = f"made in {clock(metrics.seconds)} with --seed {metrics.seed}"
    print(f"{described.path}: {described.kind}{how}, {made}")
    if isinstance(metrics, HideMetrics):
        print_hiding(metrics)
    else:
        print_fit(metrics)


def print_verification(checked: Verification) -> None:
    """Print the findings of `keyss verify`."""
    model, rows = checked.model, []
    problems = "; ".join(model.problems) or "sound"
    for number, secret in enumerate(checked.secrets, 1):
        of = f" of {secret.hidden:,}" if secret.hidden else ""
        what = f"{secret.found:,}{of} {secret.unit}: {'; '.join(secret.problems) or 'complete'}"
        rows.append(("secret" if len(checked.secrets) == 1 else f"secret of key {number}", what))
    about_model = f"{model.gaussians:,} Gaussians of SH degree {model.sh_degree}: {problems}"
    print_columns([("model", about_model), *(rows or [("secret", "not checked, as no key was given")])])


def print_conversion(out: Path, conversion: Conversion, *, dry_run: bool) -> None:
    """Print the cost of a conversion: size, PSNR of renders, and the parts of secrets that are left."""
    file = sys.stderr if is_standard(out) else sys.stdout
    if progress.level < 0 and not dry_run:
        print(out, file=file)
        return
    was = "" if conversion.bytes_before is None else f", {_size(conversion.bytes_before)} before"
    renders = "renders the same" if conversion.psnr >= 120 else f"renders at {conversion.psnr:.1f} dB PSNR"
    if math.isnan(conversion.psnr):
        renders = "renders are empty: the model is invisible"
    size = f"{_size(conversion.bytes_after)}{was}"
    print(f"{_name(out)}: {len(conversion.gaussians):,} Gaussians, {size}, {renders}", file=file)
    for number, secret in enumerate(conversion.secrets, 1):
        which = "the secret" if len(conversion.secrets) == 1 else f"the secret of key {number}"
        state = "survives" if secret.kept else f"is lost: {secret.after:,} {secret.unit} are left"
        print(f"{which}, {secret.before:,} {secret.unit}, {state}", file=file)
    if not conversion.secrets and not conversion.keeps_low_bits:
        state = "would be" if dry_run else "are"
        print(f"secrets of --publish unchanged, if any, {state} lost; --key-file checks one", file=file)
    if dry_run:
        print("dry run: nothing was written", file=file)


def print_json(facts: object) -> None:
    """Print a record as JSON, in ASCII."""
    print(json.dumps(json.loads(record_bytes(facts)), indent=2))


def _size(count: int) -> str:
    return f"{count / 1e6:,.1f} MB" if count >= 1e6 else f"{count / 1e3:,.1f} kB"


def print_files(folder: Path, names: Mapping[str, str]) -> None:
    """Print paths and descriptions of the results that exist."""
    results = [(str(folder / name), text) for name, text in names.items() if (folder / name).exists()]
    if progress.level < 0:
        print(*(path for path, _ in results), sep="\n")
    else:
        print_columns(results)


def print_written(path: Path, text: str) -> None:
    """Print the path and the description of one result, to the standard error stream if it went to stdout."""
    print(
        path if progress.level < 0 else f"{_name(path)}: {text}",
        file=sys.stderr if is_standard(path) else sys.stdout,
    )


def _name(path: Path) -> str:
    return "standard output" if is_standard(path) else str(path)


def print_columns(rows: Sequence[tuple[str, str]]) -> None:
    """Print two columns of plain text. Paths are never wrapped."""
    width = max((len(name) for name, _ in rows), default=0)
    for name, text in rows:
        print(f"{name:<{width}}  {text}")


def print_table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """Print a table; its first column is aligned left, the others hold numbers.

    Cells wrap between words. If the terminal is too narrow, each row becomes a list.
    """
    console, rows = Console(), list(rows)
    table = Table(box=None, pad_edge=False, header_style="bold", padding=(0, 2, 0, 0))
    for index, head in enumerate(heads):
        table.add_column(head, justify="right" if index else "left", overflow="fold")
    for row in rows:
        table.add_row(*map(Text, row))
    unlimited = console.options.update(max_width=10**6)
    if console.measure(table, options=unlimited).minimum <= console.width:
        console.print(table)
        return
    for row in rows:
        for head, cell in zip(heads, row, strict=True):
            console.print(f"{head}: {cell}", highlight=False, markup=False)
        console.print()


def _text(value: object) -> str:
    match value:
        case tuple():
            return ", ".join(map(_text, value))
        case int():
            return f"{value:,}"
        case float():
            return f"{value:.4g}"
    return str(value)
