"""Errors: one line, an exit status, and no files."""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from cli.harness import SMALL, Run, assert_refused, listing
from files.scene_files import write_colmap

STEGO = "hidden/publish/model.ply"


def _fit_truncated(folder: Path) -> list[object]:
    points = write_colmap(folder / "scene", count=4) / "sparse" / "0" / "points3D.bin"
    points.write_bytes(points.read_bytes()[:40])
    return ["fit", folder / "scene", "-o", folder / "out", *SMALL]


def _reveal_changed(change: Callable[[bytes], bytes]) -> Callable[[Path], list[object]]:
    """`reveal` on a stego file with changed bytes."""

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
    return [
        "hide",
        "--publish",
        "converted",
        *(part for option in options.items() for part in option),
        *SMALL,
    ]


def _hide_models(folder: Path, *extra: object, **changes: object) -> list[object]:
    files = {"cover": _private_model(folder, "cover"), "secret": _private_model(folder, "secret-1")}
    files |= {"out": folder / "out", "key_file": folder / "key.txt"} | changes
    options = [part for name, value in files.items() for part in (f"--{name.replace('_', '-')}", value)]
    return ["hide", "--publish", "converted", *options, *extra]


def _link_loop(folder: Path) -> Path:
    (folder / "loop.ply").symlink_to("loop.ply")
    return folder


def _hide_without_clip(folder: Path) -> list[object]:
    pytest.importorskip("transformers", reason="needs keyss[clip]")
    return _hide_by_keyss(folder, design="published", key_encoder="clip", clip_model=folder / "a")


def _hide_by_keyss(folder: Path, **changes: object) -> list[object]:
    command, _, _, *options = _hide(folder, method="keyss", **changes)
    return [command, *options]


def _private_model(folder: Path, name: str) -> Path:
    return folder / "hidden" / "private" / f"{name}.ply"


def _reveal_to(folder: Path, out: str) -> list[object]:
    return ["reveal", folder / STEGO, "--key-file", folder / "key.txt", "-o", folder / out]


ERRORS: dict[str, tuple[int, str, Callable[[Path], list[object]]]] = {
    "unknown layout": (4, "Known layouts", lambda f: ["fit", f / "hidden/private", "-o", f / "out"]),
    "fit of a model": (4, "found a 3DGS model", lambda f: ["fit", f / STEGO, "-o", f / "out"]),
    "truncated points": (4, "points3D", _fit_truncated),
    "no cover": (4, "nowhere", lambda f: _hide(f, cover=f / "nowhere")),
    "too few Gaussians": (2, "--channel appended has room", lambda f: [*_hide(f), "--channel", "colours"]),
    "output exists": (5, "--overwrite", lambda f: _hide(f, out=f / "hidden")),
    "output exists, and no key": (5, "key.txt exists", lambda f: ["reveal", f / STEGO, "-o", f / "key.txt"]),
    "output is a file": (5, "not a folder", lambda f: ["fit", f / "a", "-o", f / "key.txt"]),
    "key file missing": (4, "none.txt", lambda f: _hide(f, key_file=f / "none.txt")),
    "too few key files": (2, "--key-file", lambda f: [*_hide(f), "--secret", f / "b"]),
    "no key at all": (2, "KEYSS_KEY", lambda f: ["reveal", f / STEGO, "-o", f / "s.ply"]),
    "data truncated": (4, "model.ply", _reveal_changed(lambda data: data[:-1])),
    "a secret among what is published": (
        5,
        "given away",
        lambda f: _reveal_to(f, "hidden/publish/secret.ply"),
    ),
    "a run in what is published": (5, "given away", lambda f: _hide(f, out=f / "hidden/publish/out")),
    "a model of a model": (
        2,
        "leave out --cover-model",
        lambda f: _hide(f, cover=_private_model(f, "cover"), cover_model=_private_model(f, "secret-1")),
    ),
    "tiny pictures": (
        2,
        "--width: expected at least 16 pixels, got 5",
        lambda f: _hide_models(f, "--width", 5),
    ),
    "enormous pictures of a model": (2, "width", lambda f: _hide_models(f, "--width", 10**10)),
    "a link to itself": (4, "loop.ply", lambda f: _hide_models(f, secret=_link_loop(f) / "loop.ply")),
    "a model of a secret model": (
        2,
        "leave out --secret-model",
        lambda f: _hide(f, secret=_private_model(f, "secret-1"), secret_model=_private_model(f, "cover")),
    ),
    "info of nothing": (4, "nowhere", lambda f: ["info", f / "nowhere"]),
    "clip without a model": (6, "--clip-model", _hide_without_clip),
    "background out of range": (
        2,
        "background",
        lambda f: ["fit", f / "a", "-o", f / "out", "--background", 0, 0, 9],
    ),
}


@pytest.mark.parametrize("name", ERRORS)
def test_errors(keyss: Run, workspace: Path, tmp_path: Path, name: str) -> None:
    status, words, prepare = ERRORS[name]
    shutil.copytree(workspace, tmp_path, dirs_exist_ok=True)
    arguments = prepare(tmp_path)
    before = listing(tmp_path)
    assert_refused(keyss(*arguments), status, words)
    assert listing(tmp_path) == before


def test_full_disk(keyss: Run, workspace: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(descriptor: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr("keyss.files.atomic.os.fsync", full)
    arguments = [workspace / "hidden" / "publish" / "model.ply", "--key-file", workspace / "key.txt"]
    assert_refused(keyss("reveal", *arguments, "-o", tmp_path / "secret.ply"), 5, "No space left")
    arguments = [workspace / "hidden" / "publish" / "model.ply", "--cameras", workspace / "a"]
    assert_refused(keyss("render", *arguments, "-o", tmp_path / "images"), 5, "No space left")
    assert listing(tmp_path) == {}


class TestUnexpectedErrors:
    @pytest.fixture
    def fail_info(self, monkeypatch: pytest.MonkeyPatch) -> Callable[[BaseException], None]:
        def fail_with(error: BaseException) -> None:
            def info(path: Path, *, capacity: bool) -> None:
                raise error

            monkeypatch.setattr("keyss.runs.describe.info", info)

        return fail_with

    def test_internal_error(self, keyss: Run, fail_info: Callable[[BaseException], None]) -> None:
        fail_info(ValueError("first\nsecond\x1b[31m"))
        result = keyss("info", "x")
        assert_refused(result, 70, "ValueError: first second [31m; please report")
        assert "KEYSS_DEBUG=1" in result.err

    def test_debug_reraises(
        self, keyss: Run, fail_info: Callable[[BaseException], None], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        fail_info(ValueError("boom"))
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
    def test_system_errors(
        self,
        keyss: Run,
        fail_info: Callable[[BaseException], None],
        error: BaseException,
        status: int,
        words: str,
    ) -> None:
        fail_info(error)
        assert_refused(keyss("info", "x"), status, words)
