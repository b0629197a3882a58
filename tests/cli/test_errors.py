"""Errors: one line that names flags, an exit status, and no files."""

from __future__ import annotations

import errno
import os
import shutil
import warnings
from collections.abc import Callable
from pathlib import Path

import pytest

from cli.harness import SMALL, Run, assert_refused, listing
from files.scene_files import write_colmap
from keyss.cli import entry
from keyss.core import KeyssWarning, UsageError


def _truncate_points(folder: Path) -> None:
    points = write_colmap(folder / "scene", count=4) / "sparse" / "0" / "points3D.bin"
    points.write_bytes(points.read_bytes()[:40])


def _truncate_stego(folder: Path) -> None:
    stego = folder / "hidden" / "publish" / "model.ply"
    stego.write_bytes(stego.read_bytes()[:-1])


def _link_loop(folder: Path) -> None:
    (folder / "loop.ply").symlink_to("loop.ply")


def _need_clip(folder: Path) -> None:
    pytest.importorskip("transformers", reason="needs keyss[clip]")


SIZE, STEGO = " ".join(SMALL), "hidden/publish/model.ply"
HIDE = f"hide --publish converted --cover a --secret b --key-file key.txt -o out {SIZE}"
MODELS = "hide --publish converted --cover hidden/private/cover.ply --key-file key.txt -o out"
TWO_MODELS = f"{MODELS} --secret hidden/private/secret-1.ply"
REVEAL = f"reveal {STEGO} --key-file key.txt -o"
CLIP = HIDE.replace("--publish converted", "--method keyss --design published --key-encoder clip")
# Exit status, words of the message and the command, by what is wrong.
ERRORS: dict[str, tuple[int, str, str]] = {
    "unknown layout": (4, "Known layouts", "fit hidden/private -o out"),
    "fit of a model": (4, "found a 3DGS model", f"fit {STEGO} -o out"),
    "truncated points": (4, "points3D", f"fit scene -o out {SIZE}"),
    "no cover": (4, "nowhere", HIDE.replace("--cover a", "--cover nowhere")),
    "too few Gaussians": (2, "--channel appended has room", f"{HIDE} --channel colours"),
    "output exists": (5, "--overwrite", HIDE.replace("-o out", "-o hidden")),
    "output exists, and no key": (5, "key.txt exists", f"reveal {STEGO} -o key.txt"),
    "output is a file": (5, "not a folder", "fit a -o key.txt"),
    "key file missing": (4, "none.txt", HIDE.replace("key.txt", "none.txt")),
    "too few key files": (2, "--key-file", f"{HIDE} --secret b"),
    "no key at all": (2, "KEYSS_KEY", f"reveal {STEGO} -o s.ply"),
    "data truncated": (4, "model.ply", f"{REVEAL} secret.ply"),
    "a secret among what is published": (5, "given away", f"{REVEAL} hidden/publish/secret.ply"),
    "a run in what is published": (5, "given away", HIDE.replace("-o out", "-o hidden/publish/out")),
    "a model of a model": (2, "leave out --cover-model", f"{TWO_MODELS} --cover-model {STEGO}"),
    "a model of a secret model": (2, "leave out --secret-model", f"{TWO_MODELS} --secret-model {STEGO}"),
    "tiny pictures": (2, "--width: expected at least 16 pixels, got 5", f"{TWO_MODELS} --width 5"),
    "enormous pictures of a model": (2, "width", f"{TWO_MODELS} --width {10**10}"),
    "a link to itself": (4, "loop.ply", f"{MODELS} --secret loop.ply"),
    "info of nothing": (4, "nowhere", "info nowhere"),
    "clip without a model": (6, "--clip-model", f"{CLIP} --clip-model a"),
    "background out of range": (2, "background", "fit a -o out --background 0 0 9"),
}
PREPARE: dict[str, Callable[[Path], None]] = {
    "truncated points": _truncate_points,
    "data truncated": _truncate_stego,
    "a link to itself": _link_loop,
    "clip without a model": _need_clip,
}


@pytest.mark.parametrize("name", ERRORS)
def test_errors(
    keyss: Run, workspace: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    status, words, command = ERRORS[name]
    shutil.copytree(workspace, tmp_path, dirs_exist_ok=True)
    PREPARE.get(name, lambda folder: None)(tmp_path)
    monkeypatch.chdir(tmp_path)
    before = listing(tmp_path)
    assert_refused(keyss(*command.split()), status, words)
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


OPTIONS = {"overwrite", "max_gaussians", "key_file", "secret", "publish", "secret_model", "download"}


@pytest.mark.parametrize(
    ("message", "expected"),
    [
        ("`overwrite=True` replaces it", "--overwrite replaces it"),
        ('`method="keyss"` can', "--method keyss can"),
        ('`method="carry", overwrite=True` has one', "--method carry --overwrite has one"),
        ("`max_gaussians=30000` would do", "--max-gaussians 30000 would do"),
        ("`min_psnr=12.5`", "--min-psnr 12.5"),
        ("give `max_gaussians`, `publish`", "give --max-gaussians, --publish"),
        ("`key`, `secrets` and `model`", "--key-file, --secret and --secret-model"),
        # Other code stays as it is.
        ("`chmod 600` and `f_dc_0` and `reporter`", "`chmod 600` and `f_dc_0` and `reporter`"),
        ("`keyss keygen -o FILE`", "`keyss keygen -o FILE`"),
        ("x=`; overwrite=True", "x=`; overwrite=True"),
    ],
)
def test_argument_names_become_flags(message: str, expected: str) -> None:
    assert entry.as_flags(message, OPTIONS) == expected


def test_repeated_warnings_print_once(keyss: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    def info(path: Path, *, capacity: bool) -> None:
        for number in (1, 1, 2):
            warnings.warn(f"no. {number}\n`overwrite=True`", KeyssWarning, stacklevel=1)
        raise UsageError("at last")

    monkeypatch.setattr("keyss.runs.describe.info", info)
    assert keyss("info", "x").err.splitlines() == [
        "keyss: warning: no. 1 --overwrite",
        "keyss: warning: no. 2 --overwrite",
        "keyss: error: at last",
    ]
