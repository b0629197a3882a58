"""Where bits lie in a published model, and how a reader finds them: one protocol, three channels."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
