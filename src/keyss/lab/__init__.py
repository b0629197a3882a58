"""The laboratory: measures, attacks and comparisons of hidings. The product imports nothing of it.

Stealth, leaks, robustness and speed of one run make an audit (`audits/`); `many/` compares methods, and
reproduces the paper's tables; `baselines/` has published methods to compare with.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
