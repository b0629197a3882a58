"""Hide a 3D Gaussian Splatting scene inside another one and open it only with a key.

from keyss import Secret, hide, reveal

hide("scenes/garden", [Secret("scenes/treasure", key)], width=400, out="runs/hidden")
reveal("runs/hidden/stego.ply", key, out="treasure.ply")
"""

from keyss import _threads  # noqa: F401

# Everything below imports torch.
from keyss._version import __version__
from keyss.core import Camera, Gaussians, KeyssError, Scene, View, WrongKeyError
from keyss.files import load_scene, read_ply, write_ply
from keyss.fitting import FitConfig
from keyss.hiding import HideConfig
from keyss.seal import generate_key
from keyss.verbs import HideResult, Secret, evaluate, fit, hide, info, render, reveal

__all__ = [
    "Camera",
    "FitConfig",
    "Gaussians",
    "HideConfig",
    "HideResult",
    "KeyssError",
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
    "read_ply",
    "render",
    "reveal",
    "write_ply",
]
