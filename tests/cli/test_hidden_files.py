"""Arbitrary files: `keyss hide --secret-file` and `keyss reveal`."""

from __future__ import annotations

import os
import stat
from pathlib import Path

import pytest
from hypothesis import given, strategies as st

import keyss as library
from channels.colours.made import cover
from channels.lsb.trained_like import trained_like
from cli.harness import Run, assert_refused, listing, write_key
from keyss import read_model, write_model
from keyss.channels import Payload
from keyss.cli import main
from keyss.core import InputError, KeyssWarning, UsageError
from keyss.methods import HiddenFile

KEYS = ("q7Rv2LxT9bWm4KzD", "W2mz8Qe5TnYc6LkA")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A cover, two files, two keys, and `out`, which hides both."""
    made = tmp_path_factory.mktemp("files")
    write_model(made / "cover.ply", trained_like(3000))
    (made / "letter.pdf").write_bytes(os.urandom(3000))
    (made / "empty").write_bytes(b"")
    for index, key in enumerate(KEYS):
        write_key(made / f"key{index}", key)
    assert main([str(argument) for argument in _arguments(made, made / "out")]) == 0
    return made


def _arguments(folder: Path, out: Path) -> list[object]:
    keys = ["--key-file", folder / "key0", "--key-file", folder / "key1"]
    files = ["--secret-file", folder / "letter.pdf", "--secret-file", folder / "empty"]
    return ["hide", "--cover", folder / "cover.ply", *files, *keys, "-o", out]


def test_round_trip(keyss: Run, folder: Path, tmp_path: Path) -> None:
    stego = folder / "out" / "publish" / "model.ply"
    assert stego.stat().st_size == (folder / "cover.ply").stat().st_size
    for index, name in enumerate(("letter.pdf", "empty")):
        out = tmp_path / f"back{index}"
        result = keyss("reveal", stego, "--key-file", folder / f"key{index}", "-o", out)
        assert result.status == 0
        assert repr(name) in result.out
        assert out.read_bytes() == (folder / name).read_bytes()
        assert stat.S_IMODE(out.stat().st_mode) == 0o600


def test_hidden_model_file_is_revealed_as_it_was(tmp_path: Path) -> None:
    """Its suffix is that of a model, and its bytes are not read as one."""
    hidden = library.hide(trained_like(2000), [library.SecretFile(b"any bytes", KEYS[0], "scan.ply")])
    library.reveal(hidden.stego, KEYS[0], out=tmp_path / "back.ply")
    assert (tmp_path / "back.ply").read_bytes() == b"any bytes"
    with pytest.raises(UsageError, match=r"name the output like it, not back\.spz"):
        library.reveal(hidden.stego, KEYS[0], out=tmp_path / "back.spz")


def test_verify(keyss: Run, folder: Path) -> None:
    stego = folder / "out" / "publish" / "model.ply"
    for command in ("evaluate", "audit"):
        assert_refused(keyss(command, folder / "out"), 4, f"nothing to evaluate; `keyss verify {stego} ")
    for index, count in enumerate(("3,000 of 3,000", "0")):
        result = keyss("verify", stego, "--key-file", folder / f"key{index}")
        assert (result.status, result.err) == (0, "")
        assert f"secret  {count} bytes: complete" in result.out


def test_file_from_a_pruned_model(keyss: Run, folder: Path, tmp_path: Path) -> None:
    """The file is complete, and the loss does not go unnoticed."""
    stego = read_model(folder / "out" / "publish" / "model.ply")
    write_model(tmp_path / "pruned.ply", stego[: len(stego) * 4 // 5])
    arguments = (tmp_path / "pruned.ply", "--key-file", folder / "key0")
    verified = keyss("verify", *arguments)
    assert verified.status == 4
    assert "shards of the secret's payload were lost, and restored" in verified.err
    revealed = keyss("reveal", *arguments, "-o", tmp_path / "file.bin")
    assert revealed.status == 0
    assert "shards of the secret's payload were lost, and restored" in revealed.err
    assert (tmp_path / "file.bin").stat().st_size == 3000


def test_invalid_combinations(keyss: Run, folder: Path, workspace: Path, tmp_path: Path) -> None:
    out, back = tmp_path / "out", tmp_path / "back"
    hide = _arguments(folder, out)
    assert_refused(keyss(*hide, "--secret", folder / "cover.ply"), 2, "scenes or files, not both")
    planned = keyss(*hide, "--dry-run")
    assert (planned.status, planned.out.splitlines()[-1]) == (0, "Dry run: nothing was written.")
    letter = (*_arguments(folder, out)[:3], "--secret", folder / "letter.pdf", *hide[-6:])
    assert_refused(keyss(*letter), 4, "--secret-file hides any file")
    for flag, value in (("--min-psnr", 60), ("--seed", 0)):
        assert_refused(keyss(*hide, flag, value), 2, f"{flag} is for hidden scenes")
    photos = ("hide", "--cover", workspace / "a", "--secret-file", folder / "empty", "-o", out)
    assert_refused(keyss(*photos, "--key-file", folder / "key0"), 2, "needs a model as the cover")
    stego, key = folder / "out" / "publish" / "model.ply", ("--key-file", folder / "key0")
    assert_refused(keyss("reveal", stego, *key, "-o", tmp_path / "s.ply"), 2, "3,000 bytes, 'letter.pdf'")
    assert_refused(keyss("reveal", stego, *key, "-o", back, "--frame", "cover"), 2, "--frame is for scenes")
    assert_refused(keyss("reveal", folder / "cover.ply", *key, "-o", back), 3, "opens nothing")
    assert_refused(keyss("reveal", stego, *key, "-o", stego.parent / "back"), 5, "given away")
    assert listing(tmp_path) == {}


def test_names_that_are_not_text(folder: Path, tmp_path: Path) -> None:
    named = tmp_path / os.fsdecode(b"K\xfcche.pdf")
    named.write_bytes(b"plan")
    hidden = library.hide(folder / "cover.ply", [library.SecretFile(named, KEYS[0])])
    assert hidden.stego is not None
    assert library.reveal(hidden.stego, KEYS[0]).file == HiddenFile(
        "K\N{REPLACEMENT CHARACTER}che.pdf", b"plan"
    )


def test_file_too_large() -> None:
    """It is appended, unless the model must stay unchanged."""
    large, cover = library.SecretFile(os.urandom(90_000), KEYS[0]), trained_like(2000)
    with pytest.raises(UsageError, match=r"too small to carry .* Gaussians would do; .publish=.converted."):
        library.hide(cover, [large], publish="unchanged")
    with pytest.warns(KeyssWarning, match="unchanged.*too small to carry"):
        hidden = library.hide(cover, [large])
    assert hidden.survives
    assert library.reveal(hidden.stego, KEYS[0]).file.data == large.file


def test_hidden_file_survives_conversion(keyss: Run, folder: Path, tmp_path: Path) -> None:
    write_model(tmp_path / "cover.ply", cover(6000))
    (tmp_path / "note.txt").write_text("Meet me at the golden knot. " * 20)
    key, out = ("--key-file", folder / "key0"), tmp_path / "out"
    hide = ("hide", "--cover", tmp_path / "cover.ply", "--secret-file", tmp_path / "note.txt", *key)
    result = keyss(*hide, "--publish", "converted", "-o", out)
    assert (result.status, result.err) == (0, "")
    assert "may be converted" in result.out
    result = keyss("convert", out / "publish" / "model.ply", "-o", tmp_path / "web.spz", *key)
    assert (result.status, result.err) == (0, "")
    assert keyss("reveal", tmp_path / "web.spz", *key, "-o", tmp_path / "back").status == 0
    assert (tmp_path / "back").read_bytes() == (tmp_path / "note.txt").read_bytes()
    result = keyss("reveal", tmp_path / "web.spz", "--key-file", folder / "key1", "-o", tmp_path / "none")
    assert_refused(result, 3, "opens nothing")


@given(st.binary(max_size=300))
def test_foreign_payloads(data: bytes) -> None:
    try:
        file = HiddenFile.of(Payload("file", data))
    except InputError:
        return
    assert len(file.data) <= len(data)
