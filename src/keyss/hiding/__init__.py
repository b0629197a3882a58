"""The method: the key-conditioned decoder, the joint training, revealing."""

from keyss.hiding.config import HideConfig
from keyss.hiding.payload import HiddenSecret
from keyss.hiding.pipeline import Hidden, hide_scenes
from keyss.hiding.revealing import open_secret, reveal_gaussians

__all__ = [
    "Hidden",
    "HiddenSecret",
    "HideConfig",
    "hide_scenes",
    "open_secret",
    "reveal_gaussians",
]
