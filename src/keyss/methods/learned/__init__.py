"""The method: the key-conditioned decoder, the joint training, revealing."""

from keyss.methods.learned.config import HideConfig
from keyss.methods.learned.payload import HiddenSecret
from keyss.methods.learned.pipeline import Hidden, hide_scenes
from keyss.methods.learned.revealing import open_secret, reveal_gaussians

__all__ = [
    "Hidden",
    "HiddenSecret",
    "HideConfig",
    "hide_scenes",
    "open_secret",
    "reveal_gaussians",
]
