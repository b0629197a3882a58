"""One table of several audits, a column each.

    keyss hide ... -o runs/best && keyss audit runs/best --key-file key.txt     # and so on, then
    python benchmarks/audits.py best=runs/best carry=runs/carry --write docs/audit.md

With --write the table replaces what lies between the two marker lines of the file.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from functools import partial
from pathlib import Path
from statistics import fmean
from typing import Any

from keyss.audits import Audit, read_audit
from keyss.files import write_bytes
from keyss.measure import ImageComparison, composite_score, mean_over_draws

BEGIN, END = "<!-- audits: begin -->", "<!-- audits: end -->"
Cell = Callable[[Any], str]  # of an `Audit`, whose parts may be None: see `_try`


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("runs", nargs="+", metavar="NAME=RUN")
    parser.add_argument("--write", type=Path, metavar="FILE")
    arguments = parser.parse_args()
    names, audits = [], []
    for argument in arguments.runs:
        name, run = argument.split("=", 1)
        names.append(name)
        audits.append(read_audit(Path(run)))
    table = "\n".join([_line(["", *names]), _line(["---"] * (1 + len(names))), *_rows(audits)])
    print(table)
    if arguments.write:
        text = arguments.write.read_text()
        start, end = text.index(BEGIN) + len(BEGIN), text.index(END)
        write_bytes(arguments.write, f"{text[:start]}\n{table}\n{text[end:]}".encode())


def _rows(audits: list[Audit]) -> list[str]:
    attributes = ("position", "scale", "rotation", "opacity", "colour", "harmonics", "joint")
    rows: dict[str, Cell] = {
        "cover, dB (loss)": lambda a: _quality(a.images.cover, a.images.cover_baseline),
        "secret, dB (loss, beside the plain model it started from)": lambda a: _quality(
            a.images.secrets[0], a.images.secret_baselines[0]
        ),
        "wrong keys against the cover, mean": lambda a: f"{a.wrong_key.shown.vs_cover.mean:.2f}",
        "3D-Sinkhorn as published, sum (controls)": _sinkhorn,
        "composite score (eq. 10)": _score,
        **{
            f"distance over seed-to-seed variation: {name} (the plain model's)": partial(_ratio, name=name)
            for name in attributes
        },
        "classifier, AUC (controls)": _classifier,
        "StegExpose, AUC (controls)": lambda a: _auc(a),
        "largest leak above controls, dB": lambda a: _leak(a, "psnr", 2),
        "largest leak above controls, SSIM": lambda a: _leak(a, "ssim", 3),
        "the same after the best fit of colours, dB": lambda a: _leak(a, "psnr_fitted", 2),
        "the same after the best fit of colours, SSIM": lambda a: _leak(a, "ssim_fitted", 3),
        "largest leak above controls, correlation of gradients": lambda a: _leak(a, "gradient", 3),
        "25 % removed at random: cover, secret": _pruned,
        "secret breaks down after the cover, or neither does": lambda a: _attacks(a, ("cover", "neither")),
        "both break down at the same strength": lambda a: _attacks(a, ("both",)),
        "secret breaks down before the cover": lambda a: _attacks(a, ("secret",)),
        "rendering, over plain: stego, revealed": _rendering,
        "reveal, s": lambda a: f"{max(a.speed.reveal_seconds):.1f}",
        "audit, min": lambda a: f"{a.seconds / 60:.1f}",
    }
    cells = [[name, *(_try(row, audit) for audit in audits)] for name, row in rows.items()]
    return [_line(row) for row in cells if any(row[1:])]


def _quality(found: ImageComparison, baseline: ImageComparison | None) -> str:
    psnr = found.mean.psnr
    return f"{psnr:.2f}" + (f" ({baseline.mean.psnr - psnr:+.2f})" if baseline else "")


def _sinkhorn(audit: Any) -> str:
    found = audit.parameters.sinkhorn
    return f"{found.stego.sum:.3f} ({fmean(each.sum for each in found.control):.3f})"


def _score(audit: Any) -> str:
    secret = fmean(each.mean.psnr for each in audit.images.secrets)
    distance = audit.parameters.sinkhorn.stego.sum
    return f"{composite_score(audit.images.cover.mean.psnr, secret, distance):.1f}"


def _ratio(audit: Any, name: str) -> str:
    found = audit.parameters.distances[name]
    return f"{found.ratio:.2f}" + (f" ({found.original:.2f})" if found.original is not None else "")


def _classifier(audit: Any) -> str:
    found = audit.parameters.two_sample
    stego, control = (fmean(each.auc for each in aucs) for aucs in (found.stego, found.control))
    return f"{stego:.3f} ({control:.3f})"


def _auc(audit: Audit) -> str:
    found = audit.stegexpose
    return f"{found.stego.fused.auc:.2f} ({found.control.fused.auc:.2f})" if found else ""


def _leak(audit: Any, score: str, digits: int) -> str:
    leaks = [(getattr(row.leak, score), row.attack) for row in audit.leaks.secrets[0] if not row.with_key]
    leak, attack = max(leaks)
    return f"{leak:+.{digits}f} ({attack})"


def _pruned(audit: Any) -> str:
    changes = mean_over_draws(audit.robustness.changes)
    pruned = next(each for each in changes if (each.attack, each.strength) == ("random pruning", 0.25))
    return f"{-pruned.cover.loss:+.2f}, {-pruned.secrets[0].loss:+.2f}"


def _attacks(audit: Any, first: tuple[str, ...]) -> str:
    """Attacks under which these break down first; what begins alike is named together."""
    names = [point.attack for point in audit.robustness.breakdown_points if point.first in first]
    parts = []
    for start in ("noise on ", "conversion to "):
        own = [name.removeprefix(start) for name in names if name.startswith(start)]
        names = [name for name in names if not name.startswith(start)]
        parts += [start + ", ".join(own)] if own else []
    return "; ".join(names + parts)


def _rendering(audit: Any) -> str:
    return ", ".join(f"{each.ratio:.2f}" for each in audit.speed.render)


def _try(row: Cell, audit: Audit) -> str:
    """The cell; empty where the audit has nothing of it."""
    try:
        return row(audit)
    except (AttributeError, KeyError, IndexError, TypeError, StopIteration, ValueError):
        return ""


def _line(cells: list[str]) -> str:
    return "| " + " | ".join(cells) + " |"


if __name__ == "__main__":
    main()
