"""What goes wrong is a line and an exit status, and leaves nothing."""

from __future__ import annotations

import errno
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from cli.said import SMALL, Run, assert_refused, listing
from files.scene_files import write_colmap

STEGO = "hidden/publish/model.ply"


def _truncated_scene(folder: Path) -> list[object]:
    """`fit` on a COLMAP scene."""
    points = write_colmap(folder / "scene", count=4) / "sparse" / "0" / "points3D.bin"
    points.write_bytes(points.read_bytes()[:40])
    return ["fit", folder / "scene", "-o", folder / "out", *SMALL]


def _ply_with(change: Callable[[bytes], bytes]) -> Callable[[Path], list[object]]:
    """`reveal` on a stego file after `change` of its bytes."""

    def prepare(folder: Path) -> list[object]:
        stego = folder / "hidden" / "publish" / "model.ply"
        stego.write_bytes(change(stego.read_bytes()))
        return ["reveal", stego, "--key-file", folder / "key.txt", "-o", folder / "secret.ply"]

    return prepare


def _hide(folder: Path, **changes: object) -> list[object]:
    options = {"--cover": folder / "a", "--secret": folder / "b", "--key-file": folder / "key.txt"}
    options |= {"--out": folder / "out"} | {
        f"--{name.replace('_', '-')}": value for name, value in changes.items()
    }
    return ["hide", "--publish", "any", *(part for option in options.items() for part in option), *SMALL]


def _model_in_model(folder: Path, *extra: object, **changes: object) -> list[object]:
    """`hide` of a model in a model."""
    files = {"cover": _plain(folder, "cover"), "secret": _plain(folder, "secret-1"), "out": folder / "out"}
    files |= {"key_file": folder / "key.txt"} | changes
    options = [part for name, value in files.items() for part in (f"--{name.replace('_', '-')}", value)]
    return ["hide", "--publish", "any", *options, *extra]


def _loop(folder: Path) -> Path:
    (folder / "loop.ply").symlink_to("loop.ply")
    return folder


def _empty_key(folder: Path) -> list[object]:
    (folder / "empty.txt").write_text("\n")
    return _hide(folder, key_file=folder / "empty.txt")


def _without_clip(folder: Path) -> list[object]:
    pytest.importorskip("transformers", reason="needs keyss[clip]")
    return _jointly(folder, design="published", key_encoder="clip", clip_model=folder / "a")


def _jointly(folder: Path, **changes: object) -> list[object]:
    """`hide` by a method that publishes low bits only."""
    command, _, _, *options = _hide(folder, method="keyss", **changes)
    return [command, *options]


def _plain(folder: Path, name: str) -> Path:
    return folder / "hidden" / "private" / f"{name}.ply"


def _reveal(folder: Path, *extra: object, key: Path | None = None) -> list[object]:
    stego, key = folder / "hidden" / "publish" / "model.ply", key or folder / "key.txt"
    return ["reveal", stego, "--key-file", key, "-o", folder / "secret.ply", *extra]


def _reveal_to(folder: Path, out: str) -> list[object]:
    return ["reveal", folder / STEGO, "--key-file", folder / "key.txt", "-o", folder / out]


ERRORS: dict[str, tuple[int, str, Callable[[Path], list[object]]]] = {
    "missing folder": (4, "nowhere", lambda f: ["fit", f / "nowhere", "-o", f / "out"]),
    "unknown layout": (4, "Known layouts", lambda f: ["fit", f / "hidden/private", "-o", f / "out"]),
    "truncated points": (4, "points3D", _truncated_scene),
    "no cover": (4, "nowhere", lambda f: _hide(f, cover=f / "nowhere")),
    "no secret": (4, "nowhere", lambda f: _hide(f, secret=f / "nowhere")),
    "too few Gaussians": (2, "--channel appended has room", lambda f: [*_hide(f), "--channel", "colours"]),
    "no cover model": (4, "nowhere.ply", lambda f: _hide(f, cover_model=f / "nowhere.ply")),
    "output exists": (5, "--overwrite", lambda f: _hide(f, out=f / "hidden")),
    "output is a file": (5, "not a folder", lambda f: ["fit", f / "a", "-o", f / "key.txt"]),
    "key file missing": (4, "none.txt", lambda f: _hide(f, key_file=f / "none.txt")),
    "key file empty": (4, "keyss keygen", _empty_key),
    "too few key files": (2, "--key-file", lambda f: [*_hide(f), "--secret", f / "b"]),
    "no key at all": (2, "KEYSS_KEY", lambda f: ["reveal", f / STEGO, "-o", f / "s.ply"]),
    "data truncated": (4, "model.ply", _ply_with(lambda data: data[:-1])),
    "nothing in the model": (
        3,
        "opens nothing",
        lambda f: ["reveal", f / "hidden/private/cover.ply", "--key-file", f / "key.txt", "-o", f / "s.ply"],
    ),
    "file exists": (
        5,
        "--overwrite",
        lambda f: _reveal_to(f, "hidden/private/cover.ply"),
    ),
    "a secret among what is published": (
        5,
        "given away",
        lambda f: _reveal_to(f, "hidden/publish/secret.ply"),
    ),
    "a run in what is published": (5, "given away", lambda f: _hide(f, out=f / "hidden/publish/out")),
    "a file without a name": (4, "folder", lambda f: ["reveal", "", *_reveal(f)[2:]]),
    "folder of the file missing": (
        5,
        "nowhere",
        lambda f: _reveal_to(f, "nowhere/s.ply"),
    ),
    "evaluate without a run": (
        4,
        "config.json",
        lambda f: ["evaluate", f / "a", "--key-file", f / "key.txt"],
    ),
    "a model of a model": (
        2,
        "leave out --cover-model",
        lambda f: _hide(f, cover=_plain(f, "cover"), cover_model=_plain(f, "secret-1")),
    ),
    "pictures of nothing of a model": (2, "width", lambda f: _model_in_model(f, "--width=0")),
    "enormous pictures of a model": (2, "width", lambda f: _model_in_model(f, "--width", 10**10)),
    "background of a model out of range": (
        2,
        "background",
        lambda f: _model_in_model(f, "--background", 0, "nan", 0),
    ),
    "a link to itself": (4, "loop.ply", lambda f: _model_in_model(f, secret=_loop(f) / "loop.ply")),
    "results in a link to itself": (
        5,
        "loop.ply",
        lambda f: _model_in_model(f, out=_loop(f) / "loop.ply" / "x"),
    ),
    "a model of a secret model": (
        2,
        "leave out --secret-model",
        lambda f: _hide(f, secret=_plain(f, "secret-1"), secret_model=_plain(f, "cover")),
    ),
    "two keys for one secret": (
        2,
        "one --key-file, got 2",
        lambda f: _reveal(f, "--key-file", f / "wrong.txt"),
    ),
    "info of nothing": (4, "nowhere", lambda f: ["info", f / "nowhere"]),
    "info of another file": (4, "key.txt", lambda f: ["info", f / "key.txt"]),
    "clip without a model": (6, "--clip-model", _without_clip),
    "clip model without clip": (2, "--key-encoder", lambda f: _jointly(f, clip_model=f)),
    "width of nothing": (2, "width", lambda f: ["fit", f / "a", "-o", f / "out", "--width", 0]),
    "background out of range": (
        2,
        "background",
        lambda f: ["fit", f / "a", "-o", f / "out", "--background", 0, 0, 9],
    ),
}


@pytest.mark.parametrize("name", ERRORS)
def test_errors_are_a_line_and_leave_nothing(keyss: Run, world: Path, tmp_path: Path, name: str) -> None:
    status, words, prepare = ERRORS[name]
    shutil.copytree(world, tmp_path, dirs_exist_ok=True)
    arguments = prepare(tmp_path)
    before = listing(tmp_path)
    assert_refused(keyss(*arguments), status, words)
    assert listing(tmp_path) == before


def test_a_full_disk_is_a_line_and_leaves_nothing(
    keyss: Run, world: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(descriptor: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr("keyss.files.atomic.os.fsync", full)
    arguments = [world / "hidden" / "publish" / "model.ply", "--key-file", world / "key.txt"]
    assert_refused(keyss("reveal", *arguments, "-o", tmp_path / "secret.ply"), 5, "No space left")
    arguments = [world / "hidden" / "publish" / "model.ply", "--cameras", world / "a"]
    assert_refused(keyss("render", *arguments, "-o", tmp_path / "images"), 5, "No space left")
    assert listing(tmp_path) == {}


class TestUnexpectedErrors:
    @pytest.fixture
    def failing(self, monkeypatch: pytest.MonkeyPatch) -> Callable[[BaseException], None]:
        def fail_with(error: BaseException) -> None:
            def info(path: Path) -> None:
                raise error

            monkeypatch.setattr("keyss.runs.describe.info", info)

        return fail_with

    def test_ours_are_a_line_that_asks_for_a_report(
        self, keyss: Run, failing: Callable[[BaseException], None]
    ) -> None:
        failing(ValueError("first\nsecond\x1b[31m"))
        said = keyss("info", "x")
        assert_refused(said, 70, "ValueError: first second [31m; please report")
        assert "KEYSS_DEBUG=1" in said.err

    def test_ours_come_through_for_whoever_debugs(
        self, keyss: Run, failing: Callable[[BaseException], None], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        failing(ValueError("boom"))
        monkeypatch.setenv("KEYSS_DEBUG", "1")
        with pytest.raises(ValueError, match="boom"):
            keyss("info", "x")

    @pytest.mark.parametrize(
        ("error", "status", "words"),
        [
            (MemoryError(), 8, "out of memory"),
            (RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried"), 8, "out of memory"),
            (OSError(errno.ENOSPC, "No space left on device", "/x/y"), 5, "/x/y: No space left"),
            (KeyboardInterrupt(), 130, "interrupted"),
        ],
    )
    def test_the_machines_are_explained(
        self,
        keyss: Run,
        failing: Callable[[BaseException], None],
        error: BaseException,
        status: int,
        words: str,
    ) -> None:
        failing(error)
        assert_refused(keyss("info", "x"), status, words)


WITHOUT_TORCH = """
import sys
from keyss.cli import main
try:
    status = main()
except SystemExit as end:
    status = end.code
sys.exit("torch was imported" if "torch" in sys.modules else status)
"""


@pytest.mark.parametrize(
    ("command", "status"),
    [
        ("hide nowhere.ply other.ply -o x", 2),
        ("hide --method keyss --masc xyz -o x", 2),
        ("hide --cover nowhere.ply --secret other.ply -o x", 4),
        *(
            (f"{each} -o x", 4)
            for each in ("fit nowhere", "reveal nowhere", "view nowhere", "render nowhere")
        ),
        *((f"{each} nowhere", 4) for each in ("verify", "evaluate", "audit", "info")),
        ("convert nowhere x.ply", 4),
        ("hide --cover . --secret . --seed -1 -o x", 2),
        *((f"{each} . -o x", 2) for each in ("render", "reveal", "hide --cover")),
        ("compare --cover nowhere --secret nowhere -o x", 4),
    ],
)
def test_what_needs_no_torch_is_refused_without(tmp_path: Path, command: str, status: int) -> None:
    words = [sys.executable, "-c", WITHOUT_TORCH, *command.split()]
    done = subprocess.run(words, capture_output=True, cwd=tmp_path, check=False)
    assert done.returncode == status, done.stderr
