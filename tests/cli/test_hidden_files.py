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
HIDE = "hide --cover cover.ply --secret-file letter.pdf --secret-file empty --key-file key0 --key-file key1"
STEGO = "out/publish/model.ply"


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A cover, two files, two keys, and `out`, which hides both."""
    made = tmp_path_factory.mktemp("files")
    write_model(made / "cover.ply", trained_like(3000))
    (made / "letter.pdf").write_bytes(os.urandom(3000))
    (made / "empty").write_bytes(b"")
    for index, key in enumerate(KEYS):
        write_key(made / f"key{index}", key)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(made)
        assert main([*HIDE.split(), "-o", "out"]) == 0
    return made


@pytest.fixture(autouse=True)
def folder(files: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(files)


def test_round_trip(keyss: Run, tmp_path: Path) -> None:
    assert os.path.getsize(STEGO) == os.path.getsize("cover.ply")
    for index, name in enumerate(("letter.pdf", "empty")):
        out = tmp_path / f"back{index}"
        result = keyss(f"reveal {STEGO} --key-file key{index} -o {out}")
        assert result.status == 0
        assert repr(name) in result.out
        assert out.read_bytes() == Path(name).read_bytes()
        assert stat.S_IMODE(out.stat().st_mode) == 0o600


def test_hidden_model_file_is_revealed_as_it_was(tmp_path: Path) -> None:
    """Its suffix is that of a model, and its bytes are not read as one."""
    hidden = library.hide(trained_like(2000), [library.SecretFile(b"any bytes", KEYS[0], "scan.ply")])
    library.reveal(hidden.stego, KEYS[0], out=tmp_path / "back.ply")
    assert (tmp_path / "back.ply").read_bytes() == b"any bytes"
    with pytest.raises(UsageError, match=r"name the output like it, not back\.spz"):
        library.reveal(hidden.stego, KEYS[0], out=tmp_path / "back.spz")


def test_verify(keyss: Run) -> None:
    for command in ("evaluate", "audit"):
        assert_refused(keyss(f"{command} out"), 4, f"nothing to evaluate; `keyss verify {STEGO} ")
    for index, count in enumerate(("3,000 of 3,000", "0")):
        result = keyss(f"verify {STEGO} --key-file key{index}")
        assert (result.status, result.err) == (0, "")
        assert f"secret  {count} bytes: complete" in result.out


def test_file_from_a_pruned_model(keyss: Run, tmp_path: Path) -> None:
    """The file is complete, and the loss does not go unnoticed."""
    stego, out = read_model(STEGO), tmp_path / "file.bin"
    write_model(tmp_path / "pruned.ply", stego[: len(stego) * 4 // 5])
    for status, command in ((4, "verify"), (0, f"reveal -o {out}")):
        result = keyss(f"{command} {tmp_path}/pruned.ply --key-file key0")
        assert result.status == status
        assert "shards of the secret's payload were lost, and restored" in result.err
    assert out.stat().st_size == 3000


def test_invalid_combinations(keyss: Run, workspace: Path, tmp_path: Path) -> None:
    hide, reveal = f"{HIDE} -o {tmp_path}/out", f"reveal {STEGO} --key-file key0 -o {tmp_path}"
    letter = f"hide --cover cover.ply --secret letter.pdf --key-file key0 -o {tmp_path}/out"
    photos = f"hide --cover {workspace}/a --secret-file empty --key-file key0 -o {tmp_path}/out"
    for status, words, command in (
        (2, "scenes or files, not both", f"{hide} --secret cover.ply"),
        (2, "--secret-file does not use --min-psnr", f"{hide} --min-psnr 60"),
        (2, "--secret-file does not use --seed", f"{hide} --seed 0"),
        (2, "--secret-file does not use --fine-tune", f"{hide} --fine-tune never"),
        (4, "--secret-file hides any file", letter),
        (2, "needs a model as the cover", photos),
        (2, "3,000 bytes, 'letter.pdf'", f"{reveal}/s.ply"),
        (2, "--frame is for scenes", f"{reveal}/back --frame cover"),
        (3, "opens nothing", f"{reveal}/back".replace(STEGO, "cover.ply")),
        (5, "given away", f"reveal {STEGO} --key-file key0 -o out/publish/back"),
    ):
        assert_refused(keyss(command), status, words)
    planned = keyss(f"{hide} --dry-run")
    assert (planned.status, planned.out.splitlines()[-1]) == (0, "Dry run: nothing was written.")
    assert listing(tmp_path) == {}


def test_names_that_are_not_text(tmp_path: Path) -> None:
    named = tmp_path / os.fsdecode(b"K\xfcche.pdf")
    named.write_bytes(b"plan")
    hidden = library.hide("cover.ply", [library.SecretFile(named, KEYS[0])])
    assert hidden.stego is not None
    expected = HiddenFile("K\N{REPLACEMENT CHARACTER}che.pdf", b"plan")
    assert library.reveal(hidden.stego, KEYS[0]).file == expected


def test_file_too_large() -> None:
    """It is appended, unless the model must stay unchanged."""
    large, cover = library.SecretFile(os.urandom(90_000), KEYS[0]), trained_like(2000)
    with pytest.raises(UsageError, match=r"too small to carry .* Gaussians would do; .publish=.converted."):
        library.hide(cover, [large], publish="unchanged")
    with pytest.warns(KeyssWarning, match="unchanged.*too small to carry"):
        hidden = library.hide(cover, [large])
    assert hidden.survives
    assert library.reveal(hidden.stego, KEYS[0]).file.data == large.file


def test_hidden_file_survives_conversion(keyss: Run, tmp_path: Path) -> None:
    key, note = Path("key0").absolute(), tmp_path / "note.txt"
    write_model(tmp_path / "cover.ply", cover(6000))
    note.write_text("Meet me at the golden knot. " * 20)
    os.chdir(tmp_path)
    hidden = keyss("hide --cover cover.ply --secret-file note.txt --publish converted -o out --key-file", key)
    assert (hidden.status, hidden.err) == (0, "")
    assert "may be converted" in hidden.out
    converted = keyss(f"convert {STEGO} -o web.spz --key-file {key}")
    assert (converted.status, converted.err) == (0, "")
    assert keyss(f"reveal web.spz --key-file {key} -o back").status == 0
    assert (tmp_path / "back").read_bytes() == note.read_bytes()
    assert_refused(keyss(f"reveal web.spz --key-file {key.with_name('key1')} -o none"), 3, "opens nothing")


@given(st.binary(max_size=300))
def test_foreign_payloads(data: bytes) -> None:
    try:
        file = HiddenFile.of(Payload("file", data))
    except InputError:
        return
    assert len(file.data) <= len(data)
