"""The file of a sweep: which pairs, methods, options and seeds, as YAML.

    pairs:
      - cover: scenes/bonsai
        secrets: [scenes/fox]
    methods:
      - method: carry
        options: {prune_to_fit: true}
      - method: learned
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
from pathlib import Path
from typing import Any, Literal

import msgspec

from keyss.audit.parts import PARTS
from keyss.core.errors import BackendError, InputError, KeyssError
from keyss.core.nearest import nearest
from keyss.files.reading import read_text
from keyss.fitting.config import MOST_SEED, FitConfig
from keyss.methods import registry
from keyss.methods.base import MethodOptions

MOST_BYTES = 1 << 20  # of the file
MOST_DEEP = 20  # brackets in brackets
MOST_CELLS = 100_000
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
    """A method, and of its options those that differ from the preset's."""

    method: str
    name: str | None = None
    preset: str | None = None  # the method's first
    options: dict[str, Any] = field(default_factory=dict)
    grid: dict[str, list[Any]] = field(default_factory=dict)  # values of options, each with each


@dataclass(frozen=True, kw_only=True)
class SweepSpec:
    """A sweep as it stands in its file."""

    pairs: tuple[Pair, ...]
    methods: tuple[MethodSpec, ...]
    seeds: tuple[int, ...] = (0,)
    evaluate: tuple[str, ...] = ()  # parts of an audit; what `keyss hide` measures is always there
    width: int | None = None
    background: tuple[float, float, float] | None = None
    skip_missing: bool = False
    min_psnr: float = 0.0
    device: Literal["auto", "cpu", "cuda"] = "auto"


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
    text = read_text(path, MOST_BYTES)
    try:
        opening = (yaml.FlowSequenceStartToken, yaml.FlowMappingStartToken)
        closing = (yaml.FlowSequenceEndToken, yaml.FlowMappingEndToken)
        depth = 0
        for token in yaml.scan(text, yaml.SafeLoader):
            # A few aliases of aliases stand for more than memory holds.
            if isinstance(token, yaml.AliasToken):
                raise InputError(f"{path}: aliases (*name) are not read: write it out")
            depth += isinstance(token, opening) - isinstance(token, closing)
            if depth > MOST_DEEP:  # of which the time grows with the square
                raise InputError(f"{path}: brackets are nested more than {MOST_DEEP} deep")
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
    for index, asked in enumerate(spec.methods):
        where = f"{path}: methods[{index}]"
        method = registry.METHODS[asked.method]
        preset = method.presets[asked.preset or next(iter(method.presets))]
        for values in product(*asked.grid.values()):
            choices = dict(zip(asked.grid, values, strict=True))
            options = _options(where, preset, asked.options, choices)
            yield Variant(asked.name or asked.method, asked.method, options, choices)


def label(pair: Pair) -> str:
    """What a pair is called in tables."""
    return pair.name or "-".join(Path(each).stem for each in (pair.cover, *pair.secrets))


def _options(
    where: str, preset: MethodOptions, given: Mapping[str, Any], choices: Mapping[str, Any]
) -> MethodOptions:
    own = {each.name for each in fields(preset)} - {_FIT}
    training = {each.name for each in fields(FitConfig)} - {"seed"}
    changes, fit = {}, {}
    inner = given.get(_FIT, {})
    if not isinstance(inner, dict):
        raise InputError(f"{where}: options.fit: expected a mapping, got {inner!r}")
    every = {name: value for name, value in given.items() if name != _FIT}
    every |= {f"{_FIT}.{name}": value for name, value in inner.items()} | dict(choices)
    for name, value in every.items():
        if name.startswith(f"{_FIT}."):
            short = name.removeprefix(f"{_FIT}.")
            _known(f"{where}: options.fit", {short}, training)
            fit[short] = value
        else:
            _known(f"{where}: options", {name}, own | {f"{_FIT}.{each}" for each in training})
            changes[name] = value
    try:
        typed = _typed(type(preset), preset, changes)
        fitted = _typed(FitConfig, preset.fit, fit)
        options = preset.adapted(**{name: getattr(typed, name) for name in changes})
        return options.with_fit(**{name: getattr(fitted, name) for name in fit})
    except (KeyssError, msgspec.ValidationError) as error:
        raise InputError(f"{where}: options: {error}") from error


def _typed(kind: Any, base: Any, changes: Mapping[str, Any]) -> Any:
    """`base` with changes of the types that `kind` states. Raises ValidationError, and what `kind` does."""
    return msgspec.convert({**msgspec.to_builtins(base), **changes}, kind)


def _check_names(path: Path, data: Any) -> None:
    """Raise InputError for fields that there are not: what is misspelt must not be passed over."""
    if not isinstance(data, dict):
        raise InputError(f"{path}: expected a mapping with pairs and methods, got {type(data).__name__}")
    _known(str(path), data, _names(SweepSpec))
    for name, kind in (("pairs", Pair), ("methods", MethodSpec)):
        listed = data.get(name)
        for index, each in enumerate(listed if isinstance(listed, list) else ()):
            if isinstance(each, dict):
                _known(f"{path}: {name}[{index}]", each, _names(kind))


def _known(where: str, given: Collection[Any], known: Collection[str]) -> None:
    for name in given:
        if name not in known:
            near = nearest(str(name), known) if isinstance(name, str) else None
            meant = f"did you mean {near}?" if near else f"there are {', '.join(sorted(known))}"
            raise InputError(f"{where}: no field is called {str(name)[:60]!r}; {meant}")


def _names(kind: Any) -> set[str]:
    return {each.name for each in fields(kind)}


def _check_values(path: Path, spec: SweepSpec) -> None:
    for name in ("pairs", "methods", "seeds"):
        if not getattr(spec, name):
            raise InputError(f"{path}: {name}: expected at least one")
    _known_values(f"{path}: evaluate", spec.evaluate, PARTS)
    for seed in spec.seeds:
        if not 0 <= seed <= MOST_SEED:
            raise InputError(f"{path}: seeds: expected 0 to {MOST_SEED}, got {seed}")
    if len(set(spec.seeds)) < len(spec.seeds):
        raise InputError(f"{path}: seeds: the same one is there twice")
    _check_different(f"{path}: pairs", [label(pair) for pair in spec.pairs])
    _check_different(f"{path}: methods", [asked.name or asked.method for asked in spec.methods])
    count = len(spec.pairs) * len(spec.seeds)
    grids = 0
    for index, asked in enumerate(spec.methods):
        where = f"{path}: methods[{index}]"
        _known_values(f"{where}.method", [asked.method], registry.METHODS)
        method = registry.METHODS[asked.method]
        if asked.preset is not None:
            _known_values(f"{where}.preset", [asked.preset], method.presets)
        size = 1
        for name, values in asked.grid.items():
            if not values:
                raise InputError(f"{where}: grid.{name}: expected at least one value")
            if name in asked.options:
                raise InputError(f"{where}: {name} is among the options and in the grid")
            size *= len(values)
        grids += size
    if count * grids > MOST_CELLS:
        raise InputError(f"{path}: expected at most {MOST_CELLS:,} cells, got {count * grids:,}")
    for index, pair in enumerate(spec.pairs):
        most = min(registry.METHODS[each.method].most_secrets for each in spec.methods)
        if not 1 <= len(pair.secrets) <= most:
            raise InputError(f"{path}: pairs[{index}].secrets: expected 1 to {most}, got {len(pair.secrets)}")
        if pair.secret_models and len(pair.secret_models) != len(pair.secrets):
            raise InputError(
                f"{path}: pairs[{index}].secret_models: expected none or one for each secret, got "
                f"{len(pair.secret_models)}"
            )


def _check_different(where: str, labels: Sequence[str]) -> None:
    """Raise InputError for two that the tables would take for seeds of one."""
    for index, each in enumerate(labels):
        if (first := labels.index(each)) < index:
            raise InputError(f"{where}[{index}]: called {each!r} as [{first}] is: give one a `name`")


def _known_values(where: str, values: Collection[str], known: Collection[str]) -> None:
    for value in values:
        if value not in known:
            near = nearest(value, known)
            meant = f"did you mean {near}?" if near else f"expected {', '.join(known)}"
            raise InputError(f"{where}: {value[:60]!r} is not known; {meant}")


def _found(path: Path, base: Path, index: int, pair: Pair) -> Pair:
    """The pair with absolute paths. Raises InputError for one that is not there."""

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
