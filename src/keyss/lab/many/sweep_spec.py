"""`sweep`: run the trials of a specification (YAML, docs/experiments.md), and tabulate their results.

Names of fields, types, options of methods and the existence of files are checked before anything runs.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from dataclasses import fields, replace
from itertools import product
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta

from keyss.core import InputError, KeyssError, UsageError, ViewOptions, import_extra
from keyss.core.errors import did_you_mean
from keyss.files.inputs import read_text
from keyss.fitting import PRESETS, FitConfig
from keyss.fitting.config import MAX_SEED
from keyss.lab.audits import PARTS
from keyss.lab.many.result_tables import write_sweep_tables
from keyss.lab.many.trial_folder import Forecast, Outcome, TrialFolder
from keyss.methods import Design, KeyssOptions, MethodOptions, registry
from keyss.progress import Reporter
from keyss.rendering import resolve_device
from keyss.rendering.orbit import is_model
from keyss.runs.files import PathLike

MAX_BYTES = 1 << 20  # size of the file
_AT_LEAST_ONE = Meta(min_length=1)


class Pair(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A cover and its secrets: scenes or models. Paths are relative to the folder of the file."""

    cover: str
    secrets: Annotated[tuple[str, ...], _AT_LEAST_ONE]
    name: str | None = None  # in tables; None: the names of the scenes
    cover_model: str | None = None  # plain models of scenes; None: fitted
    secret_models: tuple[str, ...] = ()


class MethodSpec(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A method, and options that override its preset."""

    method: Literal[tuple(registry.METHODS)]  # type: ignore[valid-type]
    name: str | None = None  # in tables; None: that of the method
    preset: Literal[tuple(PRESETS)] = "default"  # type: ignore[valid-type]
    options: dict[str, Any] = {}
    grid: dict[str, Annotated[list[Any], _AT_LEAST_ONE]] = {}  # values of options, in all combinations


class SweepSpec(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The content of a sweep's file."""

    pairs: Annotated[tuple[Pair, ...], _AT_LEAST_ONE]
    methods: Annotated[tuple[MethodSpec, ...], _AT_LEAST_ONE]
    seeds: Annotated[tuple[Annotated[int, Meta(ge=0, le=MAX_SEED)], ...], _AT_LEAST_ONE] = (0,)
    evaluate: tuple[Literal[tuple(PARTS)], ...] = ()  # type: ignore[valid-type]  # beyond `keyss hide`'s own
    width: int | None = None
    background: tuple[float, float, float] | None = None
    skip_missing: bool = False
    min_psnr: float = 0.0
    bound: bool = False
    device: Literal["auto", "cpu", "cuda"] = "auto"


def read_spec(path: Path) -> SweepSpec:
    """Read a sweep; paths become absolute. Raises InputError, and BackendError without PyYAML."""
    yaml = import_extra("yaml", "sweep", "read sweeps")
    try:
        spec = msgspec.convert(yaml.safe_load(read_text(path, MAX_BYTES)), SweepSpec)
    except (yaml.YAMLError, msgspec.ValidationError, ValueError, RecursionError) as error:
        raise InputError(f"{path}: expected YAML of a sweep: {' '.join(str(error).split())}") from error
    most = min(registry.get(entry.method).max_secrets for entry in spec.methods)
    pairs = [_resolve_pair(path, index, pair, most) for index, pair in enumerate(spec.pairs)]
    methods = [msgspec.structs.replace(method, name=method.name or method.method) for method in spec.methods]
    spec = msgspec.structs.replace(spec, pairs=tuple(pairs), methods=tuple(methods))
    unique: dict[str, list[Any]] = {"seeds": list(spec.seeds)}
    unique |= {
        "pairs": [entry.name for entry in spec.pairs],
        "methods": [entry.name for entry in spec.methods],
    }
    for what, values in unique.items():
        if same := [value for value in values if values.count(value) > 1]:  # tables would merge them
            raise InputError(f"{path}: {what}: two are called {same[0]!r}: give one another `name`, or seed")
    return spec


def variants(path: Path, spec: SweepSpec) -> Iterator[tuple[str, MethodOptions, dict[str, Any]]]:
    """Each method with each combination of its grid: name in tables, options, and choices from the grid.

    Raises InputError for invalid options.
    """
    for index, entry in enumerate(spec.methods):
        where = f"{path}: methods[{index}]"
        preset = registry.get(entry.method).options.preset(entry.preset, resolve_device(spec.device).type)
        if twice := entry.options.keys() & entry.grid.keys():
            raise InputError(f"{where}: {min(twice)} is both in the options and in the grid")
        for values in product(*entry.grid.values()):
            choices = dict(zip(entry.grid, values, strict=True))
            try:
                options = with_changes(preset, {**entry.options, **choices})
            except (KeyssError, msgspec.ValidationError) as error:
                raise InputError(f"{where}: {error}") from error
            yield str(entry.name), options, choices


def with_changes(preset: MethodOptions, changes: Mapping[str, Any]) -> MethodOptions:
    """The preset with options changed by name: `publish`, `fit.iterations`, `design.points` (of KeySS).

    Raises UsageError for unknown names, and it or msgspec.ValidationError for wrong values.
    """
    kinds: dict[str, Any] = {"": type(preset), "fit": FitConfig}
    if isinstance(preset, KeyssOptions):
        kinds["design"] = Design
    known = {f"{kind}.{option.name}".lstrip(".") for kind in kinds for option in fields(kinds[kind])}
    known -= {"fit", "fit.seed"}
    parts: dict[str, dict[str, Any]] = {kind: {} for kind in kinds}
    for name, value in changes.items():
        if name not in known:
            raise UsageError(f"option {name[:60]!r} is unknown; {did_you_mean(name, known)}")
        prefix, _, field = name.rpartition(".")
        parts[prefix][field] = value
    options = msgspec.convert({**msgspec.to_builtins(preset), **parts[""]}, type(preset))
    if isinstance(options, KeyssOptions) and parts["design"]:
        design = {**msgspec.to_builtins(options.configuration), **parts["design"]}
        options = replace(options, design=msgspec.convert(design, Design))
    fit = msgspec.convert({**msgspec.to_builtins(options.fit), **parts["fit"]}, FitConfig)
    return options.with_fit(**{name: getattr(fit, name) for name in parts["fit"]})


def _resolve_pair(path: Path, index: int, pair: Pair, most: int) -> Pair:
    """Make paths absolute. Raises InputError for missing files, and for more secrets than `most`."""
    where = f"{path}: pairs[{index}]"
    secrets, models = len(pair.secrets), len(pair.secret_models)
    if secrets > most:
        raise InputError(f"{where}.secrets: expected at most {most}, got {secrets}")
    if models not in (0, secrets):
        raise InputError(f"{where}.secret_models: expected none or one for each secret, got {models}")

    def absolute(name: str, value: str) -> str:
        whole = os.path.realpath(path.parent / os.path.expanduser(value))
        if not os.path.exists(whole):
            raise InputError(f"{where}.{name}: there is no {value}")
        return whole

    return msgspec.structs.replace(
        pair,
        name=pair.name or "-".join(Path(source).stem for source in (pair.cover, *pair.secrets)),
        cover=absolute("cover", pair.cover),
        secrets=tuple(absolute("secrets", source) for source in pair.secrets),
        cover_model=pair.cover_model and absolute("cover_model", pair.cover_model),
        secret_models=tuple(absolute("secret_models", source) for source in pair.secret_models),
    )


def sweep(
    spec: PathLike,
    out: PathLike,
    *,
    ray: str | None = None,
    cores: int = 1,
    dry_run: bool = False,
    reporter: Reporter | None = None,
) -> tuple[Outcome, ...] | Forecast:
    """Run all unfinished trials of a specification, write tables of all results, and return the outcomes.

    Trials run one after the other in this process, or in parallel on a Ray cluster. `ray`: its address, or
    "local" for one on this machine; `cores`: cores per trial there. `dry_run`: only return the costs of the
    trials. Keys are derived from the trials' names and a master key in the private part of `out`, which is
    made if there is none. Raises KeyssError and KeyboardInterrupt; the outcomes of failed trials have the
    errors.
    """
    path = Path(spec)
    spec_ = read_spec(path)
    common = {name: getattr(spec_, name) for name in ("min_psnr", "bound", "device")}
    common["views"] = ViewOptions(spec_.width, spec_.background, spec_.skip_missing)
    folder = TrialFolder(Path(out), common)
    for pair, (method, preset, choices), seed in product(spec_.pairs, variants(path, spec_), spec_.seeds):
        options = preset.with_fit(seed=seed)
        sources = [pair.cover, *pair.secrets]
        given = [pair.cover_model, *(pair.secret_models or [None] * len(pair.secrets))]
        models = [
            model if model or is_model(source) else folder.plain(source, config, f"seed {config.seed}")
            for source, model, config in zip(sources, given, options.fits(len(sources)), strict=True)
        ]
        chosen = "".join(f" {name}={value}" for name, value in choices.items())
        name = f"{pair.name} {method}{chosen} seed {seed}"
        labels = {"pair": pair.name, "method": method, **choices}
        folder.hiding(name, sources, options, models, labels=labels, measures=spec_.evaluate)
    if dry_run:
        return folder.forecast(reporter)
    outcomes = folder.run(ray=ray, cores=cores, reporter=reporter)
    write_sweep_tables(folder.out, outcomes.values())
    return tuple(outcome for outcome in outcomes.values() if outcome.trial.secrets)
