"""Hide a 3D Gaussian Splatting scene inside another one and open it only with a key.

    from keyss import Secret, hide, reveal

    hide("scenes/garden", [Secret("scenes/treasure", key)], width=400, out="runs/hidden")
    reveal("runs/hidden/stego.ply", key, out="treasure.ply")

The names below are loaded at first use (PEP 562), so that the command line answers at once.
"""

import importlib
from typing import TYPE_CHECKING, Any

from keyss import _threads  # noqa: F401  before anything imports torch
from keyss._version import __version__

if TYPE_CHECKING:
    from keyss.api import HideResult, Secret, evaluate, fit, hide, render, reveal
    from keyss.core import Camera, Gaussians, KeyssError, Scene, View, WrongKeyError
    from keyss.files import load_scene, read_model, write_model
    from keyss.fitting import FitConfig
    from keyss.keys import generate_key
    from keyss.methods.registry import CarryOptions, LearnedOptions
    from keyss.runs.describe import info

__all__ = [
    "Camera",
    "CarryOptions",
    "FitConfig",
    "Gaussians",
    "HideResult",
    "KeyssError",
    "LearnedOptions",
    "Scene",
    "Secret",
    "View",
    "WrongKeyError",
    "__version__",
    "evaluate",
    "fit",
    "generate_key",
    "hide",
    "info",
    "load_scene",
    "read_model",
    "render",
    "reveal",
    "write_model",
]

_HOMES = {
    "keyss.api": ("HideResult", "Secret", "evaluate", "fit", "hide", "render", "reveal"),
    "keyss.core": ("Camera", "Gaussians", "KeyssError", "Scene", "View", "WrongKeyError"),
    "keyss.files": ("load_scene", "read_model", "write_model"),
    "keyss.fitting": ("FitConfig",),
    "keyss.keys": ("generate_key",),
    "keyss.methods.registry": ("CarryOptions", "LearnedOptions"),
    "keyss.runs.describe": ("info",),
}
_HOME_OF = {name: home for home, names in _HOMES.items() for name in names}


def __getattr__(name: str) -> Any:
    if name not in _HOME_OF:
        raise AttributeError(f"module 'keyss' has no attribute {name!r}")
    value = getattr(importlib.import_module(_HOME_OF[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
