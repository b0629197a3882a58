"""The file of a sweep: which pairs, methods, options and seeds, as YAML.

    pairs:
      - cover: scenes/bonsai
        secrets: [scenes/fox]
    methods:
      - method: carry
        options: {prune_to_fit: true}
      - method: keyss
        preset: quick
        grid: {sh_degree: [1, 3], fit.iterations: [500, 1000]}
    seeds: [0, 1, 2]

Everything is checked before anything runs: names of fields, types, options of methods, and that files are
there. Paths are relative to the folder of the file.
"""

from __future__ import annotations

import os
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from itertools import product
from math import prod
from pathlib import Path
from typing import Any, Literal

import msgspec

from keyss.audits import PARTS
from keyss.core.errors import BackendError, InputError, KeyssError
from keyss.core.nearest import did_you_mean
from keyss.core.scene import ViewOptions
from keyss.files.reading import read_text
from keyss.fitting.config import MAX_SEED, PRESETS, FitConfig
from keyss.methods import registry
from keyss.methods.base import MethodOptions

MAX_BYTES = 1 << 20  # of the file
MAX_DEEP = 20  # nested brackets
MAX_CELLS = 100_000
_FIT = "fit"  # the options of training lie below it


@dataclass(frozen=True, kw_only=True)
class Pair:
    """A cover and what is hidden in it: scenes or models."""

    cover: str
    secrets: tuple[str, ...]
    name: str | None = None
    cover_model: str | None = None  # plain models of scenes, if there are any
    secret_models: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class MethodSpec:
    """A method, and those of its options that differ from the preset's."""

    method: str
    name: str | None = None
    preset: str | None = None  # "default"
    options: dict[str, Any] = field(default_factory=dict)
    grid: dict[str, list[Any]] = field(default_factory=dict)  # values of options, each with each


@dataclass(frozen=True, kw_only=True)
class SweepSpec:
    """A sweep as its file has it."""

    pairs: tuple[Pair, ...]
    methods: tuple[MethodSpec, ...]
    seeds: tuple[int, ...] = (0,)
    evaluate: tuple[str, ...] = ()  # parts of an audit, beyond what `keyss hide` measures
    width: int | None = None
    background: tuple[float, float, float] | None = None
    skip_missing: bool = False
    min_psnr: float = 0.0
    bound: bool = False
    device: Literal["auto", "cpu", "cuda"] = "auto"

    @property
    def common(self) -> dict[str, Any]:
        """What all cells have."""
        views = ViewOptions(self.width, self.background, self.skip_missing)
        own = {"min_psnr": self.min_psnr, "bound": self.bound, "device": self.device}
        return {"views": views, **own}


@dataclass(frozen=True)
class Variant:
    """A method with one choice of options."""

    name: str  # of the method, as the file has it
    method: str
    options: MethodOptions
    choices: Mapping[str, Any]  # from the grid


def read_spec(path: Path) -> SweepSpec:
    """The sweep in a file, with absolute paths. Raises InputError, and BackendError without PyYAML."""
    try:
        import yaml
    except ImportError as error:
        raise BackendError(f"sweeps need the package pyyaml (pip install 'keyss[sweep]'): {error}") from error
    text = read_text(path, MAX_BYTES)
    try:
        opening = (yaml.FlowSequenceStartToken, yaml.FlowMappingStartToken)
        closing = (yaml.FlowSequenceEndToken, yaml.FlowMappingEndToken)
        depth = 0
        for token in yaml.scan(text, yaml.SafeLoader):
            # A few aliases of aliases can expand to more than memory holds.
            if isinstance(token, yaml.AliasToken):
                raise InputError(f"{path}: aliases (*name) are not read: write it out")
            depth += isinstance(token, opening) - isinstance(token, closing)
            if depth > MAX_DEEP:  # the time grows with its square
                raise InputError(f"{path}: brackets are nested more than {MAX_DEEP} deep")
        data = yaml.safe_load(text)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise InputError(f"{path}: expected YAML: {' '.join(str(error).split())}") from error
    _check_names(path, data)
    try:
        spec = msgspec.convert(data, SweepSpec)
    except (msgspec.ValidationError, RecursionError) as error:
        raise InputError(f"{path}: {error}") from error
    _check_values(path, spec)
    base = path.absolute().parent
    pairs = tuple(_found(path, base, index, pair) for index, pair in enumerate(spec.pairs))
    spec = replace(spec, pairs=pairs)
    for _ in variants(path, spec):  # refuses
        pass
    return spec


def variants(path: Path, spec: SweepSpec) -> Iterator[Variant]:
    """Every method with every choice of its grid. Raises InputError for options that it does not have."""
    for index, entry in enumerate(spec.methods):
        where = f"{path}: methods[{index}]"
        preset = registry.get(entry.method).options.preset(entry.preset or "default")
        for values in product(*entry.grid.values()):
            choices = dict(zip(entry.grid, values, strict=True))
            options = _options(where, preset, entry.options, choices)
            yield Variant(entry.name or entry.method, entry.method, options, choices)


def label(pair: Pair) -> str:
    """The name of a pair in tables."""
    return pair.name or "-".join(Path(each).stem for each in (pair.cover, *pair.secrets))


def _options(
    where: str, preset: MethodOptions, given: Mapping[str, Any], choices: Mapping[str, Any]
) -> MethodOptions:
    inner = given.get(_FIT, {})
    if not isinstance(inner, dict):
        raise InputError(f"{where}: options.fit: expected a mapping, got {inner!r}")
    flat = {name: value for name, value in given.items() if name != _FIT}
    flat |= {f"{_FIT}.{name}": value for name, value in inner.items()} | dict(choices)
    training = {f"{_FIT}.{name}" for name in _names(FitConfig) - {"seed"}}
    _check_known(f"{where}: options", flat, (_names(type(preset)) - {_FIT}) | training)
    changes = {name: value for name, value in flat.items() if name not in training}
    fit = {name.removeprefix(f"{_FIT}."): value for name, value in flat.items() if name in training}
    try:
        typed = _typed(type(preset), preset, changes)
        fitted = _typed(FitConfig, preset.fit, fit)
        options = replace(preset, **{name: getattr(typed, name) for name in changes})
        return options.with_fit(**{name: getattr(fitted, name) for name in fit})
    except (KeyssError, msgspec.ValidationError) as error:
        raise InputError(f"{where}: options: {error}") from error


def _typed(kind: Any, base: Any, changes: Mapping[str, Any]) -> Any:
    """`base` with changes of the types that `kind` states. Raises ValidationError, and what `kind` does."""
    return msgspec.convert({**msgspec.to_builtins(base), **changes}, kind)


def _check_names(path: Path, data: Any) -> None:
    """Raise InputError for fields that do not exist: a misspelt one must not be ignored."""
    if not isinstance(data, dict):
        raise InputError(f"{path}: expected a mapping with pairs and methods, got {type(data).__name__}")
    _check_known(str(path), data, _names(SweepSpec))
    for name, kind in (("pairs", Pair), ("methods", MethodSpec)):
        listed = data.get(name)
        for index, each in enumerate(listed if isinstance(listed, list) else ()):
            if isinstance(each, dict):
                _check_known(f"{path}: {name}[{index}]", each, _names(kind))


def _check_known(where: str, given: Collection[Any], known: Collection[str]) -> None:
    for each in given:
        if each not in known:
            name = str(each)
            raise InputError(f"{where}: {name[:60]!r} is not known; {did_you_mean(name, known)}")


def _names(kind: Any) -> set[str]:
    return {each.name for each in fields(kind)}


def _check_values(path: Path, spec: SweepSpec) -> None:
    for name in ("pairs", "methods", "seeds"):
        if not getattr(spec, name):
            raise InputError(f"{path}: {name}: expected at least one")
    _check_known(f"{path}: evaluate", spec.evaluate, PARTS)
    for seed in spec.seeds:
        if not 0 <= seed <= MAX_SEED:
            raise InputError(f"{path}: seeds: expected 0 to {MAX_SEED}, got {seed}")
    if len(set(spec.seeds)) < len(spec.seeds):
        raise InputError(f"{path}: seeds: the same one is there twice")
    _check_different(f"{path}: pairs", [label(pair) for pair in spec.pairs])
    _check_different(f"{path}: methods", [entry.name or entry.method for entry in spec.methods])
    grids = 0
    for index, entry in enumerate(spec.methods):
        where = f"{path}: methods[{index}]"
        _check_known(f"{where}.method", [entry.method], registry.METHODS)
        if entry.preset is not None:
            _check_known(f"{where}.preset", [entry.preset], PRESETS)
        for name, values in entry.grid.items():
            if not values:
                raise InputError(f"{where}: grid.{name}: expected at least one value")
            if name in entry.options:
                raise InputError(f"{where}: {name} is among the options and in the grid")
        grids += prod(len(values) for values in entry.grid.values())
    count = len(spec.pairs) * len(spec.seeds) * grids
    if count > MAX_CELLS:
        raise InputError(f"{path}: expected at most {MAX_CELLS:,} cells, got {count:,}")
    most = min(registry.get(each.method).most_secrets for each in spec.methods)
    for index, pair in enumerate(spec.pairs):
        where, secrets = f"{path}: pairs[{index}]", len(pair.secrets)
        if not 1 <= secrets <= most:
            raise InputError(f"{where}.secrets: expected 1 to {most}, got {secrets}")
        if len(pair.secret_models) not in (0, secrets):
            raise InputError(
                f"{where}.secret_models: expected none or one for each secret, got {len(pair.secret_models)}"
            )


def _check_different(where: str, labels: Sequence[str]) -> None:
    """Raise InputError for equal names: the tables would take them for seeds of one."""
    for index, each in enumerate(labels):
        if (first := labels.index(each)) < index:
            raise InputError(f"{where}[{index}]: called {each!r} as [{first}] is: give one a `name`")


def _found(path: Path, base: Path, index: int, pair: Pair) -> Pair:
    """The pair with absolute paths. Raises InputError for a missing one."""

    def found(name: str, value: str) -> str:
        if "\0" in value:
            raise InputError(f"{path}: pairs[{index}].{name}: expected a path, got {value!r}")
        whole = os.path.realpath(os.path.join(base, os.path.expanduser(value)))
        if not os.path.exists(whole):
            raise InputError(f"{path}: pairs[{index}].{name}: there is no {value}")
        return whole

    return Pair(
        cover=found("cover", pair.cover),
        secrets=tuple(found("secrets", each) for each in pair.secrets),
        name=pair.name,
        cover_model=pair.cover_model and found("cover_model", pair.cover_model),
        secret_models=tuple(found("secret_models", each) for each in pair.secret_models),
    )
