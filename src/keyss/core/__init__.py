"""Plain data: Gaussians, cameras, scenes, similarity transforms, errors.

The names below are loaded at first use (PEP 562): errors must be there without torch, which takes seconds.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from keyss.core.errors import BackendError, InputError, KeyssError, OutputError, UsageError, WrongKeyError
    from keyss.core.gaussians import Gaussians
    from keyss.core.scene import Camera, Scene, View

__all__ = [
    "BackendError",
    "Camera",
    "Gaussians",
    "InputError",
    "KeyssError",
    "OutputError",
    "Scene",
    "UsageError",
    "View",
    "WrongKeyError",
]


def __getattr__(name: str) -> Any:
    for home in ("errors", "gaussians", "scene") if name in __all__ else ():
        module = importlib.import_module(f"keyss.core.{home}")
        if hasattr(module, name):
            globals()[name] = value = getattr(module, name)
            return value
    raise AttributeError(f"module 'keyss.core' has no attribute {name!r}")
