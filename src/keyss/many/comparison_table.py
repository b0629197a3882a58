"""The tables of a comparison of methods, as text."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from keyss._version import __version__
from keyss.audits.comparison_measures import CONVERSIONS, OWN
from keyss.many.result_tables import markdown_rows

_LEGEND = (
    "Test views: photos that were not trained on. Steps: those in which cover and secret were rendered, in "
    "total. 3dgs is the bound: plain 3DGS of as many Gaussians and as many training steps. Picture: the time "
    "of one of the cover and of the secret, and its ratio to that of plain 3DGS. Seconds: of hiding, after "
    "plain models.",
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
    keys: bool = True
    max_secrets: int = 1
    numbers: dict[str, float] = field(default_factory=dict)  # see `keyss.many.cell.Result`; means over seeds
    notes: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """`comparison.json`."""

    version: int = 4
    keyss: str = __version__
    arguments: dict[str, Any]
    methods: tuple[ComparedMethod, ...] = ()


Column = Callable[[ComparedMethod], str]


def comparison_tables(found: Comparison) -> dict[str, list[list[str]]]:
    """Rows of text by title, the heads first: fidelity and cost, secrecy and survival.

    Methods that failed have no row.
    """
    rows = [each for each in found.methods if each.error is None]
    return {
        title: [
            [head.rstrip() for head in columns],
            *([shown(row) for shown in columns.values()] for row in rows),
        ]
        for title, columns in (("Fidelity and cost", _FIDELITY), ("Secrecy and survival", _SECRECY))
    }


def comparison_notes(comparison: Comparison) -> list[str]:
    """Methods that failed, reasons to skip or replace a measure, and the legend: a line each."""
    failures = [f"{row.name}: not possible: {row.error}" for row in comparison.methods if row.error]
    reasons: dict[str, list[str]] = {}
    for row in comparison.methods:
        for measure, reason in row.notes.items():
            how = "*" if reason.startswith(OWN) else "not tried:"
            reasons.setdefault(f"{how} {measure.partition('.')[2]}: {reason}", []).append(row.name)
    return [*failures, *(f"{reason} ({', '.join(names)})" for reason, names in reasons.items()), *_LEGEND]


def comparison_text(comparison: Comparison) -> str:
    """Both tables and the notes in Markdown."""
    lines = []
    for title, rows in comparison_tables(comparison).items():
        lines += [f"## {title}", "", *markdown_rows(rows), ""]
    lines += [f"- {note}" for note in comparison_notes(comparison)]
    return "\n".join(lines) + "\n"


def _number(name: str, form: str) -> Column:
    """The number of this name, formatted; nothing where it was not measured."""
    return lambda each: f"{each.numbers[name]:{form}}" if name in each.numbers else ""


def _bytes(name: str) -> Column:
    return lambda each: f"{each.numbers[name] / 1e6:,.2f} MB" if each.numbers[name] else "nothing"


def _picture(each: ComparedMethod) -> str:
    names = [f"pictures.{role}" for role in _ROLES]
    times = [(1e3 * each.numbers[f"{name}.seconds"], each.numbers[f"{name}.ratio"]) for name in names]
    return ", ".join(f"{milliseconds:.0f} ({ratio:.1f}x)" for milliseconds, ratio in times)


def _steps(each: ComparedMethod) -> str:
    found = [each.numbers.get(f"steps.{index}") for index in (1, 2)]
    return ", ".join("unknown" if steps is None else f"{steps:,.0f}" for steps in found)


def _wrong_keys(each: ComparedMethod) -> str:
    names = ("wrong_key.vs_cover.mean", "wrong_key.vs_secrets.1.max", "chance_level.1")
    shown = [each.numbers[name] for name in names if name in each.numbers]
    if len(shown) == len(names):
        return "{:.1f}, {:.1f} ({:.1f})".format(*shown)
    return "open nothing" if each.keys else "no keys"


def _standard(each: ComparedMethod) -> str:
    """Measured with third-party readers, not the method's claim."""
    tried, load = (int(each.numbers[f"files.{name}"]) for name in ("readers", "readers that load"))
    word = "yes" if load == tried else "no"
    return f"{word}, {load} of {tried} readers" if tried else f"{OWN} reader"


def _beside(name: str, shown: Callable[[float], str]) -> Column:
    """A number of the published model, and in brackets the same for a plain one."""

    def column(each: ComparedMethod) -> str:
        own, plain = (each.numbers.get(f"secrecy.{name}{end}") for end in ("", "_plain"))
        if own is None:
            return "no 3DGS"
        return shown(own) if plain is None else f"{shown(own)} ({shown(plain)})"

    return column


def _area(value: float) -> str:
    return f"{value:.2f}"


def _probability(value: float) -> str:
    return "<1e-16" if value < 1e-16 else f"{value:.1g}"


def _survived(change: str) -> Column:
    def column(each: ComparedMethod) -> str:
        cover, secret = (each.numbers.get(f"survival.{change}.{role}") for role in _ROLES)
        if cover is None:
            return "not tried"
        own = " *" if f"survival.{change}" in each.notes else ""
        return f"{_gained(cover)}, {'lost' if secret is None else _gained(secret)}{own}"

    return column


def _gained(loss: float) -> str:
    """The gain in decibels, without -0.0."""
    return f"{0.0 - round(loss, 1):+.1f}"


_ROLES = ("cover", "secret")
_FIDELITY: dict[str, Column] = {
    "method": lambda each: each.name,
    "cover": _number("cover.psnr", ".2f"),
    "SSIM": _number("cover.ssim", ".3f"),
    "LPIPS": _number("cover.lpips", ".3f"),
    "secret": _number("secrets.1.psnr", ".2f"),
    "SSIM ": _number("secrets.1.ssim", ".3f"),
    "LPIPS ": _number("secrets.1.lpips", ".3f"),
    "published": _bytes("files.published"),
    "handed over": _bytes("files.handed"),
    "picture, ms": _picture,
    "seconds": _number("seconds", ".0f"),
    "steps": _steps,
}
_SECRECY: dict[str, Column] = {
    "method": lambda each: each.name,
    "keys": lambda each: "yes" if each.keys else "no",
    "secrets": lambda each: f"{each.max_secrets}",
    "wrong keys": _wrong_keys,
    "standard .ply": _standard,
    "classifier": _beside("classifier", _area),
    "p": _beside("stealth", _probability),
    "StegExpose": _beside("stegexpose", _area),
    **{name: _survived(name) for name in ("pruned", *CONVERSIONS, "purified")},
}
