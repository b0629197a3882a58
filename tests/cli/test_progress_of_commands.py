"""Commands on a large model: nearly all of their work is inside a progress line."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from channels.lsb.trained_like import trained_like
from cli.harness import Run, write_key
from keyss import write_model
from keyss.progress import ProgressLines, Share
from shared import make_once

SMALL, LARGE = (
    1000,
    200_000,
)  # Gaussians; commands are first run on small models, which imports what they need
SILENT = 0.15, 0.02  # processor seconds outside of progress lines that are allowed, and their share of all
HIDE = ("hide", "--cover", "{0}/a.ply", "--key-file", "{0}/key.txt", "--min-psnr", "0")
SCENE = (*HIDE, "--secret", "{0}/b.ply")
FILE = (*HIDE[:-2], "--secret-file", "{0}/key.txt")
STEGO, KEY = "{0}/run/publish/model.ply", ("--key-file", "{0}/key.txt")
COMMANDS = {
    "hide": (*SCENE, "-o", "{1}/run"),
    "hide --dry-run": (*SCENE, "-o", "{1}/run", "--dry-run"),
    "hide --secret-file": (*FILE, "-o", "{1}/run"),
    "reveal": ("reveal", STEGO, *KEY, "-o", "{1}/secret.ply"),
    "verify": ("verify", STEGO, *KEY),
    "convert": ("convert", STEGO, "-o", "{1}/model.sog", *KEY, "--force"),
    "info --capacity": ("info", "{0}/a.ply", "--capacity"),
    "view -o": ("view", STEGO, "-o", "{1}/page.html"),
    "render": ("render", STEGO, "-o", "{1}/turn.webp"),
    "evaluate": ("evaluate", "{0}/run", *KEY),
}
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> dict[int, Path]:
    """For each size a cover, a secret and a run that hides it."""

    def make(folder: Path) -> None:
        from keyss.cli import main

        write_key(folder / "key.txt")
        for seed, name in enumerate(("a.ply", "b.ply")):
            write_model(folder / name, trained_like(int(folder.name.split("-")[0]), seed))
        assert main([word.format(folder) for word in (*SCENE, "-o", "{0}/run")]) == 0

    return {size: make_once(tmp_path_factory, f"{size}", make) for size in (SMALL, LARGE)}


@pytest.mark.parametrize("name", COMMANDS)
def test_work_is_displayed(
    name: str, folders: dict[int, Path], tmp_path: Path, keyss: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    displayed, waiting = [0.0], ProgressLines.waiting

    @contextmanager
    def timed(lines: ProgressLines, what: str, seconds: float) -> Iterator[Share]:
        start = time.process_time()
        with waiting(lines, what, seconds) as share:
            yield share
        displayed.append(time.process_time() - start)

    monkeypatch.setattr(ProgressLines, "waiting", timed)
    for size, folder in folders.items():
        displayed.clear()
        out = tmp_path / f"{size}"
        out.mkdir()
        start = time.process_time()
        result = keyss(*(word.format(folder, out) for word in COMMANDS[name]))
        spent = time.process_time() - start
        assert result.status == 0, result.err
    silent = spent - sum(displayed)
    assert silent < SILENT[0] + SILENT[1] * spent
