"""Plain data: Gaussians, cameras, scenes, similarity transforms, errors.

All but errors is loaded at first use (PEP 562): an error must be there without torch, which takes seconds.
"""

import importlib
from typing import TYPE_CHECKING, Any

from keyss.core.errors import (
    BackendError,
    InputError,
    KeyssError,
    KeyssWarning,
    OutputError,
    QualityError,
    UsageError,
    WrongKeyError,
)

if TYPE_CHECKING:
    from keyss.core.gaussians import Gaussians
    from keyss.core.scene import Camera, Scene, View

__all__ = [
    "BackendError",
    "Camera",
    "Gaussians",
    "InputError",
    "KeyssError",
    "KeyssWarning",
    "OutputError",
    "QualityError",
    "Scene",
    "UsageError",
    "View",
    "WrongKeyError",
]

_HOMES = {"Gaussians": "gaussians", "Camera": "scene", "Scene": "scene", "View": "scene"}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'keyss.core' has no attribute {name!r}")
    globals()[name] = value = getattr(importlib.import_module(f"keyss.core.{_HOMES[name]}"), name)
    return value
