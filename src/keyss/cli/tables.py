"""Final output of commands."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, TextIO

from rich.cells import cell_len
from rich.console import Console as RichConsole
from rich.table import Table
from rich.text import Text

from keyss.progress import about, clock
from keyss.runs.json_records import record_bytes

if TYPE_CHECKING:
    from keyss.api.convert import Conversion
    from keyss.methods.base import Plan
    from keyss.runs.describe import ModelInfo, RunInfo, SceneInfo
    from keyss.runs.planning import Cost
    from keyss.runs.revealing import Verification
    from keyss.runs.run_records import FitMetrics, HideMetrics


_HEADS = ("PSNR", "SSIM", "LPIPS", "bound", "loss", "start", "Gaussians", "plain", "steps")


class Console(RichConsole):
    """Passes broken pipes on to the entry point."""

    def on_broken_pipe(self) -> None:
        raise  # the BrokenPipeError that is being handled


def print_hiding(metrics: HideMetrics, console: Console | None = None, *, brief: bool = False) -> None:
    """Print the measurements of a hiding: a row per scene, then the rest unless `brief`."""
    names = ["cover", "secret"]
    if len(metrics.secrets) > 1:
        names = ["cover", *(f"secret {number}" for number, _ in enumerate(metrics.secrets, start=1))]
    rows = _scene_rows(metrics)
    heads = [head for head in _HEADS if any(head in row for row in rows)]
    views, first = "on test photos", names
    if not any(metrics.photos):
        views = "on renders of the given models"
    elif not all(metrics.photos):
        first = [name + " (renders)" * (not shown) for name, shown in zip(names, metrics.photos, strict=True)]
    table = [[name, *(row.get(head, "") for head in heads)] for name, row in zip(first, rows, strict=True)]
    console = console or Console()
    print_table([views, *heads], table, console=console)
    for line in _lines_on_files(metrics, names) if brief else _explanations(metrics, names, heads):
        console.print(line, highlight=False, markup=False)
    if brief:
        return
    for name, unit in {"capacity": "Gaussians", "capacity_bytes": "bytes"}.items():
        if name in metrics.details:
            console.print(f"Capacity of the cover: {metrics.details[name]:,} {unit}.", highlight=False)


def _scene_rows(metrics: HideMetrics) -> list[dict[str, str]]:
    """A row for the cover and each secret, by the heads of its columns."""
    baseline, unknown = metrics.baseline, (None,) * len(metrics.photos)
    sizes = [metrics.gaussians, *metrics.secret_gaussians]
    rows = []
    for photos, own, plain, equal, size, plain_size, steps in zip(
        metrics.photos,
        [metrics.cover, *metrics.secrets],
        [baseline.cover, *baseline.secrets],
        baseline.equal or unknown,
        sizes,
        baseline.gaussians,
        metrics.steps or unknown,
        strict=True,
    ):
        row = {"PSNR": f"{own.psnr:.2f}", "SSIM": f"{own.ssim:.3f}"}
        if own.lpips is not None:
            row["LPIPS"] = f"{own.lpips:.3f}"
        row["Gaussians"] = f"{size:,}"
        if not photos:  # test views are renders of the given model: no upper bound
            plain = steps = None
        if steps is not None:
            row["steps"] = f"{steps:,}"
        if plain is not None and equal:
            row |= {"bound": f"{plain.psnr:.2f}", "loss": f"{plain.psnr - own.psnr:z.2f}"}
        elif plain is not None:
            row["start"] = f"{plain.psnr:.2f}"
        if plain_size and _sizes_differ(metrics):
            row["plain"] = f"{plain_size:,}"
        rows.append(row)
    return rows


def _sizes_differ(metrics: HideMetrics, tolerance: float = 0.0) -> bool:
    """True if numbers of Gaussians of a scene and its plain model differ by more than a `tolerance` share."""
    sizes = zip([metrics.gaussians, *metrics.secret_gaussians], metrics.baseline.gaussians, strict=True)
    return any(plain is not None and abs(plain - own) > tolerance * own for own, plain in sizes)


def print_plan(method: str, plan: Plan, cost: Cost) -> None:
    """Print capacity and estimates of a run."""
    steps = f", {cost.steps:,} training steps" if cost.steps else ""
    _print_columns(
        [
            ("method", method),
            ("capacity", f"{plan.capacity:,} of the secrets' {plan.secret_gaussians:,} Gaussians"),
            (
                "published",
                f"up to {plan.gaussians:,} Gaussians of SH degree {plan.sh_degree}, {plan.megabytes:,.1f} MB",
            ),
            ("time", f"about {about(cost.seconds)}{steps}"),
            ("memory", f"about {cost.memory_bytes / 1e9:.1f} GB"),
            ("disk", f"up to {cost.disk_bytes / 1e6:,.0f} MB at once, checkpoints included"),
            *(("note", note) for note in plan.notes),
        ]
    )
    print("Dry run: nothing was written. Times are rough.")


def _explanations(metrics: HideMetrics, names: Sequence[str], heads: Sequence[str]) -> list[str]:
    """A line for each term of the table of a hiding."""
    lines = ["PSNR in dB." + " LPIPS with AlexNet: lower is better." * ("LPIPS" in heads)]
    size = "as many Gaussians"
    if _sizes_differ(metrics):
        size = "its own number of Gaussians" if _sizes_differ(metrics, 0.02) else "about as many Gaussians"
    if "plain" in heads:
        lines.append("Plain: Gaussians of the plain model.")
    if "bound" in heads:
        lines.append(f"Bound: upper bound, plain 3DGS with {size} and the same steps.")
    if "start" in heads:
        baseline = metrics.baseline
        pairs = zip(baseline.steps, baseline.equal, strict=False)
        shorter = {steps for steps, equal in pairs if steps is not None and not equal}
        fewer = " or ".join(f"{steps:,}" for steps in sorted(shorter)) or "fewer"
        lines.append(
            f"Start: PSNR of a plain model with {size} and {fewer} training steps, no upper bound; `keyss "
            "hide --bound` fits one."
        )
    if (wrong := metrics.wrong_key) is not None:
        highest = (
            f"{each.max:.2f} to the {name}" for name, each in zip(names[1:], wrong.vs_secrets, strict=True)
        )
        cover = f"{wrong.vs_cover.mean:.2f} to the cover, at least {wrong.vs_cover.min:.2f}"
        lines.append(f"PSNR of {wrong.keys} wrong keys: on average {cover}; at most {', '.join(highest)}.")
    if metrics.chance_level:
        chance = ", ".join(f"{each:.2f}" for each in metrics.chance_level)
        lines.append(
            f"Chance level: {chance}, PSNR of the stego model itself to the secret; no wrong key should "
            "exceed it."
        )
    return lines + _lines_on_files(metrics, names)


def _lines_on_files(metrics: HideMetrics, names: Sequence[str]) -> list[str]:
    """A line on the published file, and one on each secret that lost something."""
    lines = []
    reached = (f"{name} {each.psnr:.1f}" for name, each in zip(names, metrics.against_plain, strict=True))
    lines.append(f"Revealed from the published file, PSNR to the plain models: {', '.join(reached)} dB.")
    kept = zip(
        names[1:],
        metrics.secret_gaussians,
        metrics.baseline.gaussians[1:],
        metrics.secret_degrees or [(0, 0)] * len(metrics.secrets),
        metrics.against_plain[1:],
        strict=True,
    )
    for name, count, before, (degree, full), each in kept:
        if degree == full and before in (None, count):
            continue
        of = f" of {before:,}" if before and before >= count else ""
        cut = f", SH degree {degree} of {full}" if degree < full else ""
        lines.append(f"The {name} kept {count:,}{of} Gaussians{cut}, {each.psnr:.1f} dB.")
    return lines


def print_fit(metrics: FitMetrics) -> None:
    """Print the numbers of a plain fit."""
    quality = {"PSNR": f"{metrics.psnr:.2f}", "SSIM": f"{metrics.ssim:.3f}"}
    if metrics.lpips is not None:
        quality["LPIPS"] = f"{metrics.lpips:.3f}"
    sizes = (f"{metrics.gaussians:,}", f"{metrics.iterations:,}", f"{metrics.seconds:.0f}")
    print_table((*quality, "Gaussians", "iterations", "seconds"), [(*quality.values(), *sizes)], texts=0)


def print_info(found: RunInfo | ModelInfo | SceneInfo) -> None:
    """Print the description of `keyss info`."""
    from keyss.runs.describe import RunInfo

    if not isinstance(found, RunInfo):
        _print_columns([(name.replace("_", " "), _text(value)) for name, value in vars(found).items()])
        return
    from keyss.runs.run_records import HideMetrics

    metrics = found.metrics
    how = f" by the method {metrics.method}" if isinstance(metrics, HideMetrics) else ""
    # Without separators, a seed can be given to --seed.
    print(f"{found.path}: {found.kind}{how}, made in {clock(metrics.seconds)} with --seed {metrics.seed}")
    if isinstance(metrics, HideMetrics):
        print_hiding(metrics)
    else:
        print_fit(metrics)


def print_verification(found: Verification) -> None:
    """Print the findings of `keyss verify`."""
    model, secret, what = found.model, found.secret, "not checked, as no key was given"
    problems = "; ".join(model.problems) or "sound"
    if secret is not None:
        of = f" of {secret.hidden:,}" if secret.hidden else ""
        what = f"{secret.found:,}{of} {secret.unit}: {'; '.join(secret.problems) or 'complete'}"
    about_model = f"{model.gaussians:,} Gaussians of SH degree {model.sh_degree}: {problems}"
    _print_columns([("model", about_model), ("secret", what)])


def print_conversion(out: str, found: Conversion, *, dry_run: bool, file: TextIO) -> None:
    """Print the cost of a conversion: size, PSNR of renders, and the parts of secrets that are left."""
    was = "" if found.bytes_before is None else f", {_size(found.bytes_before)} before"
    renders = "renders unchanged" if found.psnr >= 120 else f"renders at {found.psnr:.1f} dB PSNR"
    if math.isnan(found.psnr):
        renders = "renders are empty: the model is invisible"
    print(f"{out}: {len(found.gaussians):,} Gaussians, {_size(found.bytes_after)}{was}, {renders}", file=file)
    if out.lower().endswith(".spz"):
        print(
            "y is up in an .spz, as Niantic's library and splat-transform 2 write it; programs that do not "
            "turn it (splat-transform 3) show it upside down",
            file=file,
        )
    for number, secret in enumerate(found.secrets, 1):
        which = "the secret" if len(found.secrets) == 1 else f"the secret of key {number}"
        state = "survives" if secret.kept else f"is lost: {secret.after:,} {secret.unit} are left"
        print(f"{which}, {secret.before:,} {secret.unit}, {state}", file=file)
    from keyss.channels import AppendedReader  # imports torch

    if not found.secrets and not found.keeps_low_bits and AppendedReader.of(found.gaussians) is None:
        print("a secret in low bits would be lost; --key-file checks that a secret survives", file=file)
    if dry_run:
        print("dry run: nothing was written", file=file)


def print_json(facts: object) -> None:
    """Print a record as JSON, in ASCII if the standard output cannot encode it."""
    text = record_bytes(facts).decode()
    try:
        text.encode(sys.stdout.encoding or "utf-8")
    except UnicodeEncodeError:
        text = json.dumps(json.loads(text), indent=2) + "\n"
    print(text, end="")


def _size(count: int) -> str:
    return f"{count / 1e6:,.1f} MB" if count >= 1e6 else f"{count / 1e3:,.1f} kB"


def print_files(folder: Path, names: Mapping[str, str]) -> None:
    """Print paths and descriptions of the results that exist."""
    _print_columns([(str(folder / name), text) for name, text in names.items() if (folder / name).exists()])


def _print_columns(rows: Sequence[tuple[str, str]]) -> None:
    """Print two columns of plain text. Paths are never wrapped."""
    width = max((len(name) for name, _ in rows), default=0)
    for name, text in rows:
        print(f"{name:<{width}}  {text}")


def print_table(
    heads: Sequence[str], rows: Iterable[Sequence[str]], *, texts: int = 1, console: Console | None = None
) -> None:
    """Print a table; its first `texts` columns are aligned left, the others hold numbers.

    Cells wrap between words. If the terminal is too narrow, each row becomes a list.
    """
    console, rows = console or Console(), list(rows)
    columns = list(zip(heads, *rows, strict=True))
    needed = [max(cell_len(word) for cell in cells for word in cell.split() or [""]) for cells in columns]
    widths = [max(map(cell_len, cells)) for cells in columns]
    gaps = 2 * (len(heads) - 1)
    if sum(needed) + gaps > console.width:
        for row in rows:
            for head, cell in zip(heads, row, strict=True):
                console.print(f"{head}: {cell}", highlight=False, markup=False)
            console.print()
        return
    while sum(widths) + gaps > console.width:
        widths[
            max(range(len(widths)), key=lambda index: (widths[index] > needed[index]) * widths[index])
        ] -= 1
    table = Table(box=None, pad_edge=False, header_style="bold", padding=(0, 2, 0, 0))
    for index, (head, width) in enumerate(zip(heads, widths, strict=True)):
        table.add_column(head, justify="left" if index < texts else "right", width=width)
    for row in rows:
        table.add_row(*map(Text, row))
    console.print(table)


def _text(value: object) -> str:
    match value:
        case None:
            return "none"
        case bool():
            return "yes" if value else "no"
        case int():
            return f"{value:,}"
        case float():
            return f"{value:.4g}"
        case list() | tuple():
            return ", ".join(_text(item) for item in value) or "none"
    return str(value)
