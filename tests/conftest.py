"""Shared fixtures and hooks."""

from __future__ import annotations

import io
import os
import signal
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from hypothesis import settings

import keyss  # noqa: F401  before any test module imports torch: see keyss._threads
import uncompiled_gsply  # noqa: F401  before any test module imports gsply
from cheap_keys import pytest_sessionstart, set_key_cost  # noqa: F401  hook
from seeding import patch_random_sources, pytest_fixture_setup, seed_test  # noqa: F401  hook
from skip_policy import pytest_make_collect_report, pytest_runtest_makereport  # noqa: F401  hooks

if TYPE_CHECKING:
    import torch

    from cli.harness import Run

# CI repeats the same examples, so that only a change can break it. No deadline: machines are shared.
settings.register_profile("tests", derandomize="CI" in os.environ, deadline=None)
settings.load_profile("tests")
if "CI" in os.environ:
    patch_random_sources()

# Background jobs of a shell ignore SIGINT, which many tests send.
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    """Runs before fixtures of any scope are set up."""
    seed_test(item)
    set_key_cost(item)


@pytest.fixture
def umask() -> Iterator[None]:
    """Umask 022, restored afterwards."""
    before = os.umask(0o022)
    yield
    os.umask(before)


@pytest.fixture(name="keyss")
def _keyss(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Run:
    """Run the command line in this process, without KEYSS_KEY and without a terminal.

    The first argument is split at spaces: `keyss("info a.ply --json")`.
    """
    from cli.harness import Result
    from keyss.cli import main

    monkeypatch.delenv("KEYSS_KEY", raising=False)
    monkeypatch.delenv("KEYSS_DEBUG", raising=False)
    monkeypatch.setenv("COLUMNS", "120")
    monkeypatch.setattr("sys.stdin", io.StringIO())
    monkeypatch.setattr("keyss.progress._LOG_SECONDS", 1e6)  # slow machines print no further lines

    def run(command: object, *arguments: object) -> Result:
        capsys.readouterr()
        try:
            status = main([*str(command).split(), *map(str, arguments)])
        except SystemExit as end:
            status = int(end.code or 0)
        return Result(status, *capsys.readouterr())

    return run


@pytest.fixture(scope="module")
def chromium() -> Iterator[Any]:
    """Headless Chromium."""
    from viewer.browser import PATIENCE, PROGRAM, SWITCHES

    playwright = pytest.importorskip("playwright.sync_api", reason="needs playwright")
    with playwright.sync_playwright() as started:
        browser = started.chromium.launch(executable_path=PROGRAM, args=SWITCHES, timeout=PATIENCE)
        yield browser
        browser.close()


@pytest.fixture(scope="session")
def cuda() -> torch.device:
    """The GPU; skips without one that gsplat can use."""
    from keyss.core import BackendError
    from keyss.rendering import resolve_device

    try:
        return resolve_device("cuda")
    except BackendError as error:
        pytest.skip(str(error))


@pytest.fixture(scope="session")
def folders(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Two tiny scenes in Nerfstudio's layout; read-only."""
    from test_api import write_nerfstudio
    from tiny_scenes import tiny_scene

    root = tmp_path_factory.mktemp("scenes")
    return write_nerfstudio(root / "a", tiny_scene(0)), write_nerfstudio(root / "b", tiny_scene(1))


@pytest.fixture(scope="session")
def real_data() -> Path:
    """Real scenes (`fox`, `lego`, ...) in KEYSS_TEST_DATA or `../shared/data`; skips without them."""
    beside = Path(__file__).resolve().parents[2] / "shared" / "data"
    folder = Path(os.environ.get("KEYSS_TEST_DATA", beside))
    if not folder.is_dir():
        pytest.skip(f"no real scenes in {folder} (set KEYSS_TEST_DATA to their folder)")
    return folder


@pytest.fixture(scope="session")
def splat_transform() -> Callable[..., Path]:
    """Convert a model file with splat-transform; skips without it."""
    from keyss.core import BackendError
    from keyss.files.file_kinds import find_splat_transform
    from keyss.lab import transform

    try:
        find_splat_transform()
    except BackendError as error:
        pytest.skip(str(error))
    return transform
