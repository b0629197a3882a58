"""The method: the key-conditioned decoder, the joint training, revealing."""

from keyss.hiding.config import HideConfig
from keyss.hiding.decoder_file import SavedDecoder, load_decoder, save_decoder
from keyss.hiding.pipeline import Hidden, hide_scenes
from keyss.hiding.revealing import reveal_gaussians

__all__ = [
    "Hidden",
    "HideConfig",
    "SavedDecoder",
    "hide_scenes",
    "load_decoder",
    "reveal_gaussians",
    "save_decoder",
]
