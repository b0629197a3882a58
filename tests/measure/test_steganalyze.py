"""`keyss steganalyze`: a folder of images becomes a table."""

from __future__ import annotations

import csv
import math
import os
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from cli.said import Run
from keyss.core import InputError, UsageError
from keyss.measure import csv_bytes, read_pixels, score_image, steganalyze
from measure.test_stegexpose import smooth, with_payload


@pytest.fixture
def run(keyss: Run) -> Run:
    """`keyss steganalyze ...`."""
    return partial(keyss, "steganalyze")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Three images, one of them with a full payload, among other things."""
    folder = tmp_path / "images"
    (folder / "more").mkdir(parents=True)
    Image.fromarray(with_payload(smooth(), 1.0)).save(folder / "b.png")
    Image.fromarray(smooth()).save(folder / "c.bmp")
    Image.fromarray(smooth()[:5, :1]).save(folder / "a.png")
    Image.fromarray(smooth()).save(folder / "more" / "d.png")
    (folder / "notes.txt").write_text("no image")
    return folder


def table(path: Path) -> list[dict[str, str]]:
    with path.open() as file:
        return list(csv.DictReader(file))


def test_the_table_has_the_columns_of_the_original_and_the_size_of_the_secret(
    run: Run, folder: Path, tmp_path: Path
) -> None:
    out = tmp_path / "scores.csv"
    with (folder / "c.bmp").open("ab") as file:
        file.write(bytes(200))  # nobody reads them, but they make the guess one that is rounded up
    status, said, errors = run(folder, "--csv", out)
    assert status == 0
    tiny, full, clean = table(out)
    assert ",".join(tiny) == "file,primary_sets,chi_square,sample_pairs,rs,fusion,flagged,secret_bytes"
    assert ",".join(tiny.values()) == "a.png,NaN,null,null,NaN,NaN,false,0"
    assert (full["file"], full["flagged"]) == ("b.png", "true")
    assert (clean["file"], clean["flagged"]) == ("c.bmp", "false")
    scores = score_image(read_pixels(folder / "c.bmp"))
    assert float(clean["rs"]) == scores.rs
    assert float(clean["fusion"]) == scores.fusion
    third = scores.fusion * (folder / "c.bmp").stat().st_size / 3
    assert third % 1 > 0.5
    assert int(clean["secret_bytes"]) == math.ceil(third)
    mean = (float(full["fusion"]) + scores.fusion) / 2
    assert said.splitlines()[1].split() == ["3", "1", f"{mean:.4f}"]
    assert f"{out}: 3 images" in said
    assert "skipped" in errors
    assert "'notes.txt'" in errors


def test_the_threshold_decides(run: Run, folder: Path, tmp_path: Path) -> None:
    assert run(folder, "--csv", tmp_path / "a.csv", "--threshold", 1)[0] == 0
    assert [row["flagged"] for row in table(tmp_path / "a.csv")] == ["false", "false", "false"]
    assert run(folder, "--csv", tmp_path / "b.csv", "--threshold", 0)[0] == 0
    assert [row["flagged"] for row in table(tmp_path / "b.csv")] == ["false", "true", "true"]
    status, said, errors = run(folder, "--csv", tmp_path / "c.csv", "--threshold", 1.5)
    assert (status, said) == (2, "")
    assert "from 0 to 1, got 1.5" in errors
    assert not (tmp_path / "c.csv").exists()
    Image.fromarray(np.zeros((4, 4, 3), dtype=np.uint8)).save(folder / "0.png")  # its scores are 0
    assert not steganalyze(folder, threshold=0).rows[0].flagged
    with pytest.raises(UsageError, match="nan"):
        steganalyze(folder, threshold=float("nan"))


def test_nothing_is_replaced_unasked(run: Run, folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "scores.csv"
    out.write_text("mine")
    status, _, errors = run(folder, "--csv", out)
    assert status == 5
    assert "--overwrite" in errors
    assert out.read_text() == "mine"
    assert run(folder, "--csv", out, "--overwrite")[0] == 0
    assert len(table(out)) == 3


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda folder: folder.mkdir(), "no files"),
        (lambda folder: folder.write_bytes(b""), "expected a folder"),
        (lambda folder: None, "No such file"),
        (lambda folder: (folder.mkdir(), (folder / "a.png").write_bytes(b"x")), "none of its files"),
    ],
)
def test_a_folder_without_images_is_one_sentence(
    run: Run, tmp_path: Path, make: Callable[[Path], object], words: str
) -> None:
    make(tmp_path / "images")
    status, said, errors = run(tmp_path / "images", "--csv", tmp_path / "scores.csv")
    assert (status, said) == (4, "")
    assert errors.splitlines()[-1].startswith("keyss: error: ")
    assert words in errors.splitlines()[-1]
    assert "Traceback" not in errors
    assert not (tmp_path / "scores.csv").exists()


def test_file_names_may_hold_anything(run: Run, tmp_path: Path) -> None:
    folder = tmp_path / "images"
    folder.mkdir()
    Image.fromarray(smooth()[:4, :4]).save(folder / "plain.png")
    strange = os.fsencode(folder) + b'/a,"\xff.png'
    Path(os.fsdecode(strange)).write_bytes((folder / "plain.png").read_bytes())
    (folder / "z\x1b[31m").write_bytes(b"")
    status, _, errors = run(folder, "--csv", tmp_path / "scores.csv")
    assert status == 0
    assert "\x1b" not in errors
    assert b'"a,""\xff.png",' in (tmp_path / "scores.csv").read_bytes()


def test_a_pipe_is_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.png")
    with pytest.raises(InputError, match="no files"):
        steganalyze(tmp_path)


def test_two_runs_give_the_same_bytes(folder: Path) -> None:
    first, second = steganalyze(folder), steganalyze(folder)
    assert csv_bytes(first.rows) == csv_bytes(second.rows)
    assert first.skipped == ["notes.txt"]
    assert first.mean_fusion == np.mean([row.scores.fusion for row in first.rows[1:]])
