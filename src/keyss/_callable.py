"""Packages that are also the public function of their name: `keyss.audit(...)` and `keyss.audit.run`."""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable
from types import ModuleType
from typing import Any


class _CallableModule(ModuleType):
    _function: Callable[..., Any]

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        return self._function(*args, **kwargs)


def make_callable(package: str, function: Callable[..., Any]) -> None:
    """Let a package be called as `function`.

    Importing a package binds its name in the one above it, over a function of the same name; whichever is
    imported first, both uses must work.
    """
    module: Any = sys.modules[package]
    module._function, module.__signature__ = function, inspect.signature(function)
    module.__class__ = _CallableModule
