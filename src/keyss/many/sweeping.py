"""`sweep`: the cells of a specification, and the tables of their results.

The file of a sweep lists pairs, methods, options and seeds, as YAML:

    pairs:
      - cover: scenes/bonsai
        secrets: [scenes/fox]
    methods:
      - method: carry
        options: {prune_to_fit: true}
      - method: keyss
        preset: quick
        grid: {design: [published, latent], fit.iterations: [500, 1000]}
    seeds: [0, 1, 2]

Everything is checked before anything runs: names of fields, types, options of methods, and that files exist.
Paths are relative to the folder of the file.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from math import prod
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta

from keyss.audits import PARTS
from keyss.core.errors import InputError, KeyssError, did_you_mean, import_extra
from keyss.core.scene import ViewOptions
from keyss.files.reading import read_text
from keyss.fitting.config import MAX_SEED, PRESETS
from keyss.keys.key_file import read_key
from keyss.many.changes import FIT, known_changes, with_changes
from keyss.many.running import RETRIES, CellFolder, Forecast, ManyResult, Outcome
from keyss.many.tables import CellNumbers, write_tables
from keyss.methods import registry
from keyss.methods.base import MethodOptions
from keyss.rendering.orbit import is_model
from keyss.runs.files import PathLike

MAX_BYTES = 1 << 20  # of the file
MAX_CELLS = 100_000
_AT_LEAST_ONE = Meta(min_length=1)
# Numbers that differ from run to run, or repeat arguments.
_NO_MEASURES = {"seconds", "seed", "version", "width"}


class Pair(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A cover and its secrets: scenes or models."""

    cover: str
    secrets: Annotated[tuple[str, ...], _AT_LEAST_ONE]
    name: str | None = None
    cover_model: str | None = None  # plain models of scenes; None: fitted
    secret_models: tuple[str, ...] = ()

    @property
    def label(self) -> str:
        """The name of the pair in tables."""
        return self.name or "-".join(Path(source).stem for source in (self.cover, *self.secrets))


class MethodSpec(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A method, and options that override its preset."""

    method: Literal[tuple(registry.METHODS)]  # type: ignore[valid-type]
    name: str | None = None
    preset: Literal[tuple(PRESETS)] = "default"  # type: ignore[valid-type]
    options: dict[str, Any] = {}
    grid: dict[str, Annotated[list[Any], _AT_LEAST_ONE]] = {}  # values of options, in all combinations

    @property
    def label(self) -> str:
        """The name of the method in tables."""
        return self.name or self.method


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

    @property
    def common(self) -> dict[str, Any]:
        """The fields of all cells."""
        views = ViewOptions(self.width, self.background, self.skip_missing)
        return {"views": views, "min_psnr": self.min_psnr, "bound": self.bound, "device": self.device}


@dataclass(frozen=True)
class Variant:
    """A method with one choice of options."""

    name: str  # of the method in tables
    options: MethodOptions
    choices: Mapping[str, Any]  # from the grid


def read_spec(path: Path) -> SweepSpec:
    """The sweep in a file, with absolute paths. Raises InputError, and BackendError without PyYAML."""
    try:
        spec = msgspec.convert(_yaml(path), SweepSpec)
    except (msgspec.ValidationError, RecursionError) as error:
        raise InputError(f"{path}: {error}{_suggestion(str(error))}") from error
    _check_values(path, spec)
    base = path.absolute().parent
    pairs = tuple(_with_absolute_paths(path, base, index, pair) for index, pair in enumerate(spec.pairs))
    for _ in variants(path, spec):  # raises InputError
        pass
    return msgspec.structs.replace(spec, pairs=pairs)


def variants(path: Path, spec: SweepSpec) -> Iterator[Variant]:
    """Every method with every combination of its grid. Raises InputError for invalid options."""
    for index, entry in enumerate(spec.methods):
        preset = registry.get(entry.method).options.preset(entry.preset)
        for values in product(*entry.grid.values()):
            choices = dict(zip(entry.grid, values, strict=True))
            options = _options(f"{path}: methods[{index}]: options", preset, {**entry.options, **choices})
            yield Variant(entry.label, options, choices)


def _yaml(path: Path) -> Any:
    """Raises InputError for anything but plain YAML, BackendError without PyYAML."""
    yaml = import_extra("yaml", "sweep", "read sweeps")

    class Loader(yaml.SafeLoader):  # type: ignore[name-defined, misc]
        def compose_node(self, parent: Any, index: Any) -> Any:
            if self.check_event(yaml.AliasEvent):  # a few, nested, can expand to more than memory holds
                raise InputError(f"{path}: aliases (*name) are not supported: repeat what they stand for")
            return super().compose_node(parent, index)

    text = read_text(path, MAX_BYTES)
    try:
        return yaml.load(text, Loader)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise InputError(f"{path}: expected YAML: {' '.join(str(error).split())}") from error


def _suggestion(message: str) -> str:
    """The end of a message about an unknown field: the nearest known name."""
    if field := re.search(r"unknown field `(.+?)`", message):
        kinds = (SweepSpec, Pair, MethodSpec)
        return f"; {did_you_mean(field[1], [name for kind in kinds for name in kind.__struct_fields__])}"
    if value := re.search(r"enum value '(.+?)' ", message):
        return f"; {did_you_mean(value[1], [*registry.METHODS, *PRESETS, *PARTS])}"
    return ""


def _options(where: str, preset: MethodOptions, given: Mapping[str, Any]) -> MethodOptions:
    """The preset with changed options; those of training are in a mapping `fit` or named `fit.NAME`."""
    nested = given.get(FIT, {})
    if not isinstance(nested, dict):
        raise InputError(f"{where}.fit: expected a mapping, got {nested!r}")
    flat = {f"{FIT}.{name}": value for name, value in nested.items()}
    flat |= {name: value for name, value in given.items() if name != FIT}
    known = known_changes(preset)
    for name in flat:
        if name not in known:
            raise InputError(f"{where}: {str(name)[:60]!r} is unknown; {did_you_mean(str(name), known)}")
    try:
        return with_changes(preset, flat)
    except (KeyssError, msgspec.ValidationError) as error:
        raise InputError(f"{where}: {error}") from error


def _check_values(path: Path, spec: SweepSpec) -> None:
    """Raise InputError for constraints that types cannot express."""
    if len(set(spec.seeds)) < len(spec.seeds):
        raise InputError(f"{path}: seeds: expected different ones, got one twice")
    _check_labels(f"{path}: pairs", [pair.label for pair in spec.pairs])
    _check_labels(f"{path}: methods", [entry.label for entry in spec.methods])
    for index, entry in enumerate(spec.methods):
        for name in entry.grid.keys() & entry.options.keys():
            raise InputError(f"{path}: methods[{index}]: {name} is both in the options and in the grid")
    choices = sum(prod(map(len, entry.grid.values())) for entry in spec.methods)
    count = len(spec.pairs) * len(spec.seeds) * choices
    if count > MAX_CELLS:
        raise InputError(f"{path}: expected at most {MAX_CELLS:,} cells, got {count:,}")
    most = min(registry.get(entry.method).max_secrets for entry in spec.methods)
    for index, pair in enumerate(spec.pairs):
        where, secrets, models = f"{path}: pairs[{index}]", len(pair.secrets), len(pair.secret_models)
        if secrets > most:
            raise InputError(f"{where}.secrets: expected at most {most}, got {secrets}")
        if models not in (0, secrets):
            raise InputError(f"{where}.secret_models: expected none or one for each secret, got {models}")


def _check_labels(where: str, labels: Sequence[str]) -> None:
    """Raise InputError for equal names: the tables would take them for seeds of one."""
    for index, label in enumerate(labels):
        if (first := labels.index(label)) < index:
            raise InputError(f"{where}[{index}]: has the name {label!r} of [{first}]: give it another `name`")


def _with_absolute_paths(path: Path, base: Path, index: int, pair: Pair) -> Pair:
    """Raises InputError for a missing path."""

    def absolute(name: str, value: str) -> str:
        if "\0" in value:
            raise InputError(f"{path}: pairs[{index}].{name}: expected a path, got {value!r}")
        whole = os.path.realpath(os.path.join(base, os.path.expanduser(value)))
        if not os.path.exists(whole):
            raise InputError(f"{path}: pairs[{index}].{name}: there is no {value}")
        return whole

    return msgspec.structs.replace(
        pair,
        cover=absolute("cover", pair.cover),
        secrets=tuple(absolute("secrets", each) for each in pair.secrets),
        cover_model=pair.cover_model and absolute("cover_model", pair.cover_model),
        secret_models=tuple(absolute("secret_models", each) for each in pair.secret_models),
    )


def sweep(
    spec: PathLike,
    out: PathLike,
    *,
    master_key_file: PathLike | None = None,
    jobs: int | None = None,
    ray: str | None = None,
    retries: int = RETRIES,
    dry_run: bool = False,
) -> ManyResult | Forecast:
    """Run all cells of a specification that are not done, and write the tables of all that are.

    `jobs`: cells at once, among which the cores are divided; by default as many as cores and memory allow.
    `ray`: address of a Ray cluster, or "local". `retries`: of a cell whose process died.
    `dry_run`: only return the plans of the cells. Keys are derived from a master key and the cells' names:
    the one in `master_key_file`, or a new one in the private part of `out`. Raises KeyssError and its
    children; a cell that fails is in the result.
    """
    path = Path(spec)
    found = read_spec(path)
    master = None if master_key_file is None else Path(master_key_file).absolute()
    if master is not None:
        read_key(master)
    folder = CellFolder(Path(out), master, found.common)
    rows = _rows(path, found, folder)
    if dry_run:
        return folder.forecast()
    outcomes = folder.run(f"sweep of {len(rows)} cells", jobs=jobs, ray=ray, retries=retries)
    ended = [replace(row, numbers=_numbers(outcomes[place])) for place, row in rows.items()]
    tables = write_tables(folder.out, [row for row in ended if row.numbers])
    return ManyResult(tuple(outcomes[place] for place in rows), tuple(tables))


def _rows(path: Path, spec: SweepSpec, folder: CellFolder) -> dict[Path, CellNumbers]:
    """Add all cells, in the order of pairs, methods, choices and seeds; a row for each, without numbers.

    Scenes without plain models share fits. Reads all data, for its checksums. Raises InputError.
    """
    found: dict[Path, CellNumbers] = {}
    for pair, variant, seed in product(spec.pairs, variants(path, spec), spec.seeds):
        options = variant.options.with_fit(seed=seed)
        sources = [pair.cover, *pair.secrets]
        given = [pair.cover_model, *(pair.secret_models or [None] * len(pair.secrets))]
        models = [
            model if model or is_model(source) else folder.plain(source, config)
            for source, model, config in zip(sources, given, options.fits(len(sources)), strict=True)
        ]
        chosen = "".join(f" {name}={value}" for name, value in variant.choices.items())
        name = f"{pair.label} {variant.name}{chosen} seed {seed}"
        place = folder.hiding(name, sources, options, models, measures=spec.evaluate)
        found.setdefault(place, CellNumbers(pair.label, variant.name, variant.choices, seed, place.name, {}))
    return found


def _numbers(outcome: Outcome) -> dict[str, float]:
    """The measurements of a cell, none if it failed."""
    numbers = outcome.result.numbers if outcome.result else {}
    return {name: value for name, value in numbers.items() if _NO_MEASURES.isdisjoint(name.split("."))}
