"""Packages load their exports lazily, as listed in their .pyi stubs."""

from __future__ import annotations

import ast
import importlib
from pathlib import Path

import pytest

SOURCES = Path(importlib.import_module("keyss").__file__ or "").parent
PACKAGES = [
    ".".join(stub.parent.relative_to(SOURCES.parent).parts) for stub in sorted(SOURCES.rglob("*.pyi"))
]


@pytest.mark.parametrize("package", PACKAGES)
def test_exports_match_stub(package: str) -> None:
    module = importlib.import_module(package)
    stub = ast.parse(Path(module.__file__ or "").with_suffix(".pyi").read_text())
    for node in stub.body:
        assert isinstance(node, ast.ImportFrom)
        home = importlib.import_module(f"{package}.{node.module}")
        for alias in node.names:
            assert alias.name == alias.asname  # else type checkers do not see it
            assert getattr(module, alias.name) is getattr(home, alias.name)
            assert importlib.util.find_spec(f"{package}.{alias.name}") is None  # a submodule would replace it
