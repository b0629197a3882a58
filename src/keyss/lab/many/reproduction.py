"""`reproduce`: run a table of the KeySS paper on its scenes or others, and compare the figures.

`paper.toml` has the runs, the published figures and the claims of each table.
"""

from __future__ import annotations

import os
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from statistics import fmean
from typing import Any, Literal

import msgspec

from keyss._version import __version__
from keyss.core import UsageError, ViewOptions
from keyss.core.errors import did_you_mean
from keyss.lab.many.result_tables import write_scene_tables
from keyss.lab.many.sweep_spec import with_changes
from keyss.lab.many.trial_folder import Forecast, TrialFolder
from keyss.methods import registry
from keyss.progress import Reporter
from keyss.rendering import Backend
from keyss.runs import write_record
from keyss.runs.files import PathLike

SMALL = {"iterations": 1000, "max_gaussians": 9000, "width": 120}
SSIM_WEIGHT = 0.5  # D-SSIM weight of the loss, also for plain models

Group = tuple[str, ...]  # names of a cover and of its secrets
Figure = float | tuple[float, ...]  # one number, or one for each published group
Measured = Mapping[str, Mapping[str, float | None]]  # value by run and measure
Verdict = Literal["holds", "holds in part", "does not hold here", "not measured"]

_PART = re.compile(
    r"(?P<run>.+?): (?P<measure>.+?)( - (?P<other>.+?): (?P<other_measure>.+?))? "
    r"(?P<sign>[<>])= (?P<limit>[\d.]+)"
)


class Run(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A hiding with the paper's settings, except for `changes` of the method's options."""

    figures: dict[str, Figure] = {}  # published, by measure
    method: str = "keyss"
    changes: dict[str, Any] = {}
    secrets: int = 1


class Claim(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A conclusion of the paper: comparisons of means over all pairs of scenes."""

    text: str
    parts: tuple[str, ...]


class Table(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One table of the paper."""

    title: str
    runs: dict[str, Run]
    claims: tuple[Claim, ...]
    measures: tuple[str, ...] = ()  # beyond those of every hiding

    @property
    def secrets(self) -> int:
        """Number of secrets in a group of scenes."""
        return max(run.secrets for run in self.runs.values())

    @property
    def groups(self) -> tuple[Group, ...]:
        """The published groups of scenes."""
        return PAPER.pairs if self.secrets == 1 else PAPER.triples


class Paper(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The content of `paper.toml`."""

    pairs: tuple[Group, ...]
    triples: tuple[Group, ...]
    tables: dict[str, Table]


PAPER = msgspec.toml.decode(Path(__file__).with_name("paper.toml").read_bytes(), type=Paper)


@dataclass(frozen=True, kw_only=True)
class FigureRow:
    """Figures of one run by measure, means over pairs of scenes."""

    label: str
    published: dict[str, float]
    here: dict[str, float | None]  # None: not measured on all pairs


@dataclass(frozen=True, kw_only=True)
class JudgedClaim:
    """A claim and its verdict."""

    text: str
    verdict: Verdict
    parts: int  # parts that could be measured
    holding: int


@dataclass(frozen=True, kw_only=True)
class Reproduction:
    """A reproduced table: `TABLE.json`."""

    version: int = 3
    keyss: str = __version__
    table: str
    title: str
    arguments: dict[str, Any]
    pairs: tuple[str, ...]
    rows: tuple[FigureRow, ...]
    claims: tuple[JudgedClaim, ...]
    failures: dict[str, str] = field(default_factory=dict)  # reasons by run


def reproduce(
    table: str,
    scenes: Sequence[PathLike] = (),
    *,
    full: bool = False,
    pairs: Sequence[str] = (),
    iterations: int | None = None,
    max_gaussians: int | None = None,
    width: int | None = None,
    seeds: Sequence[int] = (0,),
    device: Backend = "auto",
    out: PathLike,
    dry_run: bool = False,
    reporter: Reporter | None = None,
) -> Reproduction | Forecast:
    """Reproduce a table of the paper, one of `PAPER.tables`.

    The `scenes` (folders of photos) hide each other, by default with 1,000 steps, 9,000 Gaussians and a width
    of 120 pixels. `full`: the scenes are the paper's, by the names of their folders; they are paired as
    published, and have 30,000 steps and 500,000 Gaussians. `pairs`: covers and secrets, as "COVER,SECRET" or
    "COVER,SECRET,SECRET" by the names of their folders; by default each scene hides the next.

    `out` (a folder) gets `TABLE.json`, `.csv` and `.tex` (PSNR, SSIM and LPIPS per scene, with
    standard deviations over `seeds`), and the trials, which tables in one folder share. Finished trials are
    skipped. `dry_run`: only return their costs. The result lists failed trials. Raises KeyssError for
    impossible scenes and arguments; KeyboardInterrupt.
    """
    if table not in PAPER.tables:
        raise UsageError(f"no table is called {table!r}; {did_you_mean(table, PAPER.tables)}")
    if width is not None and width < 1:
        raise UsageError(f"`width`: expected at least 1, got {width}")
    spec, paths = PAPER.tables[table], _paths(scenes)
    groups = groups_of(list(paths), spec.secrets, pairs, spec.groups if full else ())
    given = {"iterations": iterations, "max_gaussians": max_gaussians, "width": width}
    sizes = {name: SMALL[name] if value is None and not full else value for name, value in given.items()}
    changes: dict[str, Any] = {"ssim_weight": SSIM_WEIGHT}
    changes |= {name: sizes[name] for name in ("iterations", "max_gaussians") if sizes[name] is not None}
    folder = TrialFolder(Path(out), common={"views": ViewOptions(sizes["width"]), "device": device})
    for group, (name, run), seed in product(groups, spec.runs.items(), seeds):
        preset = registry.get(run.method).options.preset("full")
        options = with_changes(preset, run.changes).with_fit(**changes, seed=seed)
        shown = group[: run.secrets + 1]
        sources = [paths[scene] for scene in shown]
        fits = options.fits(len(sources))
        note = f"seed {seed}" * (len(seeds) > 1)
        models = [folder.plain(*fit, note) for fit in zip(sources, fits, strict=True)]
        title = f"{name}, {'-'.join(group)}{note and f', {note}'}"
        labels = {"run": name, "pair": "-".join(shown)}
        folder.hiding(title, sources, options, models, labels=labels, measures=spec.measures)
    if dry_run:
        return folder.forecast(reporter)
    outcomes = folder.run(reporter=reporter)
    numbers: dict[str, list[dict[str, float]]] = {name: [] for name in spec.runs}
    hidings = [outcome for outcome in outcomes.values() if outcome.trial.secrets]
    for outcome in hidings:
        if outcome.result is not None:
            numbers[outcome.trial.labels["run"]].append(_numbers(outcome.result.numbers))
    covers = [cover for cover, *_ in groups] if full else []
    figures = figure_rows(spec, numbers, len(groups) * len(seeds), covers)
    measured = {row.label: row.here for row in figures}
    reproduction = Reproduction(
        table=table,
        title=spec.title,
        arguments={**sizes, "seeds": list(seeds)},
        pairs=tuple("-".join(group) for group in groups),
        rows=figures,
        claims=tuple(judge_claim(claim, measured) for claim in spec.claims),
        failures={outcome.trial.name: outcome.error for outcome in outcomes.values() if outcome.error},
    )
    write_record(folder.out / f"{table}.json", reproduction)
    order = list(spec.runs)
    hidings.sort(key=lambda outcome: order.index(outcome.trial.labels["run"]))
    write_scene_tables(folder.out, table, hidings)
    return reproduction


def _paths(scenes: Sequence[PathLike]) -> dict[str, str]:
    """Folders of scenes, by name. Raises UsageError."""
    paths: dict[str, str] = {}
    for path in map(os.path.realpath, scenes):
        name = os.path.basename(path)
        if paths.setdefault(name, path) != path:
            raise UsageError(f"expected scenes of different names, got two that are called {name}")
    return paths


def groups_of(
    names: Sequence[str], secrets: int, pairs: Sequence[str], published: Sequence[Group]
) -> Sequence[Group]:
    """Groups of a cover and its secrets: those of `pairs`, the `published` ones, or each scene and the next.

    `pairs`: COVER,SECRET or COVER,SECRET,SECRET. Raises UsageError.
    """
    groups = [tuple(name.strip() for name in text.split(",")) for text in pairs]
    for text, group in zip(pairs, groups, strict=True):
        if len(group) != secrets + 1 or len(set(group)) < len(group):
            raise UsageError(
                f"`pairs`: expected a cover and {secrets} secret(s) of different names, got {text!r}"
            )
    groups = groups or list(published)
    for name in (name for group in groups for name in group):
        if name not in names:
            raise UsageError(f"expected a scene called {name!r}, got {', '.join(names) or 'none'}")
    if groups:
        return groups
    if len(names) <= secrets:
        raise UsageError(f"expected at least {secrets + 1} scenes, got {len(names)}")
    twice = [*names, *names]
    return [tuple(twice[index : index + secrets + 1]) for index in range(len(names))]


def _numbers(numbers: Mapping[str, float]) -> dict[str, float]:
    """The numbers of a trial, by the names of the paper's figures."""
    measures = ("pruning.", "rendering.", "sinkhorn.")  # prefixes of numbers named after the paper's
    figures = {name.partition(".")[2]: value for name, value in numbers.items() if name.startswith(measures)}
    secrets = [value for name, value in numbers.items() if re.fullmatch(r"secrets\.\d+\.psnr", name)]
    figures |= {f"secret {number}": psnr for number, psnr in enumerate(secrets, start=1)}
    cover, secret = numbers["cover.psnr"], fmean(secrets)
    figures |= {"cover": cover, "secret": secret, "mean of both": (cover + secret) / 2}
    # Wrong keys of the first secret's decoder.
    wrong = {"cover": "wrong_key.vs_cover.mean", "secret": "wrong_key.vs_secrets.1.mean"}
    return figures | {f"wrong key, {role}": numbers[name] for role, name in wrong.items() if name in numbers}


def figure_rows(
    table: Table,
    numbers: Mapping[str, Sequence[Mapping[str, float]]],  # by run, for each group with a result
    count: int,  # of groups
    covers: Collection[str] = (),
) -> tuple[FigureRow, ...]:
    """Published figures beside measured ones, a row for each run.

    A figure must be measured on all groups, because means over different groups are not comparable.
    `covers`: covers of the published groups that were run; if empty, published figures are means over all.
    """
    rows = []
    every = dict.fromkeys(measure for run in table.runs.values() for measure in run.figures)
    for name, run in table.runs.items():
        here: dict[str, float | None] = {}
        for measure in every:
            values = [trial[measure] for trial in numbers.get(name, ()) if measure in trial]
            if values or measure in run.figures:
                here[measure] = fmean(values) if len(values) == count else None
        published = {measure: mean_figure(table, figure, covers) for measure, figure in run.figures.items()}
        rows.append(FigureRow(label=name, published=published, here=here))
    return tuple(rows)


def mean_figure(table: Table, figure: Figure, covers: Collection[str] = ()) -> float:
    """The mean of a published figure over its `covers`, or over all groups if it has none of them."""
    if isinstance(figure, float):
        return figure
    by_cover = zip((cover for cover, *_ in table.groups), figure, strict=True)
    return fmean([value for cover, value in by_cover if cover in covers] or figure)


def judge_claim(claim: Claim, figures: Measured) -> JudgedClaim:
    """Judge a claim: it `holds` if all of its parts hold, and `holds in part` if at least half of them do.

    Parts without figures do not count; without any part, the claim is `not measured`.
    """
    parts = [held for part in claim.parts for held in _judge_part(part, figures) if held is not None]
    holding = sum(parts)
    verdict: Verdict = "does not hold here"
    if not parts:
        verdict = "not measured"
    elif 2 * holding >= len(parts):
        verdict = "holds" if holding == len(parts) else "holds in part"
    return JudgedClaim(text=claim.text, verdict=verdict, parts=len(parts), holding=holding)


def _judge_part(part: str, figures: Measured) -> Iterator[bool | None]:
    """True if the part holds, for each run that it compares with; None without a figure."""
    match = _PART.fullmatch(part)
    assert match is not None, part
    run, limit = match["run"], float(match["limit"])
    others = [name for name in figures if name != run] if match["other"] == "*" else [match["other"]]
    for other in others:
        left = figures.get(run, {}).get(match["measure"])
        right = 0.0 if other is None else figures.get(other, {}).get(match["other_measure"])
        if left is None or right is None:
            yield None
        else:
            yield left - right >= limit if match["sign"] == ">" else left - right <= limit


def reproduction_rows(reproduction: Reproduction) -> list[list[str]]:
    """Rows of text, heads first: "published / here". Tables with few runs are transposed."""
    measures = list(dict.fromkeys(measure for row in reproduction.rows for measure in row.here))
    table = [["published / here", *measures]]
    for row in reproduction.rows:
        texts = [
            f"{_number(row.published.get(measure))} / {_number(row.here[measure])}"
            if measure in row.here
            else ""
            for measure in measures
        ]
        table.append([row.label, *texts])
    if len(measures) <= 2 * len(reproduction.rows):
        return table
    return [list(column) for column in zip(*table, strict=True)]


def reproduction_notes(reproduction: Reproduction) -> list[str]:
    """A line per claim and per failed run."""
    lines = [
        f"{claim.verdict} ({claim.holding} of {claim.parts}): {claim.text}" for claim in reproduction.claims
    ]
    return [*lines, *(f"failed: {name}: {error}" for name, error in reproduction.failures.items())]


def _number(value: float | None) -> str:
    if value is None:
        return "-"
    return f"{value:.2f}" if abs(value) >= 1 else f"{value:.4f}"
