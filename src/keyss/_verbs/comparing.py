"""`compare`: methods beside each other, on the same scenes and with the same budget."""

from __future__ import annotations

import io
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

from keyss._verbs.asking import Secret
from keyss._verbs.fitting import fit
from keyss._verbs.hiding import hide
from keyss._verbs.planning import plan
from keyss._verbs.shared_folder import Begun, alone_in, begin, begun_before, key_in
from keyss.comparison.measuring import PlainCovers, measured
from keyss.comparison.record import ComparedMethod, Comparison
from keyss.comparison.sheet import sheet
from keyss.comparison.tables import markdown
from keyss.core.errors import InputError, KeyssError, OutputError, UsageError
from keyss.files.atomic import write_bytes
from keyss.files.models import read_model
from keyss.fitting.config import FitConfig
from keyss.fitting.loop import Reporter
from keyss.methods import registry
from keyss.methods.base import Method, MethodOptions
from keyss.methods.plain_models import plain_stage
from keyss.rendering import Backend, resolve_device
from keyss.rendering.orbit import is_model
from keyss.runs.config import PathLike
from keyss.runs.files import MODEL, is_run
from keyss.runs.folder import read_manifest
from keyss.runs.opening import HidingRun, as_scene, open_run
from keyss.runs.planning import PlannedRun
from keyss.runs.records import read_record, write_record

RECORD, TABLE, PICTURE, KEY = "comparison.json", "comparison.md", "comparison.png", "key.txt"
CONTROLS = 2  # plain models of the cover from other seeds, beside which published ones are judged
_ROLES = ("cover", "secret")
_PLAIN = "plain-"
_CONTROL_NAMES = tuple(f"control-{number}" for number in range(1, CONTROLS + 1))
# Every method with its first preset; `learned` as KeySS was published too, which is another training.
EVERY = tuple(
    name for each in registry.METHODS for name in ((each, f"{each}:paper") if each == "learned" else (each,))
)

OptionsT = TypeVar("OptionsT", bound=MethodOptions)


@dataclass(frozen=True)
class _PlainModels:
    """Plain models in a comparison's folder, each fitted when it is asked for, and once."""

    folder: Path
    scenes: Mapping[str, PathLike]  # by role
    config: FitConfig
    width: int | None
    device: Backend
    reporter: Reporter | None

    def of(self, role: str, iterations: int) -> Path:
        """That of the cover or the secret after so many steps, from the seed of all methods."""
        name = _plain_name(role, iterations, self.config)
        return self._fitted(name, self.scenes[role], replace(self.config, iterations=iterations))

    @cached_property
    def judging(self) -> PlainCovers:
        """What published models are held against."""
        paths = [self.of("cover", self.config.iterations)]
        for name in _CONTROL_NAMES:
            config = replace(self.config, seed=self.config.seed_of(name))
            paths.append(self._fitted(name, self.scenes["cover"], config))
        scene = as_scene(self.scenes["cover"], self.width, None)
        return PlainCovers(scene, [read_model(path).to(resolve_device(self.device)) for path in paths])

    def _fitted(self, name: str, scene: PathLike, config: FitConfig) -> Path:
        return fitted_once(
            self.folder / f"{_PLAIN}{name}",
            scene,
            config,
            width=self.width,
            device=self.device,
            reporter=self.reporter,
        )


def compare(
    cover: PathLike,
    secret: PathLike,
    *,
    methods: Sequence[str] = (),
    iterations: int | None = None,
    max_gaussians: int | None = None,
    width: int | None = None,
    seed: int | None = None,
    device: Backend = "auto",
    out: PathLike,
    resume: bool = False,
    reporter: Reporter | None = None,
) -> Comparison:
    """Hide one scene in another by each of the `methods` (by default `EVERY`), and lay out what they come to.

    A method is a name, or METHOD:PRESET; all get the steps and Gaussians that are given, else those of the
    first one's preset. Plain models of both scenes are fitted once. Steps are counted for each scene, in all:
    a method that trains a plain model on gets one of half as many steps, and the other half for itself. So
    `3dgs` is the bound of all: plain 3DGS of as many Gaussians and as many training steps.

    `out` gets them, the folder of a run for each method, a key for those that have keys, and
    `comparison.json`, `.md` and `.png` (a row for each method: cover, secret, and the secret's error). What
    was finished is not done again with `resume`. What a method cannot do is its row.
    Raises KeyssError for scenes that cannot be read and for folders that hold something else; Interrupted.
    """
    chosen, fit = _asked(cover, secret, methods, iterations, max_gaussians)
    folder = Path(out)
    told: dict[str, Any] = {"cover": os.path.realpath(cover), "secret": os.path.realpath(secret)}
    told |= {"iterations": fit.iterations, "max_gaussians": fit.max_gaussians, "width": width}
    with alone_in(folder):
        seed = _begin(folder, told, seed, resume)
        fit = replace(fit, seed=seed)
        key = key_in(folder / KEY)
        changes = {"max_gaussians": fit.max_gaussians, "seed": seed}
        plain_models = _PlainModels(folder, {"cover": cover, "secret": secret}, fit, width, device, reporter)
        rows = []
        for name, method, options in chosen:
            place, done = _place(folder, name), _row_file(folder, name)
            if (row := _row(done)) is not None:
                rows.append(row)
                continue
            own = key if method.capabilities.keys else ""
            options, steps = within(fit.iterations, options)
            plain = []
            if not is_run(place):
                plain = [plain_models.of(*each) for each in zip(_ROLES, steps, strict=True)]
            try:
                if plain:
                    hide(
                        cover,
                        [Secret(secret, own, plain[1])],
                        method=options.with_fit(**changes),
                        width=width,
                        cover_model=plain[0],
                        min_psnr=0,  # however bad it is
                        device=device,
                        out=place,
                        resume=read_manifest(place).running is not None,
                        reporter=reporter,
                    )
                run = open_run(place, [own] if own else [])
                rows.append(measured(name, run, plain_models.judging, device))
                write_record(done, rows[-1])
            except KeyssError as error:
                rows.append(ComparedMethod(name=name, error=str(error), capabilities=method.capabilities))
        found = Comparison(arguments=told | {"seed": seed}, methods=tuple(rows))
        write_record(folder / RECORD, found)
        write_bytes(folder / TABLE, markdown(found).encode())
        if runs := _runs(folder, found):
            picture = io.BytesIO()
            sheet(runs, device).save(picture, "PNG", optimize=True)
            write_bytes(folder / PICTURE, picture.getvalue())
        return found


def plan_comparison(
    cover: PathLike,
    secret: PathLike,
    *,
    methods: Sequence[str] = (),
    iterations: int | None = None,
    max_gaussians: int | None = None,
    width: int | None = None,
    device: Backend = "auto",
    out: PathLike,
) -> list[PlannedRun]:
    """What `compare` would run, with times from a few steps of each kind. Writes nothing; raises as it.

    Measuring is in it as `hide` does it: what else `compare` measures takes up to a minute for each method.
    """
    chosen, fit = _asked(cover, secret, methods, iterations, max_gaussians)
    folder, models, runs = Path(out), dict[str, PlannedRun](), list[PlannedRun]()
    for name, method, options in chosen:
        if _row(_row_file(folder, name)) is not None:
            runs.append(PlannedRun(name, True))
            continue
        options, steps = within(fit.iterations, options)
        options = options.with_fit(max_gaussians=fit.max_gaussians)
        key = "any" if method.capabilities.keys else ""
        try:
            planned = plan(cover, [Secret(secret, key)], method=options, width=width, device=device)
        except UsageError as error:
            runs.append(PlannedRun(name, False, error=str(error)))
            continue
        seconds = {stage.name: stage.seconds for stage in planned.stages}
        for role, count in zip(_ROLES, steps, strict=True):
            whole = seconds.pop(plain_stage(role))
            needed = [(_plain_name(role, count, fit), count)]
            needed += [(each, fit.iterations) for each in _CONTROL_NAMES if role == "cover"]
            for each, own in needed:
                done = (folder / f"{_PLAIN}{each}" / MODEL).exists()
                time = 0.0 if done else whole * own / options.fit.iterations
                models.setdefault(each, PlannedRun(f"{_PLAIN}{each}", done, time))
        runs.append(PlannedRun(name, False, sum(seconds.values())))
    return [*models.values(), *runs]


def _asked(
    cover: PathLike,
    secret: PathLike,
    methods: Sequence[str],
    iterations: int | None,
    max_gaussians: int | None,
) -> tuple[list[tuple[str, Method, MethodOptions]], FitConfig]:
    """The methods by name, and the training that all have. Raises UsageError."""
    if is_model(cover) or is_model(secret):
        raise UsageError("comparing takes scenes, folders of photos: models have none to compare with")
    chosen = [_named(name) for name in methods or EVERY]
    budget = {"iterations": iterations, "max_gaussians": max_gaussians}
    fit = replace(chosen[0][2].fit, **{name: each for name, each in budget.items() if each is not None})
    return chosen, fit


def _plain_name(role: str, iterations: int, config: FitConfig) -> str:
    return role if iterations == config.iterations else f"{role}-{iterations}"


def _place(folder: Path, name: str) -> Path:
    """A method's run."""
    return folder / name.replace(":", "-")


def _row_file(folder: Path, name: str) -> Path:
    return folder / f"{_place(folder, name).name}.json"


def _row(path: Path) -> ComparedMethod | None:
    """What was measured before; None where nothing was, or by a version that measured other things."""
    try:
        return read_record(path, ComparedMethod) if path.exists() else None
    except InputError:
        return None


def within(iterations: int, options: OptionsT) -> tuple[OptionsT, list[int]]:
    """Options, and steps of plain models of cover and secret, so that each scene has `iterations` in all."""
    goes_on = [each.goes_on and each.steps > 0 for each in options.training(2)]
    plain = iterations - iterations // 2
    own = max(1, iterations // 2) if any(goes_on) else iterations
    options = options.with_fit(iterations=own)
    return options, [plain if each else iterations for each in goes_on]


def _named(text: str) -> tuple[str, Method, MethodOptions]:
    """Name, method and options of METHOD or METHOD:PRESET. Raises UsageError."""
    name, _, preset = text.partition(":")
    method = registry.get(name)
    if preset and preset not in method.presets:
        raise UsageError(f"{text}: expected one of the presets {', '.join(method.presets)}")
    return text, method, method.presets[preset or next(iter(method.presets))]


def _begin(folder: Path, told: dict[str, Any], seed: int | None, resume: bool) -> int:
    """The seed of the comparison that is in `folder` from now on. Raises OutputError."""
    if (before := begun_before(folder)) is not None:
        if not resume:
            raise OutputError(f"{folder} holds a comparison: `resume=True` goes on with it")
        if before.told != told or seed not in (None, before.seed):
            raise OutputError(f"{folder} holds a comparison with other arguments: give the same ones")
        return before.seed
    seed = FitConfig(seed=seed).seeded().known_seed
    begin(folder, Begun(told=told, seed=seed))
    return seed


def fitted_once(
    out: Path,
    scene: PathLike,
    config: FitConfig,
    *,
    width: int | None,
    device: Backend,
    reporter: Reporter | None,
) -> Path:
    """A plain model in `out`, which is fitted or gone on with unless it is there."""
    if not (out / MODEL).exists():
        resume = read_manifest(out).running is not None
        fit(scene, config=config, width=width, device=device, out=out, resume=resume, reporter=reporter)
    return out / MODEL


def _runs(folder: Path, found: Comparison) -> list[tuple[str, HidingRun]]:
    """Those that came to something, by name."""
    key = key_in(folder / KEY)
    return [
        (each.name, open_run(_place(folder, each.name), [key] if each.capabilities.keys else []))
        for each in found.methods
        if each.error is None
    ]
