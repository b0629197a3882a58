"""Keys never appear in arguments, messages, logs or files."""

from __future__ import annotations

import base64
import io
import logging
import os
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

from channels.lsb.trained_like import trained_like
from cli.harness import SMALL, write_workspace
from keyss.channels import LowBitsReader
from keyss.cli import entry, main
from keyss.core import KeyssError
from keyss.keys import DerivedKey
from keyss.methods import registry
from keyss.progress import Reporter

KEY = "q7Rv2LxT9bWm4KzD"
SPELLINGS = [
    *(KEY.encode(coding) for coding in ("utf-8", "utf-16-le", "utf-16-be")),
    KEY.encode().hex().encode(),
    base64.b64encode(KEY.encode()).rstrip(b"="),
]


class _InterruptHiding(Reporter):
    """Send SIGINT while the secret is fitted."""

    hiding = False

    def start(self, title: str, iterations: int, iteration: int) -> None:
        self.hiding = title.startswith("plain model of the secret")

    def update(self, iteration: int, gaussians: int, numbers: dict[str, float]) -> None:
        if self.hiding:
            os.kill(os.getpid(), signal.SIGINT)


def _contains_key(data: bytes) -> bool:
    return any(spelling.lower() in data.lower() for spelling in SPELLINGS)


def _files(folder: Path) -> Iterator[Path]:
    return (path for path in folder.rglob("*") if path.is_file() and path.name != "key.txt")


def test_key_is_never_written_or_printed(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    caplog.set_level(logging.DEBUG)
    monkeypatch.setattr("sys.stdin", io.StringIO())
    folder = write_workspace(tmp_path)
    run, key = folder / "run", ["--key-file", str(folder / "key.txt")]
    (folder / "key.txt").chmod(0o644)  # triggers a warning
    scenes = [
        "--cover",
        str(folder / "a"),
        "--secret",
        str(folder / "b"),
        "--publish",
        "converted",
        "-o",
        str(run),
    ]
    with monkeypatch.context() as patch:
        patch.setattr("keyss.progress.reporter", _InterruptHiding)
        assert main(["hide", *scenes, *key, *SMALL]) == 130
    checkpoints = list(_files(run / "private" / "checkpoint"))
    assert len(checkpoints) >= 2
    assert not any(_contains_key(path.read_bytes()) for path in checkpoints)

    (folder / "other.txt").write_text("another-key-for-7Qx2\n")
    other = ["--key-file", str(folder / "other.txt")]
    assert main(["hide", *scenes, *other, *SMALL, "--resume"]) == 5
    assert "other arguments (keys: not the same)" in capsys.readouterr().err
    assert main(["hide", *scenes, *key, *SMALL, "--resume"]) == 0
    stego = str(run / "publish" / "model.ply")
    assert main(["reveal", stego, *key, "-o", str(folder / "secret.ply")]) == 0
    assert main(["evaluate", str(run), *key]) == 0
    assert main(["reveal", str(run / "private" / "cover.ply"), *key, "-o", str(folder / "no.ply")]) == 3
    assert main(["info", stego]) == 0
    written = list(_files(folder))
    assert {"model.ply", "config.json", "metrics.json"} <= {path.name for path in written}
    assert [path for path in written if _contains_key(path.read_bytes())] == []
    captured = capsys.readouterr()
    assert "others can read this key file" in captured.err
    assert not _contains_key((captured.out + captured.err + caplog.text).encode())


def test_no_option_takes_a_key() -> None:
    asked = [(name, []) for name in entry.MODULES] + [
        ("hide", ["--method", name, "--help"]) for name in registry.METHODS
    ]
    for name, arguments in asked:
        options = entry.options_of(entry.parse_target(name, arguments))
        keys = {name: hint for name, hint in options.items() if "key" in name}
        for name in keys.keys() - {"wrong_keys", "key_encoder"}:
            assert "Path" in str(keys[name]), name


@pytest.mark.parametrize("option", [["--key", KEY], [f"--key={KEY}"], ["-k", KEY]])
@pytest.mark.parametrize("command", [["reveal", "stego.ply", "-o", "out.ply"], ["hide", "-o", "out"]])
def test_key_argument_is_refused(
    capsys: pytest.CaptureFixture[str], command: list[str], option: list[str]
) -> None:
    assert main([*command, *option]) == 2
    captured = capsys.readouterr()
    assert "--key-file FILE" in captured.err
    assert not _contains_key((captured.out + captured.err).encode())


def test_repr_and_errors_omit_key() -> None:
    derived = DerivedKey.of(KEY, bytes(16))
    assert KEY not in repr(derived)
    assert derived.expand("writer", 32).hex() not in repr(derived)
    with pytest.raises(KeyssError) as caught:
        LowBitsReader.of(trained_like(50)).open(KEY)
    assert not _contains_key(str(caught.value).encode())
