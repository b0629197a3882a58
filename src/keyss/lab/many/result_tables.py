"""Tables of results: means and standard deviations over seeds, as CSV and LaTeX (booktabs)."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from statistics import fmean, stdev
from typing import Any

from keyss.files import write_bytes
from keyss.lab.many.trial_folder import Outcome

Group = tuple[dict[str, str], list[Outcome]]  # labels, and the trials that have them

# Decimals and heads of the usual metrics.
_METRICS = {
    "psnr": (2, "PSNR $\\uparrow$"),
    "ssim": (3, "SSIM $\\uparrow$"),
    "lpips": (3, "LPIPS $\\downarrow$"),
}
_NO_MEASURES = {"seconds", "seed", "version", "width"}
_LATEX = {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"}
_LATEX |= {character: f"\\{character}" for character in "&%$#_{}"}


def summaries(outcomes: Iterable[Outcome]) -> list[dict[str, Any]]:
    """Rows of means and standard deviations over seeds, in the order of trials, then by measure."""
    rows = []
    for labels, group in _group(outcomes):
        every = [_numbers(outcome) for outcome in group]
        for measure in sorted({name for numbers in every for name in numbers}):
            values = [numbers[measure] for numbers in every if measure in numbers]
            mean, std = mean_and_std(values)
            rows.append({**labels, "measure": measure, "seeds": len(values), "mean": mean, "std": std})
    return rows


def scene_rows(outcomes: Iterable[Outcome]) -> list[dict[str, Any]]:
    """Rows of PSNR in dB, SSIM and LPIPS per scene: means and standard deviations over seeds."""
    rows = []
    for labels, group in _group(outcomes):
        every = [_numbers(outcome) for outcome in group]
        for index, scene in enumerate(group[0].trial.scenes):
            part, role = (f"secrets.{index}", "secret") if index else ("cover", "cover")
            row = {**labels, "scene": scene, "role": role, "seeds": len(group)}
            for metric in _METRICS:
                name = f"{part}.{metric}"
                values = [numbers[name] for numbers in every if name in numbers]
                row[metric], row[f"{metric}_std"] = mean_and_std(values)
            rows.append(row)
    return rows


def mean_and_std(values: Sequence[float]) -> tuple[float, float]:
    """Mean and sample standard deviation; NaN for too few values."""
    mean = fmean(values) if values else math.nan
    return mean, stdev(values) if len(values) > 1 else math.nan


def _group(outcomes: Iterable[Outcome]) -> list[Group]:
    """Group finished hidings by labels, in their order; missing labels are empty."""
    done = [outcome for outcome in outcomes if outcome.trial.secrets and outcome.result]
    blank = dict.fromkeys((name for outcome in done for name in outcome.trial.labels), "")
    groups: dict[str, Group] = {}
    for outcome in done:
        labels = blank | {name: _text(value) for name, value in outcome.trial.labels.items()}
        groups.setdefault(json.dumps(labels), (labels, []))[1].append(outcome)
    return list(groups.values())


def _numbers(outcome: Outcome) -> dict[str, float]:
    """What was measured, without times and arguments."""
    every = outcome.result.numbers.items() if outcome.result else ()
    return {name: value for name, value in every if _NO_MEASURES.isdisjoint(name.split("."))}


def write_scene_tables(out: Path, stem: str, outcomes: Iterable[Outcome]) -> None:
    """Write `scene_rows` to `STEM.csv` and `STEM.tex`. Raises OutputError."""
    rows = scene_rows(outcomes)
    write_bytes(out / f"{stem}.csv", csv_bytes(rows))
    write_bytes(out / f"{stem}.tex", latex(rows).encode())


def write_sweep_tables(out: Path, outcomes: Collection[Outcome]) -> None:
    """Write `results.csv` and `trials.csv` with all measures, and `scenes`. Raises OutputError."""
    rows = [
        {**labels, "seed": each.trial.fit.seed, "trial": each.folder.name, "measure": name, "value": value}
        for labels, group in _group(outcomes)
        for each in group
        for name, value in sorted(_numbers(each).items())
    ]
    write_bytes(out / "results.csv", csv_bytes(summaries(outcomes)))
    write_bytes(out / "trials.csv", csv_bytes(rows))
    write_scene_tables(out, "scenes", outcomes)


def latex(rows: Sequence[Mapping[str, Any]]) -> str:
    """The rows of `scene_rows` as a LaTeX table (booktabs): means and deviations."""
    texts = [name for name, value in rows[0].items() if isinstance(value, str)] if rows else []
    heads = [name.capitalize() for name in texts] + [head for _, head in _METRICS.values()]
    lines = [
        r"% \usepackage{booktabs}",
        rf"\begin{{tabular}}{{{'l' * len(texts)}{'r' * len(_METRICS)}}}",
        r"\toprule",
        " & ".join(heads) + r" \\",
        r"\midrule",
    ]
    for row in rows:
        cells = ["".join(_LATEX.get(character, character) for character in row[name]) for name in texts]
        for metric, (decimals, _) in _METRICS.items():
            mean, std = row[metric], row[f"{metric}_std"]
            spread = "" if math.isnan(std) else rf" $\pm$ {std:.{decimals}f}"
            cells.append("--" if math.isnan(mean) else f"{mean:.{decimals}f}{spread}")
        lines.append(" & ".join(cells) + r" \\")
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}", ""])


def csv_bytes(rows: Sequence[Mapping[str, Any]]) -> bytes:
    """Rows as CSV with the columns of the first row; NaN is empty."""
    text = io.StringIO()
    if rows:
        writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        for row in rows:
            writer.writerow({name: "" if value != value else value for name, value in row.items()})
    return text.getvalue().encode("utf-8", "backslashreplace")


def _text(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value, sort_keys=True)
