"""What is printed when a command is done."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.table import Table

if TYPE_CHECKING:
    from keyss.measure.stegexpose import Steganalysis

Metrics = Mapping[str, Any]  # of metrics.json


def print_metrics(metrics: Metrics, console: Console | None = None) -> None:
    """The numbers of a hiding run: one row per image set, each beside its bound."""
    table = Table(box=None, pad_edge=False, header_style="bold")
    table.add_column("against the test photos")
    for name in ("PSNR", "SSIM", "bound", "loss"):
        table.add_column(name, justify="right")
    bound = metrics.get("bound") or {}
    secrets = metrics.get("secrets") or []
    bounds = bound.get("secrets") or [None] * len(secrets)
    _quality_row(table, "cover", metrics["cover"], bound.get("cover"))
    for i, (secret, limit) in enumerate(zip(secrets, bounds, strict=True)):
        _quality_row(table, _numbered("secret", i, len(secrets)), secret, limit)
    wrong = metrics.get("wrong_key")
    if wrong:
        _wrong_key_rows(table, wrong, len(secrets))
    console = console or Console()
    console.print(table)
    console.print(
        "Bound: plain 3DGS of the same scene, of the same size and training. PSNR, bound and loss in dB."
    )


def print_carry(metrics: Metrics, console: Console | None = None) -> None:
    """The numbers of carrying: what is where, and against photos where there are any."""
    table = Table(box=None, pad_edge=False, header_style="bold")
    table.add_column("")
    for name in ("Gaussians", "carried", "bits each", "PSNR", "SSIM", "bound", "loss"):
        table.add_column(name, justify="right")
    secrets, bound = metrics["secrets"], metrics["bound"]
    rows = [("cover", f"{metrics['gaussians']:,}", "", "", metrics["cover"], bound["cover"])]
    for i, (secret, limit) in enumerate(zip(secrets, bound["secrets"], strict=True)):
        counts = (f"{secret['gaussians']:,}", f"{secret['carried']:,}", str(secret["bits"]))
        rows.append((_numbered("secret", i, len(secrets)), *counts, secret, limit))
    for *cells, got, limit in rows:
        if limit is None:
            table.add_row(*cells)
            continue
        numbers = (got["psnr"], got["ssim"], limit["psnr"], limit["psnr"] - got["psnr"])
        table.add_row(
            *cells, *(f"{number:.{digits}f}" for number, digits in zip(numbers, (2, 3, 2, 3), strict=True))
        )
    console = console or Console()
    console.print(table)
    console.print(
        f"{metrics['carriers']:,} of the cover's {metrics['gaussians']:,} Gaussians can carry something; "
        f"up to {metrics['room']:,} fit. {metrics['seconds']:.1f} s.",
        soft_wrap=True,
    )
    if metrics["dither_psnr"] is not None:
        console.print(f"Dithering costs the cover {metrics['dither_psnr']:.1f} dB (PSNR before and after).")


def print_fit(metrics: Metrics, console: Console | None = None) -> None:
    """The numbers of a plain fit."""
    table = Table(box=None, pad_edge=False, header_style="bold")
    for name in ("PSNR", "SSIM", "Gaussians", "iterations", "seconds"):
        table.add_column(name, justify="right")
    table.add_row(
        f"{metrics['psnr']:.2f}",
        f"{metrics['ssim']:.3f}",
        f"{metrics['gaussians']:,}",
        f"{metrics['iterations']:,}",
        f"{metrics['seconds']:.0f}",
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
    from keyss.runs.audit_record import read_audit
    from keyss.report.verdicts import headline, verdicts

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


def _quality_row(table: Table, name: str, got: Metrics, bound: Metrics | None) -> None:
    limits = [f"{bound['psnr']:.2f}", f"{bound['psnr'] - got['psnr']:.2f}"] if bound else ["", ""]
    table.add_row(name, f"{got['psnr']:.2f}", f"{got['ssim']:.3f}", *limits)


def _wrong_key_rows(table: Table, wrong: Metrics, secrets: int) -> None:
    cover = wrong["vs_cover"]
    table.add_row(f"{wrong['keys']} wrong keys, against the cover", f"{cover['mean']:.2f}")
    table.add_row("  the worst of them", f"{cover['min']:.2f}")
    for i, (secret, floor) in enumerate(zip(wrong["vs_secrets"], wrong["floor"], strict=True)):
        name = _numbered("the secret", i, secrets)
        table.add_row(f"  the one nearest to {name}", f"{secret['max']:.2f}")
        table.add_row(f"  the stego cover itself, against {name}", f"{floor:.2f}")


def _numbered(name: str, index: int, count: int) -> str:
    return f"{name} {index + 1}" if count > 1 else name


def _flat(facts: Mapping[str, Any], prefix: str = "") -> list[tuple[str, str]]:
    rows: list[tuple[str, str]] = []
    for name, value in facts.items():
        if isinstance(value, list) and value and isinstance(value[0], Mapping):
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
