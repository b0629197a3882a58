"""A batch: its table, what is broken in it, and the keys that open what was hidden."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import pytest

import keyss as library
from cli.harness import Run
from keyss import CarryOptions
from keyss.core import InputError, KeyssWarning, OutputError, WrongKeyError
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
    """Takes no time; covers that are called broken, or are not there, fail."""

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
        (HEAD + "a.ply,secret.ply\0,x\n", "line 2: expected paths"),
        (HEAD + "a.ply,secret.ply,../x\n", "line 2: out: expected a folder in"),
        (HEAD + "a.ply,secret.ply,/x\n", "line 2: out: expected a folder in"),
        (HEAD + "a.ply,secret.ply,Private/x\n", "line 2: out: expected a folder in"),
        (HEAD + "a.ply,secret.ply,x\nb.ply,secret.ply,X\n", "line 3: out: is the folder of "),
        (
            HEAD + "a.ply,secret.ply,x\nb.ply,secret.ply,x/y\n",
            "line 3: out: is the folder of ",
        ),
        (HEAD + "a.ply,secret.ply,x/y\nb.ply,secret.ply,x\n", "line 2: out: is the folder of "),
        (HEAD + '"a.ply,secret.ply,x\n', "expected CSV"),
    ],
)
def test_what_is_wrong_in_a_table_is_said_with_its_line(folder: Path, text: str, words: str) -> None:
    with pytest.raises(InputError) as caught:
        batch.read_rows(manifest(folder, text), master=True)
    assert words in str(caught.value)


def hide(folder: Path, **options: Any) -> ManyResult:
    master = folder / "master.txt"
    return hide_batch(folder / "assets.csv", folder / "out", master_key_file=master, **options)


def rows(count: int, broken: set[int]) -> str:
    """Of so many assets these are broken: a cover that cannot be read, or that is not there."""
    covers = ("broken.ply", "nowhere.ply")
    return HEAD + "".join(
        f"{covers[index % 2] if index in broken else 'a.ply'},secret.ply,asset-{index}\n"
        for index in range(count)
    )


def test_a_cover_that_is_published_twice_is_warned_of(folder: Path) -> None:
    manifest(folder, HEAD + "a.ply,secret.ply,x\nb.ply,secret.ply,y\na.ply,secret.ply,z\n")
    with pytest.warns(KeyssWarning, match=r"1 of the covers \(a.ply\) .* low bits of its own, but comparing"):
        hide(folder)


@fake_hiding
def test_a_broken_asset_does_not_stop_the_others(folder: Path) -> None:
    manifest(folder, rows(4, {0, 1}))
    first = hide(folder)
    assert list(first.errors) == ["asset-0", "asset-1"]
    again = hide(folder)
    assert [each.skipped for each in again.outcomes] == [False, False, True, True]
    manifest(folder, rows(4, set()))  # mended
    mended = hide(folder)
    assert mended.errors == {}
    assert [each.skipped for each in mended.outcomes] == [False, False, True, True]
    with (folder / "out" / "private" / "batch.csv").open() as file:
        assert [row["state"] for row in csv.DictReader(file)] == ["done"] * 4


def real(folder: Path) -> Path:
    """Models of almost no size."""
    library.write_model(folder / "a.ply", random_gaussians(600, seed=0))
    library.write_model(folder / "b.ply", random_gaussians(610, seed=2))
    library.write_model(folder / "secret.ply", random_gaussians(40, seed=1))
    return folder


@fake_hiding
def test_another_master_key_is_refused(folder: Path) -> None:
    manifest(folder, HEAD + "a.ply,secret.ply,x\n")
    hide(folder)
    (folder / "master.txt").write_text("another-key-for-7Qx2")
    with pytest.raises(OutputError, match="another master key"):
        hide(folder)


def test_the_key_of_an_asset_opens_it_and_no_other(tmp_path: Path, keyss: Run) -> None:
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
def test_the_command_line_says_what_failed_and_ends_with_a_status(folder: Path, keyss: Run) -> None:
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
