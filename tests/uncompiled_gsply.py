"""gsply as it is written, not compiled: for a few hundred Gaussians numba takes a minute on a new machine.

But for its reader of .sog, which it loads by and by: that one counts on numbers of more bits than numpy's.
Imported before anything imports gsply.
"""

from __future__ import annotations

from importlib import import_module
from unittest import mock

import numba

with mock.patch.object(numba.config, "DISABLE_JIT", True):
    import_module("gsply")
