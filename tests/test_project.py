"""What surrounds the code: the rule about skips on CI, metadata, links of the documents."""

from __future__ import annotations

import importlib.util
import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
import yaml

import keyss

ROOT = Path(__file__).parents[1]
TESTED = ("audit", "clip", "test")  # extras
DOCUMENTS = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/*.md")])
SKIPPING = """
import pytest

def test_a_missing_tool():
    pytest.skip("needs a chisel")

def test_a_missing_gpu():
    pytest.skip("CUDA is not available")

@pytest.mark.skipif(True, reason="needs a hammer")
def test_a_mark():
    pass

@pytest.mark.xfail(reason="known")
def test_an_expected_failure():
    assert False

def test_what_runs():
    pass
"""


def outcome(folder: Path, ci: str) -> tuple[int, str]:
    """Exit status and output of pytest on test files in a folder that follow the rule about skips."""
    (folder / "conftest.py").write_text("from skip_policy import *")
    # An absent package skips this whole file while it is collected.
    (folder / "test_whole.py").write_text("import pytest\npytest.importorskip('a_package_that_is_absent')")
    (folder / "test_some.py").write_text(SKIPPING)
    environment = {**os.environ, "CI": ci, "PYTHONPATH": str(ROOT / "tests")}
    options = ["-q", "-rA", "-p", "no:cacheprovider", "--continue-on-collection-errors"]
    command = [sys.executable, "-m", "pytest", *options, str(folder)]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=120, check=False)
    return done.returncode, done.stdout


def test_a_skip_on_ci_is_a_failure_unless_its_reason_is_allowed(tmp_path: Path) -> None:
    status, output = outcome(tmp_path, "true")
    assert status != 0
    assert "skipped on CI, where everything must run: needs a chisel" in output
    assert "skipped on CI, where everything must run: needs a hammer" in output
    assert "a_package_that_is_absent" in output
    assert "1 failed, 1 passed, 1 skipped, 1 xfailed, 2 errors" in output


def test_elsewhere_skips_are_skips(tmp_path: Path) -> None:
    status, output = outcome(tmp_path, "")
    assert status == 0
    assert "1 passed, 4 skipped, 1 xfailed" in output


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_the_files_that_documents_link_to_exist(document: Path) -> None:
    links = re.findall(r"\]\(([^)#\s]+)[^)]*\)", document.read_text())
    assert [link for link in links if "://" not in link and not (document.parent / link).exists()] == []


def test_the_tests_that_documents_name_exist() -> None:
    """The threat model says which test shows what: a test's file, a function of one, or a folder."""
    files = list((ROOT / "tests").rglob("*.py"))
    functions = re.findall(r"^ *def (test_\w+)", "\n".join(path.read_text() for path in files), re.MULTILINE)
    text = "\n".join(path.read_text() for path in DOCUMENTS)
    names = set(re.findall(r"`(test_\w+)(?:\.\.\.)?`", text))
    assert len(names) > 10
    stems = {path.stem for path in files}
    assert [n for n in sorted(names) if n not in stems and not any(f.startswith(n) for f in functions)] == []
    assert [path for path in re.findall(r"`(tests/[a-z_/.]+)`", text) if not (ROOT / path).exists()] == []


def test_the_modules_that_documents_name_exist() -> None:
    text = "\n".join(path.read_text() for path in DOCUMENTS)
    names = set(re.findall(r"`(keyss(?:\.\w+)+)`", text))
    assert len(names) > 5
    assert [name for name in sorted(names) if not exists(name)] == []


def exists(name: str) -> bool:
    """Whether `keyss.a.b` is a module, or `b` a name in the module `keyss.a`."""
    try:
        if importlib.util.find_spec(name) is not None:
            return True
    except ModuleNotFoundError:
        pass
    home, _, attribute = name.rpartition(".")
    return hasattr(importlib.import_module(home), attribute)


def test_the_version_is_the_same_everywhere() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert citation["version"] == keyss.__version__
    assert re.search(r"^## \[?Unreleased\]?$", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)


def least(requirement: str) -> tuple[str, str] | None:
    """Name and least version of `name[extras]>=version,<next`."""
    found = re.match(r"([a-zA-Z0-9_.-]+)(?:\[[^]]*])?>=([^,]+)", requirement)
    return (found[1].lower(), found[2]) if found else None


def test_the_least_versions_are_those_that_are_tested() -> None:
    """`make test-oldest` installs the least version of everything that the package declares."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    declared = [*project["dependencies"], *(each for extra in TESTED for each in extras[extra])]
    lines = (ROOT / "requirements" / "oldest.txt").read_text().splitlines()
    pinned = dict(line.lower().split("==") for line in lines if line and not line.startswith("#"))
    different = {
        name: (version, pinned.get(name))
        for name, version in filter(None, map(least, declared))
        if name != "torch" and not (pinned.get(name, "") + ".").startswith(version + ".")
    }
    assert different == {}
