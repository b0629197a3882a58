"""One table of several audits, a column each.

    keyss hide ... -o runs/best && keyss audit runs/best --key-file key.txt     # and so on, then
    python benchmarks/audit_table.py best=runs/best carry=runs/carry --write docs/experiments.md

With --write the table replaces what lies between the two marker lines of the file.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from statistics import fmean
from typing import Any

from keyss.files import write_bytes
from keyss.lab.audits import Audit, read_audit

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
    rows: dict[str, Cell] = {
        "cover, dB (loss)": lambda a: _quality(a, 0),
        "secret, dB (loss, beside the plain model it started from)": lambda a: _quality(a, 1),
        "wrong keys against the cover, mean": lambda a: f"{a.wrong_key.vs_cover.mean:.2f}",
        "3D-Sinkhorn as published, sum (controls)": _sinkhorn,
        "distance over seed-to-seed variation: joint (the plain model's)": _ratio,
        "classifier, AUC (controls)": _classifier,
        "StegExpose, AUC (controls)": lambda a: _auc(a),
        "largest leak after the best fit of colours, SSIM": lambda a: _leak(a, "ssim_fitted", 3),
        "largest leak above controls, correlation of gradients": lambda a: _leak(a, "gradient", 3),
        "25 % removed at random: cover, secret": _pruned,
    }
    cells = [[name, *(_try(row, audit) for audit in audits)] for name, row in rows.items()]
    return [_line(row) for row in cells if any(row[1:])]


def _quality(audit: Any, index: int) -> str:
    model = audit.images.models[index]
    psnr = model.images.mean.psnr
    return f"{psnr:.2f}" + (f" ({model.baseline.mean.psnr - psnr:+.2f})" if model.baseline else "")


def _sinkhorn(audit: Any) -> str:
    found = audit.parameters
    return f"{found.sinkhorn.sum:.3f} ({fmean(each.sum for each in found.sinkhorn_controls):.3f})"


def _ratio(audit: Any) -> str:
    found = audit.parameters.distances["joint"]
    return f"{found.ratio:.2f}" + (f" ({found.original:.2f})" if found.original is not None else "")


def _classifier(audit: Any) -> str:
    found = audit.parameters.two_sample
    stego, control = (fmean(each.auc for each in aucs) for aucs in (found.stego, found.control))
    return f"{stego:.3f} ({control:.3f})"


def _auc(audit: Audit) -> str:
    found = audit.stegexpose
    return f"{found.stego.fused.auc:.2f} ({found.control.fused.auc:.2f})" if found else ""


def _leak(audit: Any, score: str, digits: int) -> str:
    leaks = [(getattr(row.leak, score), row.attack) for row in audit.leaks[0] if not row.with_key]
    leak, attack = max(leaks)
    return f"{leak:+.{digits}f} ({attack})"


def _pruned(audit: Any) -> str:
    pruned = next(
        each for each in audit.robustness if (each.attack, each.strength) == ("random pruning", 0.25)
    )
    return f"{-pruned.cover.loss:+.2f}, {-pruned.secrets[0].loss:+.2f}"


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
