"""Scenes, models and photos on disk: readers that trust no byte, and writers that leave no half file."""

from keyss.files.models import read_model, write_model
from keyss.files.scenes import load_scene

__all__ = ["load_scene", "read_model", "write_model"]
