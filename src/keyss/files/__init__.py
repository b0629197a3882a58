"""Scenes, models and photos on disk: readers that trust no byte, and writers that leave no half file."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
