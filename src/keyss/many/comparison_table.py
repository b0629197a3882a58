"""The tables of a comparison of methods, as text."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from keyss._version import __version__
from keyss.audits.comparison_measures import CONVERSIONS, OWN
from keyss.fitting.lpips import HOW_TO_GET
from keyss.many.result_tables import markdown_rows

# Columns by their heads: %-formats of numbers by name. The first of which all numbers were measured counts.
_FIDELITY = {
    "cover": ["%(cover.psnr).2f"],
    "SSIM": ["%(cover.ssim).3f"],
    "LPIPS": ["%(cover.lpips).3f"],
    "secret": ["%(secrets.1.psnr).2f"],
    "SSIM ": ["%(secrets.1.ssim).3f"],
    "LPIPS ": ["%(secrets.1.lpips).3f"],
    "published, MB": ["%(files.published_mb).2f"],
    "handed over, MB": ["%(files.handed_mb).2f"],
    "cover, ms": ["%(pictures.cover.ms).0f (%(pictures.cover.ratio).1fx)"],
    "secret, ms": ["%(pictures.secret.ms).0f (%(pictures.secret.ratio).1fx)"],
    "seconds": ["%(seconds).0f"],
    "steps": ["%(steps.1)d, %(steps.2)d", "unknown"],
}
_SECRECY = {
    "wrong keys": [
        "%(wrong_key.vs_cover.mean).1f, %(wrong_key.vs_secrets.1.max).1f (%(chance_level.1).1f)",
        "%(wrong keys)s",
    ],
    "standard .ply": ["%(files.readers that load)d of %(files.readers)d readers", f"{OWN} reader *"],
    **{
        head: [f"%(secrecy.{name}){form} (%(secrecy.{name}_plain){form})", "no 3DGS"]
        for head, name, form in (
            ("classifier", "classifier", ".2f"),
            ("p", "stealth", ".1g"),
            ("StegExpose", "stegexpose", ".2f"),
        )
    },
    **{
        head: [
            f"%(survival.{head}.cover)+.1f, %(survival.{head}.secret)+.1f",
            f"%(survival.{head}.cover)+.1f, lost",
            "not tried",
        ]
        for head in ("pruned", *CONVERSIONS, "purified")
    },
}
_LEGEND = (
    "Test views: photos that were not trained on. Steps: those in which cover and secret were rendered, in "
    "total. 3dgs is the bound: plain 3DGS of as many Gaussians and as many training steps. ms: the time of "
    "a picture, and its ratio to that of plain 3DGS. Seconds: of hiding, after plain models.",
    "Wrong keys: PSNR in dB of what they show against the cover, and at most against the secret; in brackets "
    "that of the published model itself against the secret. Classifier and StegExpose: area under the ROC "
    "curve against plain models of the cover from other seeds, 0.5 where they cannot be told apart. p: of "
    "the file's least likely statistic beside those. In brackets the same of a plain model of the cover.",
    "Pruned of a random quarter, converted and back, purified (as by GSPure): change of cover and secret in "
    "dB. Lost: the secret no longer opens.",
)


@dataclass(frozen=True, kw_only=True)
class ComparedMethod:
    """One method; `error` is the reason for a missing result."""

    name: str  # METHOD, METHOD:PRESET or METHOD:VARIANT
    error: str | None = None
    keys: bool = True  # whether a key opens the secret
    numbers: dict[str, float] = field(default_factory=dict)  # see `keyss.many.cell.Result`; means over seeds
    notes: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """`comparison.json`."""

    version: int = 4
    keyss: str = __version__
    arguments: dict[str, Any]
    methods: tuple[ComparedMethod, ...] = ()


def comparison_tables(found: Comparison) -> dict[str, list[list[str]]]:
    """Rows of text by title, the heads first: fidelity and cost, secrecy and survival.

    Methods that failed have no row.
    """
    rows = [each for each in found.methods if each.error is None]
    return {
        title: [
            ["method", *(head.rstrip() for head in columns)],
            *([row.name, *(_cell(row, head, formats) for head, formats in columns.items())] for row in rows),
        ]
        for title, columns in (("Fidelity and cost", _FIDELITY), ("Secrecy and survival", _SECRECY))
    }


def _cell(row: ComparedMethod, head: str, formats: list[str]) -> str:
    values = row.numbers | {"wrong keys": "open nothing" if row.keys else "no keys"}
    for each in formats:
        try:
            text = each % values
        except KeyError:
            continue
        return f"{text} *" if row.notes.get(f"survival.{head}", "").startswith(OWN) else text
    return ""


def comparison_notes(comparison: Comparison) -> list[str]:
    """Methods that failed, reasons to skip or replace a measure, and the legend: a line each."""
    failures = [f"{row.name}: not possible: {row.error}" for row in comparison.methods if row.error]
    reasons: dict[str, list[str]] = {}
    for row in comparison.methods:
        for measure, reason in row.notes.items():
            how = "*" if reason.startswith(OWN) else "not tried:"
            reasons.setdefault(f"{how} {measure.partition('.')[2]}: {reason}", []).append(row.name)
    skipped = [f"{reason} ({', '.join(names)})" for reason, names in reasons.items()]
    if any("cover.lpips" not in row.numbers for row in comparison.methods if row.numbers):
        skipped.append(f"no LPIPS: {HOW_TO_GET}")
    return [*failures, *skipped, *_LEGEND]


def comparison_text(comparison: Comparison) -> str:
    """Both tables and the notes in Markdown."""
    lines = []
    for title, rows in comparison_tables(comparison).items():
        lines += [f"## {title}", "", *markdown_rows(rows), ""]
    lines += [f"- {note}" for note in comparison_notes(comparison)]
    return "\n".join(lines) + "\n"
