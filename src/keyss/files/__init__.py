"""Reads and writes scenes, models and photos; files may be hostile, and writes are atomic."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
