"""Links and names in the documents, versions, pins and exports."""

from __future__ import annotations

import ast
import importlib
import pkgutil
import re
import tomllib
from pathlib import Path

import pytest
import yaml

import keyss

ROOT = Path(__file__).parents[1]
TESTED = ("audit", "clip", "test")  # extras
DOCUMENTS = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/*.md")])


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_links_in_documents(document: Path) -> None:
    links = re.findall(r"\]\(([^)#\s]+)[^)]*\)", document.read_text())
    assert [link for link in links if "://" not in link and not (document.parent / link).exists()] == []


def test_test_names_in_documents() -> None:
    """A test's file, function or folder."""
    files = list((ROOT / "tests").rglob("*.py"))
    functions = re.findall(r"^ *def (test_\w+)", "\n".join(path.read_text() for path in files), re.MULTILINE)
    text = "\n".join(path.read_text() for path in DOCUMENTS)
    names = set(re.findall(r"`(test_\w+)(?:\.\.\.)?`", text))
    assert len(names) > 10
    stems = {path.stem for path in files}
    assert [n for n in sorted(names) if n not in stems and not any(f.startswith(n) for f in functions)] == []
    assert [path for path in re.findall(r"`(tests/[a-z_/.]+)`", text) if not (ROOT / path).exists()] == []


def test_module_names_in_documents() -> None:
    text = "\n".join(path.read_text() for path in DOCUMENTS)
    names = set(re.findall(r"`(keyss(?:\.\w+)+)`", text))
    assert len(names) > 5
    for name in sorted(names):
        pkgutil.resolve_name(name)  # raises where there is none


def test_version_matches_citation() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert citation["version"] == keyss.__version__
    assert re.search(r"^## \[?Unreleased\]?$", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)


def minimum_version(requirement: str) -> tuple[str, str] | None:
    """Name and minimum version of `name[extras]>=version,<next`."""
    found = re.match(r"([a-zA-Z0-9_.-]+)(?:\[[^]]*])?>=([^,]+)", requirement)
    return (found[1].lower(), found[2]) if found else None


def test_minimum_versions_are_pinned() -> None:
    """`make test-oldest` installs the minimum versions in pyproject.toml."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    declared = [*project["dependencies"], *(each for extra in TESTED for each in extras[extra])]
    lines = (ROOT / "requirements" / "oldest.txt").read_text().splitlines()
    pinned = dict(line.lower().split("==") for line in lines if line and not line.startswith("#"))
    different = {
        name: (version, pinned.get(name))
        for name, version in filter(None, map(minimum_version, declared))
        if name != "torch" and not (pinned.get(name, "") + ".").startswith(version + ".")
    }
    assert different == {}


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
