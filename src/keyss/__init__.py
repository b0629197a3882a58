"""Hide a 3D Gaussian Splatting scene inside another one and open it only with a key.

    from keyss import Secret, hide, reveal

    hide("scenes/garden", [Secret("scenes/treasure", key)], width=400, out="runs/hidden")
    reveal("runs/hidden/publish/model.ply", key, out="treasure.ply")

Names are loaded at their first use, which keeps `import keyss` fast.
"""

from keyss import _interrupts  # noqa: F401, I001  before anything else

import lazy_loader

from keyss import _threads  # noqa: F401  before anything imports torch

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
