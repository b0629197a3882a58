"""Where bits can lie in a published model, and how a reader finds them again: one protocol, four channels."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
