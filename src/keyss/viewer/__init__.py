"""The page that shows a published model and takes a key; its sources are in `web/`."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
