"""What is printed when a command is done."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.table import Table

if TYPE_CHECKING:
    from keyss.fitting.image_metrics import ImageQuality
    from keyss.measure.stegexpose import Steganalysis
    from keyss.runs.metrics import FitMetrics, HideMetrics


def print_hiding(metrics: HideMetrics, console: Console | None = None) -> None:
    """The numbers of a hiding: a row for each scene beside its baseline, wrong keys, the method's own."""
    rows = [_QualityRow("cover", metrics.cover, metrics.baseline.cover, metrics.gaussians)]
    count = len(metrics.secrets)
    for i, (secret, plain) in enumerate(zip(metrics.secrets, metrics.baseline.secrets, strict=True)):
        name = _numbered("secret", i, count)
        rows.append(_QualityRow(name, secret, plain, metrics.secret_gaussians[i]))
    wrong = metrics.wrong_key
    if wrong is not None:
        rows.append(_QualityRow(f"{wrong.keys} wrong keys, against the cover", wrong.vs_cover.mean))
        rows.append(_QualityRow("  the worst of them", wrong.vs_cover.min))
        for i, found in enumerate(wrong.vs_secrets):
            rows.append(_QualityRow(f"  the one nearest to {_numbered('the secret', i, count)}", found.max))
    for i, level in enumerate(metrics.chance_level):
        rows.append(_QualityRow(f"the stego cover, against {_numbered('the secret', i, count)}", level))
    cells = [row.cells() for row in rows]
    table = Table(box=None, pad_edge=False, header_style="bold")
    for index, name in enumerate(
        ("against the test photos", "PSNR", "SSIM", "baseline", "loss", "Gaussians")
    ):
        if any(row[index] for row in cells):
            table.add_column(name, justify="right" if index else "left")
    for row in cells:
        table.add_row(*(cell for cell, *column in zip(row, *cells, strict=True) if any(column)))
    console = console or Console()
    console.print(table)
    console.print("Baseline: plain 3DGS of the same scene. PSNR, baseline and loss in dB.")
    for name, value in metrics.details.items():
        console.print(f"{name.replace('_', ' ')}: {_text(value)}", highlight=False)


def print_fit(metrics: FitMetrics, console: Console | None = None) -> None:
    """The numbers of a plain fit."""
    table = Table(box=None, pad_edge=False, header_style="bold")
    for name in ("PSNR", "SSIM", "Gaussians", "iterations", "seconds"):
        table.add_column(name, justify="right")
    table.add_row(
        f"{metrics.psnr:.2f}",
        f"{metrics.ssim:.3f}",
        f"{metrics.gaussians:,}",
        f"{metrics.iterations:,}",
        f"{metrics.seconds:.0f}",
    )
    (console or Console()).print(table)


def print_steganalysis(found: Steganalysis, console: Console | None = None) -> None:
    """How many images there are and how many of them are taken for stego images."""
    table = Table(box=None, pad_edge=False, header_style="bold")
    for name in ("images", "flagged", "mean fusion"):
        table.add_column(name, justify="right")
    mean = found.mean_fusion
    flagged = sum(row.flagged for row in found.rows)
    table.add_row(f"{len(found.rows):,}", f"{flagged:,}", "none" if mean is None else f"{mean:.4f}")
    (console or Console()).print(table)


def print_verdicts(run: Path, console: Console | None = None) -> None:
    """What an audit comes to: a line for each measure, beside its bound or null."""
    from keyss.report.verdicts import headline, verdicts
    from keyss.runs.audit_record import read_audit

    lines = verdicts(read_audit(run))
    table = Table(box=None, pad_edge=False, header_style="bold")
    for name in ("", "value", "beside", "limit", ""):
        table.add_column(name)
    for line in lines:
        table.add_row(line.measure, line.value, line.beside, line.limit, line.word)
    console = console or Console()
    console.print(table)
    console.print(headline(lines), highlight=False)


def print_facts(facts: Mapping[str, Any]) -> None:
    """Names and values, a nested one per line: `points.count`."""
    _print_columns(_flat(facts))


def print_files(folder: Path, names: Mapping[str, str]) -> None:
    """Where the results are and what each is, those that exist."""
    _print_columns([(str(folder / name), text) for name, text in names.items() if (folder / name).exists()])


def _print_columns(rows: Sequence[tuple[str, str]]) -> None:
    """Two columns of plain text: paths must come out whole and as they are, however narrow the terminal."""
    width = max((len(name) for name, _ in rows), default=0)
    for name, text in rows:
        print(f"{name:<{width}}  {text}")


@dataclass(frozen=True)
class _QualityRow:
    """A name, a quality or a PSNR alone, the baseline's quality, and a number of Gaussians."""

    name: str
    found: ImageQuality | float
    baseline: ImageQuality | None = None
    gaussians: int | None = None

    def cells(self) -> list[str]:
        """Six cells, empty ones included."""
        psnr = self.found if isinstance(self.found, float) else self.found.psnr
        return [
            self.name,
            f"{psnr:.2f}",
            "" if isinstance(self.found, float) else f"{self.found.ssim:.3f}",
            "" if self.baseline is None else f"{self.baseline.psnr:.2f}",
            "" if self.baseline is None else f"{self.baseline.psnr - psnr:.2f}",
            "" if self.gaussians is None else f"{self.gaussians:,}",
        ]


def _numbered(name: str, index: int, count: int) -> str:
    return f"{name} {index + 1}" if count > 1 else name


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
            return ", ".join(_text(item) for item in value)
    return str(value)
