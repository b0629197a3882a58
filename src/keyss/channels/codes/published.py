"""Models as they are published: in what formats the last bits of codes can carry, by the name users give."""

from __future__ import annotations

import importlib
from typing import Any

from keyss.channels.codes.channel import CodesCover
from keyss.core.gaussians import Gaussians
from keyss.files.formats.common import CodedGaussians, Codes, in_morton_order, writable

# By name: the module of the format, whether its writer sorts models, and how its files end.
_FORMATS = {
    "spz": ("spz", False, ".spz"),
    "sog": ("sog", True, ".sog"),
    "compressed-ply": ("compressed_ply", True, ".compressed.ply"),
}
SUFFIXES = {name: suffix for name, (_, _, suffix) in _FORMATS.items()}


def prepare(model: Gaussians, name: str) -> CodesCover:
    """The room in the codes of a model in the format of that name; of a file's model, in those of the file.

    Raises OutputError for what the format does not hold, InputError as `CodesCover.of` does.
    """
    module, sorts, _ = _FORMATS[name]
    format_ = importlib.import_module(f"keyss.files.formats.{module}")
    if isinstance(model, CodedGaussians):
        own = model.codes
        if type(own).__module__ == format_.__name__:
            return CodesCover.of(own)
    model = writable(model)
    model = in_morton_order(model) if sorts else model.detach().to("cpu")
    return CodesCover.of(format_.quantise(model), model)


def coded(codes: Codes) -> CodedGaussians:
    """The model that codes stand for, with them."""
    format_: Any = importlib.import_module(type(codes).__module__)
    return CodedGaussians.of(format_.dequantise(codes), codes)


def suffix_of(model: Gaussians) -> str:
    """How the name of a file ends that keeps all that a model carries."""
    if not isinstance(model, CodedGaussians):
        return ".ply"
    home = type(model.codes).__module__.rpartition(".")[2]
    return next(suffix for module, _, suffix in _FORMATS.values() if module == home)
