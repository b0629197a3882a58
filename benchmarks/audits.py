"""One table of several audits, a column each.

    keyss hide ... -o runs/best && keyss audit runs/best --key-file key.txt     # and so on, then
    python benchmarks/audits.py best=runs/best carry=runs/carry --write docs/audit.md

With --write the table replaces what lies between the two marker lines of the file.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from keyss.files.atomic import write_bytes
from keyss.measure import composite_score

BEGIN, END = "<!-- audits: begin -->", "<!-- audits: end -->"
Audit = dict[str, Any]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("runs", nargs="+", metavar="NAME=RUN")
    parser.add_argument("--write", type=Path, metavar="FILE")
    arguments = parser.parse_args()
    names, audits = [], []
    for argument in arguments.runs:
        name, run = argument.split("=", 1)
        names.append(name)
        audits.append(json.loads((Path(run) / "audit" / "audit.json").read_text()))
    table = "\n".join([_line(["", *names]), _line(["---"] * (1 + len(names))), *_rows(audits)])
    print(table)
    if arguments.write:
        text = arguments.write.read_text()
        start, end = text.index(BEGIN) + len(BEGIN), text.index(END)
        write_bytes(arguments.write, f"{text[:start]}\n{table}\n{text[end:]}".encode())


def _rows(audits: list[Audit]) -> list[str]:
    rows: dict[str, Callable[[Audit], str]] = {
        "cover, dB (loss)": lambda a: _quality(a["images"]["cover"], a["images"]["cover_bound"]),
        "secret, dB (loss)": lambda a: _quality(a["images"]["secrets"][0], a["images"]["secret_bounds"][0]),
        "wrong keys against the cover, mean": _wrong_keys,
        "3D-Sinkhorn as published, sum (null)": _sinkhorn,
        "composite score (eq. 10)": _score,
        **{
            f"distance over null: {name} (the plain model's)": lambda a, name=name: _ratio(a, name)  # type: ignore[misc]
            for name in ("position", "scale", "rotation", "opacity", "colour", "harmonics", "joint")
        },
        "classifier, AUC (null)": _classifier,
        "StegExpose, AUC (null)": lambda a: _auc(a, "stegexpose"),
        "sealwatch SPA, AUC (null)": lambda a: _auc(a, "sealwatch", "spa"),
        "sealwatch SPAM, AUC (null)": lambda a: _auc(a, "sealwatch", "spam"),
        "largest leak above null, dB": lambda a: _leak(a, "psnr", 2),
        "largest leak above null, SSIM": lambda a: _leak(a, "ssim", 3),
        "the same after the best fit of colours, dB": lambda a: _leak(a, "psnr_fitted", 2),
        "the same after the best fit of colours, SSIM": lambda a: _leak(a, "ssim_fitted", 3),
        "largest leak above null, correlation of gradients": lambda a: _leak(a, "gradient", 3),
        "25 % removed at random: cover, secret": _pruned,
        "secret dies later than the cover, or neither": lambda a: _fates(a, ("later", "neither")),
        "together": lambda a: _fates(a, ("together",)),
        "secret dies sooner": lambda a: _fates(a, ("sooner",)),
        "rendering, over plain: published, revealed": _rendering,
        "reveal, s": lambda a: f"{a['speed']['reveal_seconds']:.1f}",
        "audit, min": lambda a: f"{a['seconds'] / 60:.1f}",
    }
    cells = [[name, *(_try(row, audit) for audit in audits)] for name, row in rows.items()]
    return [_line(row) for row in cells if any(row[1:])]


def _quality(found: Audit, bound: Audit | None) -> str:
    psnr = found["mean"]["psnr"]
    return f"{psnr:.2f}" + (f" ({bound['mean']['psnr'] - psnr:+.2f})" if bound else "")


def _wrong_keys(audit: Audit) -> str:
    return f"{audit['wrong_key']['vs_cover']['mean']:.2f}"


def _sinkhorn(audit: Audit) -> str:
    nulls = [each["sum"] for each in audit["sinkhorn"]["null"]]
    return f"{audit['sinkhorn']['stego']['sum']:.3f} ({sum(nulls) / len(nulls):.3f})"


def _score(audit: Audit) -> str:
    secrets = [each["mean"]["psnr"] for each in audit["images"]["secrets"]]
    cover, distance = audit["images"]["cover"]["mean"]["psnr"], audit["sinkhorn"]["stego"]["sum"]
    return f"{composite_score(cover, sum(secrets) / len(secrets), distance):.1f}"


def _ratio(audit: Audit, name: str) -> str:
    found = f"{audit['distances']['attributes'][name]['ratio']:.2f}"
    original = audit["distances"].get("original")
    return f"{found} ({original[name]['ratio']:.2f})" if original else found


def _classifier(audit: Audit) -> str:
    stego, null = ([each["auc"] for each in audit["two_sample"][which]] for which in ("stego", "null"))
    return f"{sum(stego) / len(stego):.3f} ({sum(null) / len(null):.3f})"


def _auc(audit: Audit, program: str, *path: str) -> str:
    values = []
    for key in (program, f"{program}_null"):
        found = audit[key]
        for each in path:
            found = found[each]
        values.append(found["roc"]["auc"])
    return f"{values[0]:.2f} ({values[1]:.2f})"


def _leak(audit: Audit, score: str, digits: int) -> str:
    attacks = [row for row in audit["leaks"][0] if not row["control"]]
    worst = max(attacks, key=lambda row: row["leak"][score])
    return f"{worst['leak'][score]:+.{digits}f} ({worst['attack']})"


def _pruned(audit: Audit) -> str:
    rows = [r for r in audit["robustness"] if (r["attack"], r["strength"]) == ("random pruning", 0.25)]
    losses = [
        -sum(each[-1] for each in part) / len(part)
        for part in (
            [(row["cover"]["loss"],) for row in rows],
            [(row["secrets"][0]["loss"],) for row in rows],
        )
    ]
    return f"{losses[0]:+.2f}, {losses[1]:+.2f}"


def _fates(audit: Audit, chosen: tuple[str, ...]) -> str:
    """Attacks with one of these verdicts; what begins alike is named together."""
    names = [row["attack"] for row in audit["survival"] if row["verdict"] in chosen]
    parts = []
    for start in ("noise on ", "conversion to "):
        own = [name.removeprefix(start) for name in names if name.startswith(start)]
        names = [name for name in names if not name.startswith(start)]
        parts += [start + ", ".join(own)] if own else []
    return "; ".join(names + parts)


def _rendering(audit: Audit) -> str:
    return ", ".join(f"{each['ratio']:.2f}" for each in audit["speed"]["render"])


def _try(row: Callable[[Audit], str], audit: Audit) -> str:
    """The cell; empty where the audit has nothing of it."""
    try:
        return row(audit)
    except (KeyError, IndexError, TypeError, ZeroDivisionError):
        return ""


def _line(cells: list[str]) -> str:
    return "| " + " | ".join(cells) + " |"


if __name__ == "__main__":
    main()
