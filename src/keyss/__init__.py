"""Hide a 3D Gaussian Splatting scene inside another one and open it only with a key.

    from keyss import Secret, hide, reveal

    hide("scenes/garden", [Secret("scenes/treasure", key)], width=400, out="runs/hidden")
    reveal("runs/hidden/publish/stego.ply", key, out="treasure.ply")

The names below are loaded at first use (PEP 562), so that the command line answers at once.
"""

import importlib
from typing import TYPE_CHECKING, Any

from keyss import _threads  # noqa: F401  before anything imports torch
from keyss._version import __version__

if TYPE_CHECKING:
    from keyss.api import HideResult, Secret, evaluate, fit, hide, render, reveal, verify
    from keyss.core import Camera, Gaussians, KeyssError, KeyssWarning, Scene, View, WrongKeyError
    from keyss.files import load_scene, read_model, write_model
    from keyss.fitting import FitConfig
    from keyss.keys import generate_key
    from keyss.methods.registry import CarryOptions, LearnedOptions
    from keyss.runs.describe import info

__all__ = ["HideResult", "Secret", "__version__", "evaluate", "fit", "hide", "render", "reveal", "verify"]
__all__ += ["Camera", "Gaussians", "KeyssError", "KeyssWarning", "Scene", "View", "WrongKeyError"]
__all__ += ["CarryOptions", "FitConfig", "LearnedOptions"]
__all__ += ["generate_key", "info", "load_scene", "read_model", "write_model"]

# Where they are, what is quickly imported first: the first of these modules that has a name gives it.
_HOMES = ("core", "keys", "files", "fitting", "methods.registry", "runs.describe", "api")


def __getattr__(name: str) -> Any:
    for home in _HOMES if name in __all__ else ():
        module = importlib.import_module(f"keyss.{home}")
        if hasattr(module, name):
            globals()[name] = value = getattr(module, name)
            return value
    raise AttributeError(f"module 'keyss' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
