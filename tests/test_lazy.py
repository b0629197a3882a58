"""The front doors of packages: names that are loaded at their first use."""

from __future__ import annotations

import ast
import importlib
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

VECTORS = Path(__file__).parent / "vectors"
SOURCES = Path(importlib.import_module("keyss").__file__ or "").parent


FRONT_DOORS = [
    ".".join(stub.parent.relative_to(SOURCES.parent).parts) for stub in sorted(SOURCES.rglob("*.pyi"))
]


@pytest.mark.parametrize("package", FRONT_DOORS)
def test_a_front_door_loads_what_its_stub_lists(package: str) -> None:
    module = importlib.import_module(package)
    stub = ast.parse(Path(module.__file__ or "").with_suffix(".pyi").read_text())
    for node in stub.body:
        assert isinstance(node, ast.ImportFrom)
        home = importlib.import_module(f"{package}.{node.module}")
        for alias in node.names:
            assert alias.name == alias.asname  # else type checkers do not see it
            assert getattr(module, alias.name) is getattr(home, alias.name)
            assert importlib.util.find_spec(f"{package}.{alias.name}") is None  # a submodule would replace it


LIGHT = """
import sys, keyss.core, keyss.files, keyss.runs, keyss.rendering, keyss.measure
print({"torch", "scipy", "sklearn", "ot"} & sys.modules.keys())
import keyss.lab.two_sample, keyss.lab.sinkhorn
print({"sklearn", "ot"} & sys.modules.keys())
"""


def test_importing_the_package_loads_nothing_heavy() -> None:
    said = subprocess.run([sys.executable, "-c", LIGHT], capture_output=True, text=True, check=True)
    assert said.stdout == "set()\nset()\n"


@pytest.mark.argon2
def test_revealing_imports_a_quarter_of_the_package(tmp_path: Path) -> None:
    code = (
        "import os, sys, keyss.cli.process\n"
        "end = os._exit\n"
        "def counted(status):\n"
        "    print(sum(name.split('.')[0] == 'keyss' for name in sys.modules), flush=True)\n"
        "    end(status)\n"
        "os._exit = counted\n"
        f"sys.argv = ['keyss', 'reveal', {str(VECTORS / 'carried.ply')!r}, '-q',"
        f" '-o', {str(tmp_path / 'secret.ply')!r}]\n"
        "try:\n    keyss.cli.process.main()\nfinally:\n    counted(0)\n"
    )
    said = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        check=True,
        env={**os.environ, "KEYSS_KEY": json.loads((VECTORS / "carried.json").read_text())["key"]},
    )
    assert (tmp_path / "secret.ply").exists(), said.stderr
    assert int(said.stdout.split()[-1]) <= 90
