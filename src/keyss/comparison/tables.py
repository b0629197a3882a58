"""A comparison as text: two tables, for terminals and for Markdown, and what their columns are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from keyss.comparison.record import ComparedMethod, Comparison, SceneScores, Secrecy, Survival

LEGEND = (
    "Test views: photos that were not trained on. Steps: those in which cover and secret were drawn, in all. "
    "3dgs is the bound: plain 3DGS of as many Gaussians and as many training steps. Picture: how long one of "
    "the cover and of the secret takes, and how many times as long as one of plain 3DGS. Seconds: of hiding, "
    "after plain models.",
    "Wrong keys: dB of what they show against the cover, and at most against the secret; in brackets what "
    "the published model itself has against the secret. Classifier and StegExpose: area under the ROC curve "
    "against plain models of the cover from other seeds, 0.5 where nothing is told apart. p: of the file's "
    "least likely statistic beside those. In brackets the same of a plain model of the cover.",
    "Pruned of a random quarter, converted and back, purified (as by GSPure): change of cover and secret in "
    "dB. Lost: the secret does not open any more.",
)


@dataclass(frozen=True)
class TextTable:
    """Rows of text as long as `heads`; the first cell of a row is the name of its method."""

    title: str
    heads: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


def tables(found: Comparison) -> tuple[TextTable, TextTable]:
    """Fidelity and cost; secrecy and survival. Methods that came to nothing have no row."""
    every = [each for each in found.methods if each.cover is not None and each.secret is not None]
    changes = list(dict.fromkeys(row.change for each in every for row in each.survival))
    fidelity = ("method", "cover", "SSIM", "LPIPS", "secret", "SSIM", "LPIPS")
    cost = ("published", "handed over", "picture, ms", "seconds", "steps")
    secrecy = ("method", "keys", "secrets", "wrong keys", "standard .ply", "classifier", "p", "StegExpose")
    return (
        TextTable("Fidelity and cost", fidelity + cost, tuple(map(_fidelity, every))),
        TextTable(
            "Secrecy and survival",
            (*secrecy, *changes),
            tuple(_secrecy(each, changes) for each in every),
        ),
    )


def impossible(found: Comparison) -> list[str]:
    """A sentence for each method that came to nothing."""
    return [f"{each.name}: not possible: {each.error}" for each in found.methods if each.error is not None]


def not_measured(found: Comparison) -> list[str]:
    """A sentence for whatever was not measured, and why."""
    reasons: dict[str, list[str]] = {}
    for each in found.methods:
        told = [(row.change, row.skipped) for row in each.survival if row.skipped]
        told += [(row.reader, row.note) for row in each.readers if row.loads is None and row.note]
        for what, why in told:
            names = reasons.setdefault(f"{what}: {why}", [])
            names += [] if each.name in names else [each.name]
    return [f"not tried ({', '.join(names)}): {reason}" for reason, names in reasons.items()]


def markdown(found: Comparison) -> str:
    """Both tables in Markdown, and what is to be known of them."""
    parts = []
    for table in tables(found):
        rows = [table.heads, tuple("---" for _ in table.heads), *table.rows]
        lines = [" | ".join(cell.replace("|", "/") for cell in row) for row in rows]
        parts.append("\n".join([f"## {table.title}", "", *(f"| {line} |" for line in lines)]))
    parts += ["\n".join(f"- {line}" for line in [*impossible(found), *not_measured(found)])]
    return "\n\n".join(part for part in [*parts, *LEGEND] if part) + "\n"


def _fidelity(each: ComparedMethod) -> tuple[str, ...]:
    assert each.cover is not None  # else it has no row
    assert each.secret is not None
    return (
        each.name,
        *_scores(each.cover),
        *_scores(each.secret),
        _size(each.published_bytes),
        _size(each.handed_bytes) if each.handed_bytes else "nothing",
        f"{_picture(each.cover)}, {_picture(each.secret)}",
        f"{each.seconds:.0f}",
        ", ".join("unknown" if steps is None else f"{steps:,}" for steps in each.trained),
    )


def _secrecy(each: ComparedMethod, changes: Sequence[str]) -> tuple[str, ...]:
    own = {row.change: row for row in each.survival}
    return (
        each.name,
        "yes" if each.capabilities.keys else "no",
        f"{each.most_secrets}",
        _wrong_keys(each),
        _standard(each),
        *_audited(each.secrecy),
        *(_survived(own.get(change)) for change in changes),
    )


def _scores(scene: SceneScores) -> list[str]:
    return [f"{scene.psnr:.2f}", f"{scene.ssim:.3f}", "" if scene.lpips is None else f"{scene.lpips:.3f}"]


def _picture(scene: SceneScores) -> str:
    return f"{1000 * scene.render_seconds:.0f} ({scene.render_ratio:.1f}x)"


def _wrong_keys(each: ComparedMethod) -> str:
    if (shown := each.wrong_keys) is not None:
        return f"{shown.cover:.1f}, {shown.secret:.1f} ({shown.chance:.1f})"
    return "open nothing" if each.capabilities.keys else "no keys"


def _standard(each: ComparedMethod) -> str:
    """What others' readers say, not what the method does."""
    tried = [row.loads for row in each.readers if row.loads is not None]
    if not tried:
        return "not tried"
    word = "yes" if all(tried) else "no"
    return f"{word}, {sum(tried)} of {len(tried)} readers"


def _audited(found: Secrecy | None) -> list[str]:
    if found is None:
        return [""] * 3
    return [
        _beside(_area(found.classifier), _area(found.classifier_plain)),
        _beside(_probability(found.stealth), _probability(found.stealth_plain)),
        _beside(_area(found.stegexpose), _area(found.stegexpose_plain)),
    ]


def _beside(value: str, plain: str) -> str:
    return f"{value} ({plain})" if value and plain else value or "no 3DGS"


def _area(value: float | None) -> str:
    return "" if value is None else f"{value:.2f}"


def _probability(value: float | None) -> str:
    return "" if value is None else "<1e-16" if value < 1e-16 else f"{value:.1g}"


def _survived(row: Survival | None) -> str:
    if row is None or row.cover_loss is None:
        return "not tried"
    return f"{_gained(row.cover_loss)}, {'lost' if row.secret_loss is None else _gained(row.secret_loss)}"


def _gained(loss: float) -> str:
    """Decibels, of which rounding makes no -0.0."""
    return f"{0.0 - round(loss, 1):+.1f}"


def _size(count: int) -> str:
    return f"{count / 1e6:,.2f} MB"
