"""Tables of a sweep: the numbers of each cell, and means over seeds with confidence intervals."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean, stdev
from typing import Any

from scipy.stats import t as student

from keyss.files.atomic import write_bytes

CONFIDENCE = 0.95


@dataclass(frozen=True)
class CellNumbers:
    """The numbers of one cell."""

    pair: str
    method: str
    choices: Mapping[str, Any]  # from the grid
    seed: int
    cell: str  # the name of its folder
    numbers: Mapping[str, float]

    @property
    def labels(self) -> dict[str, Any]:
        """The columns that name it, except the seed."""
        choices = {name: _text(value) for name, value in self.choices.items()}
        return {"pair": self.pair, "method": self.method, **choices}


def summaries(cells: Iterable[CellNumbers]) -> list[dict[str, Any]]:
    """A row for each measure of each pair, method and choice of options: the mean over seeds.

    With its 95 % interval by Student's t distribution, NaN for a single seed. In the order of the cells;
    measures by name.
    """
    groups: dict[tuple[str, ...], list[CellNumbers]] = {}
    for cell in cells:
        groups.setdefault((cell.pair, cell.method, _text(cell.choices)), []).append(cell)
    found = []
    for group in groups.values():
        for measure in sorted({name for cell in group for name in cell.numbers}):
            values = [cell.numbers[measure] for cell in group if measure in cell.numbers]
            mean, reach = fmean(values), half_interval(values)
            row = {"measure": measure, "seeds": len(values), "mean": mean}
            found.append(group[0].labels | row | {"ci95_low": mean - reach, "ci95_high": mean + reach})
    return found


def half_interval(values: Sequence[float]) -> float:
    """Half the length of the 95 % confidence interval of the mean; NaN for fewer than two values.

    By Student's t distribution with n - 1 degrees of freedom.
    """
    if len(values) < 2:
        return math.nan
    quantile = float(student.ppf(0.5 + CONFIDENCE / 2, len(values) - 1))
    return quantile * stdev(values) / math.sqrt(len(values))


def write_tables(out: Path, cells: Sequence[CellNumbers]) -> list[str]:
    """`results.csv` and `cells.csv`; returns their names.

    Equal results are equal files. Raises OutputError.
    """
    names = dict.fromkeys(name for cell in cells for name in cell.choices)
    blank = {"pair": "", "method": "", **dict.fromkeys(names, "")}
    results = [blank | row for row in summaries(cells)]
    rows = [
        blank | cell.labels | {"seed": cell.seed, "cell": cell.cell, "measure": measure, "value": value}
        for cell in cells
        for measure, value in sorted(cell.numbers.items())
    ]
    write_bytes(out / "results.csv", csv_bytes(results))
    write_bytes(out / "cells.csv", csv_bytes(rows))
    return ["results.csv", "cells.csv"]


def markdown_rows(rows: Sequence[Sequence[str]]) -> list[str]:
    """Lines of a table in Markdown; the first row has the heads."""
    lines = [" | ".join(cell.replace("|", "/") for cell in row) for row in rows]
    lines.insert(1, " | ".join("---" for _ in rows[0]))
    return [f"| {line} |" for line in lines]


def csv_bytes(rows: Sequence[Mapping[str, Any]]) -> bytes:
    """Rows by the names of columns, which are those of the first; NaN is empty."""
    text = io.StringIO()
    if rows:
        writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        for row in rows:
            writer.writerow({name: _shown(value) for name, value in row.items()})
    return text.getvalue().encode("utf-8", "backslashreplace")


def _shown(value: Any) -> str:
    if isinstance(value, float):
        return "" if math.isnan(value) else repr(value)
    return str(value)


def _text(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value, sort_keys=True)
