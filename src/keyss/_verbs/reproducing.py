"""`reproduce`: the paper's tables, run again and laid beside its figures."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from keyss._verbs.asking import Secret
from keyss._verbs.comparing import fitted_once
from keyss._verbs.hiding import hide
from keyss._verbs.planning import plan
from keyss._verbs.shared_folder import Begun, alone_in, begin, begun_before, key_in
from keyss.core.errors import KeyssError, OutputError
from keyss.files.atomic import write_bytes
from keyss.fitting.config import FitConfig
from keyss.fitting.loop import Reporter, SilentReporter
from keyss.methods import registry
from keyss.methods.base import role_of
from keyss.methods.plain_models import plain_stage
from keyss.reproduction import downloading
from keyss.reproduction.asking import PaperTable, Setting, benchmark_scenes, setting_of
from keyss.reproduction.measuring import MEASURES
from keyss.reproduction.record import MeasuredNumbers, Reproduction, laid_out, markdown
from keyss.reproduction.scenes import Group, link_benchmark
from keyss.reproduction.tables import Cell
from keyss.runs.config import PathLike
from keyss.runs.files import MODEL, is_run
from keyss.runs.folder import read_manifest
from keyss.runs.opening import open_run
from keyss.runs.planning import PlannedRun
from keyss.runs.records import read_record, write_record

_PLAIN, _SCENES = "plain", "scenes"


def reproduce(
    table: PaperTable, *, seed: int | None = None, out: PathLike, reporter: Reporter | None = None
) -> Reproduction:
    """Make a table of the paper again.

    `out` (a folder) gets `TABLE.json` and `TABLE.md`; in `runs/` and `plain/` what was run, for one table or
    several. What is there is not run again, and what was interrupted is gone on with. Which claim holds:
    `keyss.reproduction.claims.judged`. A run that fails is in the result. Raises KeyssError and its children
    for scenes and arguments that cannot be, Interrupted.
    """
    asked = setting_of(table, Path(out))
    with alone_in(asked.out):
        return _reproduced(asked, _begin(asked, seed), reporter)


def _reproduced(asked: Setting, seed: int, reporter: Reporter | None) -> Reproduction:
    folders = asked.folders
    if asked.data is not None:
        names = sorted({name for group in asked.groups for name in group})
        folders = {name: link_benchmark(asked.data, name, asked.out / _SCENES) for name in names}
    failures = {}
    for cell, group in asked.work:
        try:
            _run(asked, cell, [folders[name] for name in group], group, seed, reporter)
        except KeyssError as error:
            failures[f"{cell.name}, {'-'.join(group)}"] = str(error)
    found: dict[str, list[dict[str, float]]] = {}
    for cell in (*asked.table.cells, *asked.table.kept):
        known = (_known(asked, cell, group[: cell.secrets + 1]) for group in asked.groups)
        found[cell.name] = [each for each in known if each]
    result = laid_out(
        asked.table,
        found,
        ["-".join(group) for group in asked.groups],
        covers=[group[0] for group in asked.groups] if asked.data is not None else [],
        arguments={"scale": asked.scale, **asked.sizes, "seed": seed},
        failures=failures,
    )
    write_record(asked.out / f"{asked.table.name}.json", result)
    write_bytes(asked.out / f"{asked.table.name}.md", markdown(result).encode())
    return result


def download_scenes(table: PaperTable, *, reporter: Reporter | None = None) -> list[Path]:
    """The paper's scenes that a table at full scale needs, in the folder `data`: those missing are fetched.

    See `keyss.reproduction.downloading`. What was interrupted is gone on with. Raises UsageError for another
    scale, InputError for what cannot be reached, is damaged or has changed, OutputError.
    """
    names = benchmark_scenes(table)
    assert table.data is not None  # which is checked there
    data, note = Path(os.path.realpath(table.data)), (reporter or SilentReporter()).note
    return downloading.download_benchmark(names, data, note, downloading.SOURCES)


def plan_reproduction(table: PaperTable, *, out: PathLike) -> list[PlannedRun]:
    """What `reproduce` would run, with times from a few steps of each kind. Writes nothing; raises as it."""
    asked = setting_of(table, Path(out))
    found: list[PlannedRun] = []
    with _scenes_to_look_at(asked) as folders:
        fitted: set[str] = set()
        times: dict[tuple[Any, ...], dict[str, float]] = {}
        for cell, group in asked.work:
            name = f"{cell.name}, {'-'.join(group)}"
            if all(asked.numbers(cell, group, measure).exists() for measure in asked.table.measures):
                found.append(PlannedRun(name, True))
                continue
            kind = (cell.method, group)
            if kind not in times:  # masks and the like take about the same
                times[kind] = _stages(asked, cell, [folders[each] for each in group])
            stages = dict(times[kind])
            for index, each in enumerate(group):
                seconds = stages.pop(plain_stage(role_of(index, len(group))))
                if each not in fitted:
                    fitted.add(each)
                    done = (asked.out / _PLAIN / each / MODEL).exists()
                    found.append(PlannedRun(f"plain model, {each}", done, 0.0 if done else seconds))
            found.append(PlannedRun(name, False, sum(stages.values())))
    return found


def _stages(asked: Setting, cell: Cell, paths: Sequence[Path]) -> dict[str, float]:
    """Seconds of each stage of a run on these scenes."""
    keys = (f"key {index}" if _has_keys(cell) else "" for index in range(len(paths)))
    secrets = [Secret(path, key) for path, key in zip(paths[1:], keys, strict=False)]
    options, width = asked.options(cell, 0), asked.sizes["width"]
    planned = plan(paths[0], secrets, method=options, width=width, device=asked.device)
    return {stage.name: stage.seconds for stage in planned.stages}


def _begin(asked: Setting, seed: int | None) -> int:
    """The seed of all tables in the folder, which share their runs. Raises OutputError for another folder."""
    told: dict[str, Any] = {"scale": asked.scale, **asked.sizes}
    scenes = {name: str(path) for name, path in asked.folders.items()}
    if (before := begun_before(asked.out)) is not None:
        known = before.told.pop("scenes", {})
        same = all(known.get(name, path) == path for name, path in scenes.items())
        if before.told != told or seed not in (None, before.seed) or not same:
            raise OutputError(
                f"{asked.out} holds tables of other scenes, sizes or another seed: give the same, or choose "
                "another folder"
            )
        seed, scenes = before.seed, known | scenes
    else:
        seed = FitConfig(seed=seed).seeded().known_seed
    begin(asked.out, Begun(told=told | {"scenes": scenes}, seed=seed))
    return seed


def _run(
    asked: Setting, cell: Cell, paths: Sequence[Path], group: Group, seed: int, reporter: Reporter | None
) -> None:
    """Hide and measure, as far as that is not done."""
    missing = [each for each in asked.table.measures if not asked.numbers(cell, group, each).exists()]
    if not missing:
        return
    place, width = asked.place(cell, group), asked.sizes["width"]
    indices = range(1, len(group)) if _has_keys(cell) else ()
    keys = [key_in(asked.out / f"key-{index}.txt") for index in indices]
    if not is_run(place):
        fit = replace(asked.fit, seed=seed)
        cover, *others = (
            fitted_once(
                asked.out / _PLAIN / name, path, fit, width=width, device=asked.device, reporter=reporter
            )
            for name, path in zip(group, paths, strict=True)
        )
        own = keys or [""] * len(others)
        hide(
            paths[0],
            [Secret(*each) for each in zip(paths[1:], own, others, strict=True)],
            method=asked.options(cell, seed),
            width=width,
            cover_model=cover,
            min_psnr=0,  # however bad it is
            device=asked.device,
            out=place,
            resume=read_manifest(place).running is not None,
            reporter=reporter,
        )
    run = open_run(place, keys)
    for measure in missing:
        numbers = MEASURES[measure](run, asked.device)
        write_record(asked.numbers(cell, group, measure), MeasuredNumbers(numbers=numbers))


def _known(asked: Setting, cell: Cell, group: Group) -> dict[str, float]:
    """Numbers of a run, as far as there are some."""
    found: dict[str, float] = {}
    for measure in asked.table.measures:
        if (path := asked.numbers(cell, group, measure)).exists():
            found |= read_record(path, MeasuredNumbers).numbers
    return found


def _has_keys(cell: Cell) -> bool:
    return registry.METHODS[cell.method].capabilities.keys


@contextmanager
def _scenes_to_look_at(asked: Setting) -> Iterator[dict[str, Path]]:
    """Folders of scenes for a plan, of which nothing is left."""
    if asked.data is None:
        yield asked.folders
        return
    with tempfile.TemporaryDirectory() as folder:
        names = sorted({name for group in asked.groups for name in group})
        yield {name: link_benchmark(asked.data, name, Path(folder)) for name in names}
