"""The front doors of packages: each name is where type checkers are told that it is."""

from __future__ import annotations

import ast
import importlib
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import keyss
from channels.low_bits.trained_like import trained_like

SOURCES = Path(importlib.import_module("keyss").__file__ or "").parent


def front_doors() -> Iterator[tuple[str, ast.Module]]:
    for path in sorted(SOURCES.rglob("*.py")):
        tree = ast.parse(path.read_text())
        if any(isinstance(node, ast.Call) and ast.unparse(node.func) == "lazily" for node in ast.walk(tree)):
            inside = path.relative_to(SOURCES.parent).with_suffix("").parts
            yield ".".join(inside[:-1] if inside[-1] == "__init__" else inside), tree


@pytest.mark.parametrize(("package", "tree"), [pytest.param(*each, id=each[0]) for each in front_doors()])
def test_a_front_door_is_what_type_checkers_see(package: str, tree: ast.Module) -> None:
    branch = next(node for node in tree.body if isinstance(node, ast.If))
    assert ast.unparse(branch.test) == "TYPE_CHECKING"
    imported = [node for node in branch.body if isinstance(node, ast.ImportFrom)]
    names = {alias.name for node in imported for alias in node.names if alias.name == alias.asname}
    module = importlib.import_module(package)
    assert {*module.__all__} - {"__version__"} == names
    for node in imported:
        home = importlib.import_module(str(node.module))
        for alias in node.names:
            assert getattr(module, alias.name) is getattr(home, alias.name)
            assert importlib.util.find_spec(f"{package}.{alias.name}") is None
    with pytest.raises(AttributeError, match=f"module '{package}' has no attribute 'nothing'"):
        module.nothing  # noqa: B018


def test_importing_the_package_loads_nothing_heavy() -> None:
    code = "import sys, keyss.core, keyss.files, keyss.runs, keyss.rendering; print('torch' in sys.modules)"
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert said.stdout == "False\n"


@pytest.mark.argon2
def test_revealing_imports_a_quarter_of_the_package(tmp_path: Path) -> None:
    secret = keyss.Secret(trained_like(900, 1), "a key of many characters: 93hXmQ2")
    keyss.hide(trained_like(2500), [secret], width=24, out=tmp_path / "run", min_psnr=0)
    code = (
        "import os, sys, keyss.cli.process\n"
        "end = os._exit\n"
        "def counted(status):\n"
        "    print(sum(name.split('.')[0] == 'keyss' for name in sys.modules), flush=True)\n"
        "    end(status)\n"
        "os._exit = counted\n"
        f"sys.argv = ['keyss', 'reveal', {str(tmp_path / 'run/publish/stego.ply')!r}, '-q',"
        f" '-o', {str(tmp_path / 'secret.ply')!r}]\n"
        "try:\n    keyss.cli.process.main()\nfinally:\n    counted(0)\n"
    )
    said = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        check=True,
        env={**os.environ, "KEYSS_KEY": secret.key},
    )
    assert (tmp_path / "secret.ply").exists(), said.stderr
    assert int(said.stdout.split()[-1]) <= 90
