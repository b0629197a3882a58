"""Batches: tables, failures, keys."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import pytest

import keyss as library
from cli.harness import Run
from keyss import CarryOptions
from keyss.core import InputError, KeyssWarning, WrongKeyError
from keyss.keys import MasterKey
from keyss.lab.many import ManyResult, batch, hide_batch
from keyss.runs.folder import make_private
from tiny_scenes import random_gaussians

KEY = "q7Rv2LxT9bWm4KzDq7Rv2L"
HEAD = "cover,secret,out\n"
pytestmark = pytest.mark.filterwarnings("ignore:.*published more than once")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "master.txt").write_text(KEY)
    for name in ("a.ply", "b.ply", "broken.ply", "secret.ply"):
        (tmp_path / name).write_text(name)
    return tmp_path


@pytest.fixture
def _fake_hiding(monkeypatch: pytest.MonkeyPatch) -> None:
    """Hide nothing; fail for covers that are missing or called broken."""

    def fake(cover: str, secrets: Any, *, out: Path, **options: Any) -> None:
        if "broken" in Path(cover).name or not Path(cover).exists():
            raise InputError(f"cannot read {cover}")
        (out / "publish").mkdir(parents=True, exist_ok=True)
        make_private(out / "private")
        (out / "publish" / "model.ply").write_text(cover)

    monkeypatch.setattr(batch, "hide", fake)


fake_hiding = pytest.mark.usefixtures("_fake_hiding")


def manifest(folder: Path, text: str) -> Path:
    (folder / "assets.csv").write_text(text)
    return folder / "assets.csv"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "expected the names of columns"),
        (HEAD, "at least one asset"),
        ("covr,secret,out\na,b,c\n", "did you mean cover"),
        ("out,out\na,b\n", "'out' is no column, or one twice"),
        ("cover,out\na,c\n", "line 2: expected a cover, out, and either a secret"),
        ("secret,out\na,c\n", "line 2: expected a cover, out"),
        ("cover,secret,out,key_file\na,b,c,k\n", "line 2: leave out the column key_file"),
        (HEAD + "a.ply,secret.ply\n", "line 2: expected as many columns"),
        (HEAD + "a.ply,,x\n", "line 2: expected a cover, out, and either a secret"),
        (HEAD + "a.ply,secret.ply,../x\n", "line 2: out: expected a folder in"),
        (HEAD + "a.ply,secret.ply,/x\n", "line 2: out: expected a folder in"),
        (HEAD + "a.ply,secret.ply,Private/x\n", "line 2: out: expected a folder in"),
        (HEAD + "a.ply,secret.ply,x\nb.ply,secret.ply,x\n", "line 3: out: 'x' is the folder of "),
        (HEAD + '"a.ply,secret.ply,x\n', "expected CSV"),
    ],
)
def test_invalid_tables(folder: Path, text: str, words: str) -> None:
    with pytest.raises(InputError) as caught:
        batch.read_rows(manifest(folder, text), master=True)
    assert words in str(caught.value)


def hide(folder: Path, **options: Any) -> ManyResult:
    master = folder / "master.txt"
    return hide_batch(folder / "assets.csv", folder / "out", master_key_file=master, **options)


def rows(count: int, broken: set[int]) -> str:
    """A table; assets in `broken` have unreadable or missing covers."""
    covers = ("broken.ply", "nowhere.ply")
    return HEAD + "".join(
        f"{covers[index % 2] if index in broken else 'a.ply'},secret.ply,asset-{index}\n"
        for index in range(count)
    )


def test_warning_of_a_cover_used_twice(folder: Path) -> None:
    manifest(folder, HEAD + "a.ply,secret.ply,x\nb.ply,secret.ply,y\na.ply,secret.ply,z\n")
    with pytest.warns(KeyssWarning, match=r"1 of the covers \(a.ply\) .* low bits of its own, but comparing"):
        hide(folder)


@fake_hiding
def test_failed_assets(folder: Path) -> None:
    manifest(folder, rows(4, {0, 1}))
    first = hide(folder)
    assert list(first.errors) == ["asset-0", "asset-1"]
    again = hide(folder)
    assert [each.skipped for each in again.outcomes] == [False, False, True, True]
    manifest(folder, rows(4, set()))  # repaired
    repaired = hide(folder)
    assert repaired.errors == {}
    assert [each.skipped for each in repaired.outcomes] == [False, False, True, True]
    with (folder / "out" / "private" / "batch.csv").open() as file:
        assert [row["state"] for row in csv.DictReader(file)] == ["done"] * 4


def real(folder: Path) -> Path:
    """Write tiny models."""
    library.write_model(folder / "a.ply", random_gaussians(600, seed=0))
    library.write_model(folder / "b.ply", random_gaussians(610, seed=2))
    library.write_model(folder / "secret.ply", random_gaussians(40, seed=1))
    return folder


def test_another_master_key(folder: Path) -> None:
    real(folder)
    manifest(folder, HEAD + "a.ply,secret.ply,x\n")
    assert not hide(folder, width=32).errors
    (folder / "master.txt").write_text("another-key-for-7Qx2")
    assert "exists" in hide(folder, width=32).errors["x"]


def test_keys_of_assets(tmp_path: Path, keyss: Run) -> None:
    real(tmp_path)
    (tmp_path / "letter.txt").write_text("for your eyes only")
    (tmp_path / "master.txt").write_text(KEY)
    manifest(
        tmp_path,
        "cover,secret,secret_file,out\na.ply,secret.ply,,scenes/1\na.ply,,letter.txt,files/1\n",
    )
    result = hide(tmp_path, method=CarryOptions(publish="any"), width=32)
    assert [each.error for each in result.outcomes] == [None, None]
    out = tmp_path / "out"
    said = keyss("keygen", "--asset", "scenes/1", "--master-key-file", tmp_path / "master.txt")
    key = said.out.strip()
    assert key == MasterKey(KEY).key_of("scenes/1")
    stego = out / "scenes" / "1" / "publish" / "model.ply"
    assert len(library.reveal(stego, key).gaussians) == 40
    other = MasterKey(KEY).key_of("files/1")
    with pytest.raises(WrongKeyError):
        library.reveal(stego, other)
    found = library.reveal(out / "files" / "1" / "publish" / "model.ply", other).file
    assert (found.name, found.data) == ("letter.txt", b"for your eyes only")
    assert (out / "private").stat().st_mode & 0o077 == 0


@fake_hiding
def test_command(folder: Path, keyss: Run) -> None:
    manifest(folder, rows(3, {0, 1}))
    arguments = ["hide", "--batch", folder / "assets.csv", "--method", "carry", "-o", folder / "out"]
    said = keyss(*arguments, "--master-key-file", folder / "master.txt")
    assert said.status == 4
    assert "1 of 3 assets are done" in said.out
    assert "failed: asset-1: cannot read" in said.out
    assert "cannot read" not in said.err  # once is enough
    assert said.err.rstrip().endswith("error: 2 of 3 assets failed")
    for wrong in (["--cover", folder], ["--key-file", folder / "master.txt"], ["--resume"], ["--dry-run"]):
        said = keyss(*arguments, *wrong)
        assert said.status == 2
        assert wrong[0] in said.err
    assert "--cores is for many" in keyss("hide", "--cover", folder, "--cores", 2, "-o", "x").err
    assert "--cover SCENE" in keyss("hide", "--secret", folder, "-o", "x").err
