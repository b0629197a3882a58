"""Import gsply without numba, whose compilation takes a minute on a new machine.

gsply imports its .sog reader later, which relies on numba's wider integers and stays compiled.
"""

from __future__ import annotations

from importlib import import_module
from unittest import mock

import numba

with mock.patch.object(numba.config, "DISABLE_JIT", True):
    import_module("gsply")
