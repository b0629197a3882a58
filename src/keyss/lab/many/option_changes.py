"""Options of a method with changes by name: `publish`, `fit.iterations`, `design.points`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, replace
from typing import Any

import msgspec

from keyss.fitting import FitConfig
from keyss.methods import Design, KeyssOptions, MethodOptions

FIT, DESIGN = "fit", "design"  # prefixes: options of training, fields of a design of KeySS


def known_changes(preset: MethodOptions) -> set[str]:
    """Names of options that `with_changes` accepts."""
    known = {each.name for each in fields(preset)} - {FIT}
    known |= {f"{FIT}.{each.name}" for each in fields(FitConfig) if each.name != "seed"}
    if isinstance(preset, KeyssOptions):
        known |= {f"{DESIGN}.{each.name}" for each in fields(Design)}
    return known


def with_changes(preset: MethodOptions, changes: Mapping[str, Any]) -> MethodOptions:
    """The preset with changed options. Raises UsageError and msgspec.ValidationError for wrong values."""
    parts: dict[str, dict[str, Any]] = {FIT: {}, DESIGN: {}, "": {}}
    for name, value in changes.items():
        prefix, _, field = name.rpartition(".")
        parts[prefix][field] = value
    options = msgspec.convert({**msgspec.to_builtins(preset), **parts[""]}, type(preset))
    if parts[DESIGN] and isinstance(options, KeyssOptions):
        design = {**msgspec.to_builtins(options.configuration), **parts[DESIGN]}
        options = replace(options, design=msgspec.convert(design, Design))
    fit = msgspec.convert({**msgspec.to_builtins(options.fit), **parts[FIT]}, FitConfig)
    return options.with_fit(**{name: getattr(fit, name) for name in parts[FIT]})
