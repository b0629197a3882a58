"""What commands print when they are done."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

from rich.console import Console as RichConsole
from rich.table import Table
from rich.text import Text

from keyss.core.errors import InputError
from keyss.progress import about
from keyss.runs.records import record_bytes

if TYPE_CHECKING:
    from keyss.api.converting import Conversion
    from keyss.fitting.image_metrics import ImageQuality
    from keyss.many import Comparison, Forecast, ManyResult
    from keyss.measure.stegexpose import Steganalysis
    from keyss.methods.plan import Plan
    from keyss.runs.metrics import FitMetrics, HideMetrics


_GAP = 2  # characters between columns


class Console(RichConsole):
    """Leaves broken pipes to the entry point."""

    def on_broken_pipe(self) -> None:
        raise  # the BrokenPipeError that is being handled


def print_hiding(metrics: HideMetrics, console: Console | None = None) -> None:
    """The numbers of a hiding: a row for each scene beside its baseline, wrong keys, the method's own."""
    numbers = [f" {i}" for i in range(1, len(metrics.secrets) + 1)] if len(metrics.secrets) > 1 else [""]
    names = ["cover", *(f"secret{number}" for number in numbers)]
    found = [metrics.cover, *metrics.secrets]
    plain = [metrics.baseline.cover, *metrics.baseline.secrets]
    sizes = list(zip([metrics.gaussians, *metrics.secret_gaussians], metrics.baseline.gaussians, strict=True))
    differ = any(other not in (own, None) for own, other in sizes)
    equal = metrics.baseline.equal or (False,) * len(names)
    shorter = [not same and other is not None for same, other in zip(equal, plain, strict=True)]
    trained = metrics.steps or (None,) * len(names)
    before = metrics.baseline.steps or (None,) * len(names)
    rows = [
        _scene_row(name, own, other, less, size, others if differ else None, steps, fewer)
        for name, own, other, less, (size, others), steps, fewer in zip(
            names, found, plain, shorter, sizes, trained, before, strict=True
        )
    ]
    psnrs = []
    if (wrong := metrics.wrong_key) is not None:
        psnrs += [(f"{wrong.keys} wrong keys, mean to the cover", wrong.vs_cover.mean)]
        psnrs += [("  lowest to the cover", wrong.vs_cover.min)]
        psnrs += [
            (f"  highest to the secret{number}", found.max)
            for number, found in zip(numbers, wrong.vs_secrets, strict=True)
        ]
    psnrs += [
        (f"chance level of the secret{number}", level)
        for number, level in zip(numbers, metrics.chance_level, strict=True)
    ]
    rows += [[name, f"{psnr:.2f}", *[""] * 7] for name, psnr in psnrs]
    heads = ("on test views", "PSNR", "SSIM", "bound", "loss", "start", "Gaussians", "plain's", "steps")
    filled = [column for column in zip(heads, *rows, strict=True) if any(column[1:])]
    table = new_table(*(head for head, *_ in filled), texts=1)
    for row in zip(*(cells for _, *cells in filled), strict=True):
        table.add_row(*row)
    console = console or Console()
    console.print(table)
    for line in _explanations(metrics, names, differ, shorter):
        console.print(line, highlight=False, markup=False, soft_wrap=True)
    for name, value in metrics.details.items():
        console.print(f"{name.replace('_', ' ')}: {_text(value)}", highlight=False, markup=False)


def print_plan(plan: Plan) -> None:
    """Stages, room and estimates of a run that has not begun."""
    table = new_table("stage", "steps", "Gaussians", "time, about", texts=1)
    for stage in plan.stages:
        steps = f"{stage.steps:,}" if stage.steps else ""
        table.add_row(stage.name, steps, f"{stage.gaussians:,}", about(stage.seconds))
    table.add_row("all", "", "", about(plan.seconds))
    Console().print(table)
    free = "" if plan.free_bytes is None else f", {plan.free_bytes / 1e6:,.0f} MB free"
    _print_columns(
        [
            ("method", plan.method),
            ("room", f"{plan.capacity:,} of the secrets' {plan.asked:,} Gaussians"),
            (
                "published",
                f"up to {plan.gaussians:,} Gaussians of SH degree {plan.sh_degree}, "
                f"{plan.file_bytes / 1e6:,.1f} MB",
            ),
            ("memory", f"about {plan.memory_bytes / 1e9:.1f} GB"),
            ("disk", f"up to {plan.disk_bytes / 1e6:,.0f} MB at once, checkpoints included{free}"),
            *(("note", note) for note in plan.notes),
        ]
    )
    print("Dry run: nothing was written. Times are rough.")


def _explanations(
    metrics: HideMetrics, names: Sequence[str], sizes_differ: bool, shorter: Sequence[bool]
) -> list[str]:
    """A line for each term of the table of a hiding."""
    rendered = [name for name, photos in zip(names, metrics.photos, strict=True) if not photos]
    views = "photos held out of training"
    if len(rendered) == len(names):
        views = "8-bit renders of the given models"
    elif rendered:
        views += f"; for {', '.join(rendered)} 8-bit renders of the given model"
    lines = [f"Test views: {views}. PSNR, bound, loss and start in dB."]
    sizes = zip([metrics.gaussians, *metrics.secret_gaussians], metrics.baseline.gaussians, strict=True)
    near = all(other is None or abs(other - own) <= 0.02 * own for own, other in sizes)
    size = "about as many Gaussians" if near else "its own number of Gaussians"
    size = size if sizes_differ else "as many Gaussians"
    plain = [metrics.baseline.cover, *metrics.baseline.secrets]
    if any(each is not None and not less for each, less in zip(plain, shorter, strict=True)):
        lines.append(f"Bound: plain 3DGS of {size} and as many training steps.")
    if any(shorter):
        lines.append(
            f"Start: a plain model of {size} and fewer training steps, which is no bound; `keyss hide "
            "--bound` fits one."
        )
    if metrics.chance_level:
        lines.append(
            "Chance level: PSNR of the stego model itself to the secret; no wrong key should exceed it."
        )
    reached = (f"{name} {each.psnr:.1f}" for name, each in zip(names, metrics.against_plain, strict=True))
    lines.append(f"Revealed from the published file, PSNR to the plain models: {', '.join(reached)} dB.")
    return lines


def print_fit(metrics: FitMetrics) -> None:
    """The numbers of a plain fit."""
    table = new_table("PSNR", "SSIM", "Gaussians", "iterations", "seconds")
    sizes = (f"{metrics.gaussians:,}", f"{metrics.iterations:,}", f"{metrics.seconds:.0f}")
    table.add_row(f"{metrics.psnr:.2f}", f"{metrics.ssim:.3f}", *sizes)
    Console().print(table)


def print_steganalysis(found: Steganalysis) -> None:
    """The number of images, and of those flagged as stego images."""
    table = new_table("images", "flagged", "mean fusion")
    mean = found.mean_fusion
    flagged = sum(row.flagged for row in found.rows)
    table.add_row(f"{len(found.rows):,}", f"{flagged:,}", "none" if mean is None else f"{mean:.4f}")
    Console().print(table)


def print_comparison(found: Comparison) -> None:
    """The tables of `comparison.md`, in parts as wide as the terminal."""
    from keyss.many.comparison import LEGEND, comparison_tables, impossible, not_measured

    for rows in comparison_tables(found).values():
        print_in_parts(rows)
    for line in (*impossible(found), *not_measured(found), *LEGEND):
        print(line)


def print_in_parts(rows: Sequence[Sequence[str]]) -> None:
    """A table, the heads first, in parts as wide as the terminal."""
    console = Console()
    for columns in parts_within(console.width, rows):
        part = new_table(*(rows[0][index] for index in columns), texts=1)
        for row in rows[1:]:
            part.add_row(*(row[index] for index in columns))
        console.print(part)


def parts_within(width: int, rows: Sequence[Sequence[str]]) -> list[list[int]]:
    """Groups of columns that fit in `width` characters, each with the first column, in order."""
    widths = [max(map(len, column)) + _GAP for column in zip(*rows, strict=True)]
    parts: list[list[int]] = [[0]]
    for index, own in enumerate(widths[1:], start=1):
        taken = sum(widths[each] for each in parts[-1])
        if len(parts[-1]) > 1 and taken + own - _GAP > width:
            parts.append([0])
        parts[-1].append(index)
    return parts


def print_verdicts(run: Path) -> None:
    """The verdicts of an audit: a line for each measure, with its baseline or control."""
    from keyss.audits import headline, read_audit, verdicts

    lines = verdicts(read_audit(run))
    table = new_table("measure", "measured", "baseline or control", "limit", "verdict", texts=5)
    for column in (table.columns[0], table.columns[-1]):
        column.no_wrap = True
    for line in lines:
        table.add_row(line.measure, line.value, line.beside, line.limit, line.word)
    Console().print(table)
    Console().print(headline(lines), highlight=False)


def print_facts(facts: Mapping[str, Any]) -> None:
    """Names and values, a nested one per line: `points.count`."""
    _print_columns(_flat(facts))


def print_conversion(out: str, found: Conversion, *, dry_run: bool, file: TextIO) -> None:
    """The cost of a conversion: size, PSNR of renders, and what is left of the secrets."""
    was = "" if found.bytes_before is None else f", {_size(found.bytes_before)} before"
    renders = "renders unchanged" if found.psnr >= 120 else f"renders at {found.psnr:.1f} dB PSNR"
    print(f"{out}: {len(found.gaussians):,} Gaussians, {_size(found.bytes_after)}{was}, {renders}", file=file)
    for number, secret in enumerate(found.secrets, 1):
        which = "the secret" if len(found.secrets) == 1 else f"the secret of key {number}"
        state = "survives" if secret.kept else f"is lost: {secret.after:,} {secret.unit} are left"
        print(f"{which}, {secret.before:,} {secret.unit}, {state}", file=file)
    if not found.secrets and not found.keeps_low_bits:
        print("this format destroys low bits; give --key-file to check a secret in them", file=file)
    if dry_run:
        print("dry run: nothing was written", file=file)


def print_outcome(result: ManyResult, what: str) -> None:
    """How many cells are done, and why others failed. Raises InputError if any failed."""
    failed, count = result.failed, len(result.outcomes)
    print(f"{count - len(failed)} of {count} {what} are done")
    for each in failed:
        print(f"failed: {each.name}: {each.error}")
    if failed:
        raise InputError(f"{len(failed)} of {count} {what} failed")


def print_json(facts: object) -> None:
    """A record as JSON, in ASCII where the standard output cannot encode its text."""
    text = record_bytes(facts).decode()
    try:
        text.encode(sys.stdout.encoding or "utf-8")
    except UnicodeEncodeError:
        text = json.dumps(json.loads(text), indent=2) + "\n"
    print(text, end="")


def _size(count: int) -> str:
    return f"{count / 1e6:,.1f} MB" if count >= 1e6 else f"{count / 1e3:,.1f} kB"


def print_forecast(found: Forecast, jobs: int | None = None) -> None:
    """Which of several cells are done, and roughly what the others take."""
    from keyss.many.processes import Resources

    table = new_table("cell", "name", "time, about", "memory", texts=2)
    for each in found.cells:
        time, memory = "done" if each.done else "cannot work", ""
        if each.plan is not None:
            time, memory = about(each.plan.seconds), f"{each.plan.memory_bytes / 1e9:.1f} GB"
        table.add_row(each.id[:12], Text(each.name), time, memory)
    Console().print(table)
    for each in found.cells:
        if each.refused:
            print(f"{each.name}: {each.refused}")
    resources = Resources.divided(jobs, max((each.memory_bytes for each in found.plans), default=1))
    print(
        f"{len(found.cells)} cell{'s' * (len(found.cells) != 1)}, {len(found.plans)} to do: about "
        f"{about(sum(each.seconds for each in found.plans))} on this machine if all its cores are at work; "
        f"{resources.jobs} at once with {resources.threads} thread(s) each"
    )
    print("Dry run: nothing was written. Times are rough.")


def print_files(folder: Path, names: Mapping[str, str]) -> None:
    """The paths of the results that exist, and what each is."""
    _print_columns([(str(folder / name), text) for name, text in names.items() if (folder / name).exists()])


def _print_columns(rows: Sequence[tuple[str, str]]) -> None:
    """Two columns of plain text: paths must not be wrapped, however narrow the terminal."""
    width = max((len(name) for name, _ in rows), default=0)
    for name, text in rows:
        print(f"{name:<{width}}  {text}")


def _scene_row(
    name: str,
    found: ImageQuality,
    plain: ImageQuality | None,
    shorter: bool,  # whether the plain model had fewer training steps
    gaussians: int,
    others: int | None,  # Gaussians of the plain model
    steps: int | None,
    fewer: int | None,  # steps of the plain model
) -> list[str]:
    """Cells of one scene: PSNR, SSIM, bound and loss or start, numbers of Gaussians and of steps."""
    beside = ["", "", ""]
    if plain is not None:
        loss = f"{plain.psnr - found.psnr:z.2f}"
        beside = ["", "", f"{plain.psnr:.2f}"] if shorter else [f"{plain.psnr:.2f}", loss, ""]
    trained = "" if steps is None else f"{steps:,}"
    if shorter and steps is not None and fewer is not None:
        trained += f" (start {fewer:,})"
    return [
        name,
        f"{found.psnr:.2f}",
        f"{found.ssim:.3f}",
        *beside,
        f"{gaussians:,}",
        f"{others:,}" if others else "",
        trained,
    ]


def new_table(*names: str, texts: int = 0) -> Table:
    """An empty table with these columns: the first `texts` are left-aligned, the others hold numbers."""
    table = Table(box=None, pad_edge=False, header_style="bold")
    for index, name in enumerate(names):
        table.add_column(name, justify="left" if index < texts else "right")
    return table


def _flat(facts: Mapping[str, Any], prefix: str = "") -> list[tuple[str, str]]:
    rows: list[tuple[str, str]] = []
    for name, value in facts.items():
        if isinstance(value, list | tuple) and value and isinstance(value[0], Mapping):
            value = {str(index): item for index, item in enumerate(value, start=1)}
        if isinstance(value, Mapping):
            rows += _flat(value, f"{prefix}{name}.")
        else:
            rows.append((prefix + name, _text(value)))
    return rows


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
