"""Scenes, models and photos on disk: readers that trust no byte, and writers that leave no half file."""

from keyss.files.ply import read_ply, write_ply
from keyss.files.scenes import load_scene

__all__ = ["load_scene", "read_ply", "write_ply"]
