"""Plain data: Gaussians, cameras, scenes, similarity transforms, errors."""

from keyss.core.errors import (
    BackendError,
    InputError,
    KeyssError,
    OutputError,
    QualityError,
    UsageError,
    WrongKeyError,
)
from keyss.core.gaussians import Gaussians
from keyss.core.scene import Camera, Scene, View

__all__ = [
    "BackendError",
    "Camera",
    "Gaussians",
    "InputError",
    "KeyssError",
    "OutputError",
    "QualityError",
    "Scene",
    "UsageError",
    "View",
    "WrongKeyError",
]
