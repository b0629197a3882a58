"""Scenes, models and photos on disk: readers that trust no byte, and writers that leave no half file."""

from typing import TYPE_CHECKING

from keyss._lazy import lazily

if TYPE_CHECKING:
    from keyss.files.models import read_model as read_model, write_model as write_model
    from keyss.files.scenes import load_scene as load_scene
else:
    __getattr__, __dir__, __all__ = lazily(
        __name__,
        {
            "keyss.files.models": ["read_model", "write_model"],
            "keyss.files.scenes": ["load_scene"],
        },
    )
