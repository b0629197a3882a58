"""Options of a method with changes by name: `publish`, `fit.iterations`, `design.points`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, replace
from typing import Any

import msgspec

from keyss.core import UsageError
from keyss.core.errors import did_you_mean
from keyss.fitting import FitConfig
from keyss.methods import Design, KeyssOptions, MethodOptions


def with_changes(preset: MethodOptions, changes: Mapping[str, Any]) -> MethodOptions:
    """The preset with changed options; prefixes: `fit` for training, `design` for a design of KeySS.

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
