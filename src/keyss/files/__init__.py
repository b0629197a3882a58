"""Scenes, models and photos on disk: readers that trust no byte, and writers that leave no half file.

The names below are loaded at first use (PEP 562): a model is read without what reads photos.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from keyss.files.models import read_model, write_model
    from keyss.files.scenes import load_scene

__all__ = ["load_scene", "read_model", "write_model"]

_HOMES = {"load_scene": "scenes", "read_model": "models", "write_model": "models"}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'keyss.files' has no attribute {name!r}")
    globals()[name] = value = getattr(importlib.import_module(f"keyss.files.{_HOMES[name]}"), name)
    return value
