"""Keys: from what a person types to derived keys, and authenticated encryption under them."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
