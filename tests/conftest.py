"""Fixtures that every test may use."""

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
from cheap_keys import set_key_cost, pytest_sessionstart  # noqa: F401  hook
from seeding import seed_test, patch_random_sources, pytest_fixture_setup  # noqa: F401  hook
from skip_policy import pytest_make_collect_report, pytest_runtest_makereport  # noqa: F401  hooks

if TYPE_CHECKING:
    import torch

    from cli.harness import Run

# What hypothesis makes up is the same in every run of CI, so that a failure comes with the change that made
# it; on other machines it goes on searching. How long an example takes depends on what else a machine does.
settings.register_profile("tests", derandomize="CI" in os.environ, deadline=None)
settings.load_profile("tests")
if "CI" in os.environ:
    patch_random_sources()

# A script that runs the tests in its background has them ignore Ctrl-C, which many of them send.
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    """Before fixtures of any scope: those that are shared must not be mixed."""
    seed_test(item)
    set_key_cost(item)


@pytest.fixture
def umask() -> Iterator[None]:
    """The usual umask, under which new files are readable by everybody; a test may set another."""
    before = os.umask(0o022)
    yield
    os.umask(before)


@pytest.fixture(name="keyss")
def _keyss(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Run:
    """Runs the command line in this process, without a key in the environment and without a terminal."""
    from cli.harness import Result
    from keyss.cli import main

    monkeypatch.delenv("KEYSS_KEY", raising=False)
    monkeypatch.delenv("KEYSS_DEBUG", raising=False)
    monkeypatch.setenv("COLUMNS", "120")
    monkeypatch.setattr("sys.stdin", io.StringIO())

    def run(*arguments: object) -> Result:
        capsys.readouterr()
        try:
            status = main([str(argument) for argument in arguments])
        except SystemExit as end:
            status = int(end.code or 0)
        return Result(status, *capsys.readouterr())

    return run


@pytest.fixture(scope="module")
def chromium() -> Iterator[Any]:
    """A browser without a window."""
    from viewer.browser import PATIENCE, PROGRAM, SWITCHES

    playwright = pytest.importorskip("playwright.sync_api", reason="needs playwright")
    with playwright.sync_playwright() as started:
        browser = started.chromium.launch(executable_path=PROGRAM, args=SWITCHES, timeout=PATIENCE)
        yield browser
        browser.close()


@pytest.fixture(scope="session")
def cuda() -> torch.device:
    """The GPU, or a skip where there is none that gsplat can use."""
    from keyss.core import BackendError
    from keyss.rendering import resolve_device

    try:
        return resolve_device("cuda")
    except BackendError as error:
        pytest.skip(str(error))


@pytest.fixture(scope="session")
def folders(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Folders of two tiny scenes, `a` and `b`; tests must not change them."""
    from test_api import write_nerfstudio
    from tiny_scenes import tiny_scene

    root = tmp_path_factory.mktemp("scenes")
    return write_nerfstudio(root / "a", tiny_scene(0)), write_nerfstudio(root / "b", tiny_scene(1))


@pytest.fixture(scope="session")
def real_data() -> Path:
    """The folder of real scenes (`fox`, `lego`, ...), or a skip where there is none.

    It is looked for in KEYSS_TEST_DATA, else in `../shared/data` beside the repository.
    """
    beside = Path(__file__).resolve().parents[2] / "shared" / "data"
    folder = Path(os.environ.get("KEYSS_TEST_DATA", beside))
    if not folder.is_dir():
        pytest.skip(f"no real scenes in {folder} (set KEYSS_TEST_DATA to their folder)")
    return folder


@pytest.fixture(scope="session")
def splat_transform() -> Callable[..., Path]:
    """Converts (source, target) -> target by splat-transform; skips if it is not installed."""
    from keyss.core import BackendError
    from keyss.files.foreign import find_splat_transform
    from keyss.lab import transform

    try:
        find_splat_transform()
    except BackendError as error:
        pytest.skip(str(error))
    return transform
