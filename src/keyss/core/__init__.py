"""Plain data: Gaussians, cameras, scenes, similarity transforms, errors."""

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
