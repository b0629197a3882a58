"""All methods, loaded on first use, like torch."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from operator import attrgetter
from typing import TYPE_CHECKING, Any, NamedTuple

from keyss.core.errors import InputError, UsageError

if TYPE_CHECKING:
    from keyss.channels import Payload
    from keyss.core.gaussians import Gaussians
    from keyss.methods.hidden import HiddenFile, HiddenScene
    from keyss.methods.method import Method, MethodOptions


class Modules(NamedTuple):
    """The parts of a method, as `module:name`."""

    summary: str  # one line, printed after the name
    options: str  # a `MethodOptions`, in a module that does not import torch
    hiding: str  # a `keyss.methods.method.Method`
    opening: str  # turns the payload of a channel or a companion file into a `HiddenScene`


def _baseline(module: str, options: str, summary: str) -> Modules:
    place = f"keyss.lab.baselines.{module}:METHOD"
    return Modules(summary, f"keyss.lab.baselines.baseline_options:{options}", place, f"{place}.unpack")


DEFAULT = "carry"
METHODS = {
    "carry": Modules(
        "the secrets' Gaussians, encrypted in the cover's",
        "keyss.methods.carry.carry_options:CarryOptions",
        "keyss.methods.carry.carry_method:METHOD",
        "keyss.methods.carry.carry_method:CarriedSecret.of",
    ),
    "keyss": Modules(
        "one model and a decoder for all keys, trained jointly",
        "keyss.methods.keyss.keyss_options:KeyssOptions",
        "keyss.methods.keyss.keyss_method:METHOD",
        "keyss.methods.keyss.keyss_method:KeyssSecret.of",
    ),
    "3dgs": _baseline("upper_bound", "BoundOptions", "upper bound: the secret is a separate file"),
    "3dgs-sh": _baseline(
        "second_harmonics", "ShOptions", "second harmonics for the secret, in a companion file (baseline)"
    ),
    "3dgs-decoder": _baseline(
        "picture_decoder",
        "DecoderOptions",
        "a network from the cover's picture to the secret's, in a companion file (baseline)",
    ),
    "watergs": _baseline(
        "watergs", "WaterGsOptions", "second harmonics and opacities, hidden in the first (baseline)"
    ),
    "gs-hider": _baseline(
        "gs_hider", "GsHiderOptions", "features in place of harmonics, and a network for each scene"
    ),
}


def _load(place: str) -> Any:
    module, name = place.split(":")
    return attrgetter(name)(import_module(module))


def options_of(name: str) -> type[MethodOptions]:
    """The class of a method's options, without torch. Raises UsageError."""
    options: type[MethodOptions] = _load(_modules(name).options)
    return options


def _modules(name: str) -> Modules:
    if name not in METHODS:
        raise UsageError(f"method {name!r}: expected {' or '.join(METHODS)}")
    return METHODS[name]


def get(name: str) -> Method:
    """The method of that name. Raises UsageError."""
    method: Method = _load(_modules(name).hiding)
    return method


def of_options(options: MethodOptions) -> Method:
    """The method with options of this class. Raises UsageError."""
    name = getattr(options, "method", None)
    if name not in METHODS or type(options) is not options_of(name):
        raise UsageError(f"expected options of a method ({', '.join(METHODS)}), got {type(options).__name__}")
    return get(name)


def open_secret(stego: Gaussians, key: str) -> HiddenScene | HiddenFile:
    """The secret that `key` opens in a model (see `keyss.channels.publishing`).

    Raises WrongKeyError for a key that opens nothing, InputError for damage.
    """
    from keyss.channels import open_payload
    from keyss.methods.hidden import FILE, HiddenFile

    payload = open_payload(stego, key)
    return HiddenFile.of(payload) if payload.method == FILE else _scene_of(payload)


def open_model(stego: Gaussians, key: str) -> HiddenScene:
    """The scene that `key` opens in a model; see `open_secret`. Raises InputError for a file."""
    from keyss.methods.hidden import HiddenFile

    secret = open_secret(stego, key)
    if isinstance(secret, HiddenFile):
        raise InputError(f"this key opens a file of {len(secret.data):,} bytes, not a scene")
    return secret


def open_companion(data: bytes) -> HiddenScene:
    """The secret in a companion file. Raises InputError."""
    from keyss.methods.hidden import unpack_companion

    return _scene_of(unpack_companion(data))


def _scene_of(payload: Payload) -> HiddenScene:
    name = payload.method
    if name not in METHODS:
        raise InputError(
            f"the secret was hidden by the method {name!r}; this program has {', '.join(METHODS)}"
        )
    unpack: Callable[[Payload], HiddenScene] = _load(METHODS[name].opening)
    return unpack(payload)
