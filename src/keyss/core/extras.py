"""Packages that only an extra of keyss installs."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from keyss.core.errors import BackendError

_PACKAGES = {"ot": "pot", "sklearn": "scikit-learn", "yaml": "pyyaml"}  # by module, if the names differ


def import_extra(module: str, extra: str, purpose: str) -> Any:
    """Import a module of an optional package; `purpose` is for example "write films".

    Raises BackendError, which names the package and the extra, if it cannot be imported.
    """
    try:
        return import_module(module)
    except ImportError as error:
        package = _PACKAGES.get(module.partition(".")[0], module)
        raise BackendError(
            f"to {purpose}, install {package}: pip install 'keyss[{extra}]' ({error})"
        ) from error
