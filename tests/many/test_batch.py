"""A batch: its table, what is broken in it, and the keys that open what was hidden."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import pytest

import keyss as library
from cli.said import Run
from keyss import CarryOptions
from keyss.core import InputError, KeyssWarning, OutputError, WrongKeyError
from keyss.keys import MasterKey
from keyss.many import ManyResult, batch, cell, engines, hide_batch
from many.fakes import REAL
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


def manifest(folder: Path, text: str) -> Path:
    (folder / "assets.csv").write_text(text)
    return folder / "assets.csv"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "expected a first line"),
        (HEAD, "at least one asset"),
        ("covr,secret,out\na,b,c\n", "did you mean cover"),
        ("cover,out\na,c\n", "a column secret or secret_file"),
        ("cover,secret,out,key_file\na,b,c,k\n", "leave out the column key_file"),
        (HEAD + "a.ply,secret.ply\n", "line 2: expected 3 columns, got 2"),
        (HEAD + "a.ply,,x\n", "line 2: expected a secret or a secret_file, got none"),
        (HEAD + "a.ply,secret.ply,../x\n", "line 2: out: expected the name of a folder"),
        (HEAD + "a.ply,secret.ply,/x\n", "line 2: out: expected the name of a folder"),
        (HEAD + "a.ply,secret.ply,Private/x\n", "line 2: out: expected the name of a folder"),
        (HEAD + "a.ply,secret.ply,x\nb.ply,secret.ply,X\n", "line 3: out: X is the folder of line 2"),
        (HEAD + "a.ply,secret.ply,x\nb.ply,secret.ply,x/y\n", "x/y lies in the folder of line 2"),
        (HEAD + "a.ply,secret.ply,x/y\nb.ply,secret.ply,x\n", "lies in the folder of line 3"),
        (HEAD + '"a.ply,secret.ply,x\n', "expected CSV"),
    ],
)
def test_what_is_wrong_in_a_table_is_said_with_its_line(folder: Path, text: str, words: str) -> None:
    with pytest.raises(InputError) as caught:
        batch.read_assets(manifest(folder, text), master=True)
    assert words in str(caught.value)


def test_without_a_master_key_every_row_names_a_key_file(folder: Path) -> None:
    with pytest.raises(InputError, match="expected a column key_file"):
        batch.read_assets(manifest(folder, HEAD + "a.ply,secret.ply,x\n"), master=False)


def hide(folder: Path, **options: Any) -> ManyResult:
    master = folder / "master.txt"
    return hide_batch(folder / "assets.csv", folder / "out", master_key_file=master, jobs=2, **options)


def rows(count: int, broken: set[int]) -> str:
    """Of so many assets these are broken: a cover that cannot be read, or that is not there."""
    covers = ("broken.ply", "nowhere.ply")
    return HEAD + "".join(
        f"{covers[index % 2] if index in broken else 'a.ply'},secret.ply,asset-{index}\n"
        for index in range(count)
    )


def check_batch(folder: Path, count: int, broken: set[int]) -> None:
    manifest(folder, rows(count, broken))
    first = hide(folder)
    assert {each.name for each in first.failed} == {f"asset-{index}" for index in broken}
    assert len(first.failed) == len(broken)
    again = hide(folder)
    assert sum(each.skipped for each in again.outcomes) == count - len(broken)
    manifest(folder, rows(count, set()))  # mended
    mended = hide(folder)
    assert mended.failed == ()
    assert sum(each.skipped for each in mended.outcomes) == count - len(broken)
    with (folder / "out" / "private" / "batch.csv").open() as file:
        assert [row["state"] for row in csv.DictReader(file)] == ["done"] * count
    for index in range(count):
        assert (folder / "out" / f"asset-{index}" / "publish" / "model.ply").exists()


def test_a_cover_that_is_published_twice_is_warned_of(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(engines, "WORKER", ("false",))
    manifest(folder, HEAD + "a.ply,secret.ply,x\nb.ply,secret.ply,y\na.ply,secret.ply,z\n")
    with pytest.warns(KeyssWarning, match=r"1 of the covers \(a.ply\) .* low bits of its own, but comparing"):
        hide(folder)


def test_a_broken_asset_does_not_stop_the_others(folder: Path) -> None:
    check_batch(folder, 3, {0, 1})


@pytest.mark.slow
def test_two_hundred_assets_of_which_five_are_broken(folder: Path) -> None:
    check_batch(folder, 200, {3, 50, 101, 150, 199})


def test_results_that_were_made_otherwise_are_not_replaced_unasked(folder: Path) -> None:
    manifest(folder, HEAD + "a.ply,secret.ply,x\n")
    (folder / "out" / "x").mkdir(parents=True)
    (folder / "out" / "x" / "mine.txt").write_text("mine")
    assert "not from this batch" in str(hide(folder).failed[0].error)
    (folder / "out" / "x" / "mine.txt").unlink()
    assert hide(folder).failed == ()
    (folder / "a.ply").write_text("another cover")
    cell.checksum.cache_clear()  # a process reads data once
    assert "other inputs or options" in str(hide(folder).failed[0].error)
    assert hide(folder, overwrite=True).failed == ()


def test_another_master_key_is_refused(folder: Path) -> None:
    manifest(folder, HEAD + "a.ply,secret.ply,x\n")
    hide(folder)
    (folder / "master.txt").write_text("another-key-for-7Qx2")
    with pytest.raises(OutputError, match="another master key"):
        hide(folder)


def test_another_key_in_a_key_file_is_not_taken_for_the_one_before(folder: Path) -> None:
    key_file = folder / "key.txt"
    manifest(folder, "cover,secret,out,key_file\na.ply,secret.ply,x,key.txt\n")

    def run(**options: Any) -> ManyResult:
        return hide_batch(folder / "assets.csv", folder / "out", jobs=1, **options)

    key_file.write_text(KEY)
    assert run().failed == ()
    assert run().outcomes[0].skipped
    key_file.rename(folder / "moved.txt")
    manifest(folder, "cover,secret,out,key_file\na.ply,secret.ply,x,moved.txt\n")
    assert run().outcomes[0].skipped
    (folder / "moved.txt").write_text(KEY[::-1])
    assert "made with another key" in str(run().failed[0].error)
    again = run(overwrite=True)
    assert again.failed == ()
    assert not again.outcomes[0].skipped
    assert run().outcomes[0].skipped
    assert not any(KEY[::-1].encode() in path.read_bytes() for path in (folder / "out").rglob("*.*"))


def test_a_name_that_no_file_can_have_does_not_stop_the_others(folder: Path) -> None:
    manifest(folder, HEAD + f"a.ply,secret.ply,{'x' * 300}\na.ply,secret.ply,y\n")
    long, other = hide(folder).outcomes
    assert "cannot write" in str(long.error)
    assert other.error is None


@pytest.mark.counted
def test_the_key_of_an_asset_opens_it_and_no_other(
    tmp_path: Path, keyss: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Through the real worker and the command line."""
    monkeypatch.setattr(engines, "WORKER", REAL)
    library.write_model(tmp_path / "a.ply", random_gaussians(300, seed=0))
    library.write_model(tmp_path / "secret.ply", random_gaussians(40, seed=1))
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


def test_the_command_line_says_what_failed_and_ends_with_a_status(folder: Path, keyss: Run) -> None:
    manifest(folder, rows(3, {0, 1}))
    arguments = ["hide", "--batch", folder / "assets.csv", "--method", "carry", "-o", folder / "out"]
    said = keyss(*arguments, "--master-key-file", folder / "master.txt", "--jobs", 1)
    assert said.status == 4
    assert "1 of 3 assets are done" in said.out
    assert "failed: asset-1: cannot read" in said.out
    assert "cannot read" not in said.err  # once is enough
    assert said.err.rstrip().endswith("error: 2 of 3 assets failed")
    for wrong in (["--cover", folder], ["--key-file", folder / "master.txt"], ["--resume"], ["--dry-run"]):
        said = keyss(*arguments, *wrong)
        assert said.status == 2
        assert wrong[0] in said.err
    assert "--jobs is for many" in keyss("hide", "--cover", folder, "--jobs", 1, "-o", "x").err
    assert "--cover SCENE" in keyss("hide", "--secret", folder, "-o", "x").err
