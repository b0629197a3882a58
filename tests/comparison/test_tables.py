"""What a comparison's tables say, of made-up records, and what they keep to."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from keyss.cli.tables import parts_within
from keyss.comparison import sheet
from keyss.comparison.record import (
    ComparedMethod,
    Comparison,
    SceneScores,
    Secrecy,
    Survival,
    WrongKeysShow,
)
from keyss.comparison.tables import impossible, markdown, not_measured, tables
from keyss.measure.speed import ReaderResult
from keyss.methods.base import Capabilities

SCENE = SceneScores(psnr=25.4, ssim=0.836, lpips=0.15, render_seconds=0.0123, render_ratio=1.04)
READS = tuple(ReaderResult(name, "stego.ply", True, 5) for name in ("plyfile", "gsply", "splat-transform"))
ROW = ComparedMethod(
    name="a|b",
    cover=SCENE,
    secret=replace(SCENE, lpips=None),
    secrecy=Secrecy(
        classifier=0.97,
        classifier_plain=0.67,
        stealth=0.0,
        stealth_plain=0.42,
        stealth_statistic="bits: ones",
        stegexpose=0.19,
        stegexpose_plain=0.45,
    ),
    survival=(
        Survival(change="pruned", sentence="", cover_loss=2.53, secret_loss=0.04),
        Survival(change=".spz", sentence="", cover_loss=-0.26, secret_loss=None),
        Survival(change="purified", sentence="", skipped="no tool"),
    ),
    readers=READS,
    trained=(2000, None),
    published_bytes=4_900_000,
    seconds=13.6,
)


def cells(*rows: ComparedMethod) -> list[dict[str, str]]:
    """By head, the scenes' PSNRs under theirs."""
    found: list[dict[str, str]] = [{} for _ in rows]
    for table in tables(Comparison(arguments={}, methods=rows)):
        for own, row in zip(found, table.rows, strict=True):
            own.update(zip(table.heads, row, strict=True))
    return found


def test_every_figure_stands_beside_that_of_a_plain_model() -> None:
    (found,) = cells(ROW)
    assert found["classifier"] == "0.97 (0.67)"
    assert found["p"] == "<1e-16 (0.4)"
    assert found["StegExpose"] == "0.19 (0.45)"
    assert found["picture, ms"] == "12 (1.0x), 12 (1.0x)"
    assert found["steps"] == "2,000, unknown"
    assert (found["published"], found["handed over"]) == ("4.90 MB", "nothing")


def test_what_does_not_open_is_lost_and_what_was_not_tried_is_not_said_to_be() -> None:
    (found,) = cells(ROW)
    assert found["pruned"] == "-2.5, +0.0"
    assert found[".spz"] == "+0.3, lost"
    assert found["purified"] == "not tried"
    assert not_measured(Comparison(arguments={}, methods=(ROW,))) == ["not tried (a|b): purified: no tool"]


def test_a_standard_file_is_what_readers_read_not_what_a_method_says() -> None:
    fails = replace(READS[0], loads=False)
    absent = replace(READS[1], loads=None, note="pip install it")
    rows = [
        replace(ROW, readers=readers)
        for readers in (READS, (fails, *READS[1:]), (READS[0], absent), (absent,), ())
    ]
    assert [each["standard .ply"] for each in cells(*rows)] == [
        "yes, 3 of 3 readers",
        "no, 2 of 3 readers",
        "yes, 1 of 1 readers",
        "not tried",
        "not tried",
    ]
    assert any(
        "pip install it" in line for line in not_measured(Comparison(arguments={}, methods=tuple(rows)))
    )


def test_wrong_keys() -> None:
    shown = WrongKeysShow(cover=25.31, secret=9.87, chance=9.5)
    keyless = Capabilities(keys=False)
    rows = (replace(ROW, wrong_keys=shown), ROW, replace(ROW, capabilities=keyless))
    assert [each["wrong keys"] for each in cells(*rows)] == ["25.3, 9.9 (9.5)", "open nothing", "no keys"]


def test_markdown_has_equal_rows_and_a_sentence_for_what_was_not_possible() -> None:
    none = ComparedMethod(name="c", error="no room")
    comparison = Comparison(arguments={}, methods=(ROW, none))
    assert impossible(comparison) == ["c: not possible: no room"]
    text = markdown(comparison)
    for part in text.split("## ")[1:]:
        lines = [line for line in part.splitlines() if line.startswith("|")]
        assert len(lines) == 3  # heads, rule, the one that was possible
        assert len({line.count("|") for line in lines}) == 1
    assert "- c: not possible: no room" in text
    assert "## Fidelity" in markdown(Comparison(arguments={}))  # also where nothing was possible


def test_what_just_fits_is_one_part() -> None:
    rows = [["a", "bbb", ""], ["aa", "b", "ccc"]]  # "aa  bbb  ccc"
    assert parts_within(12, rows) == [[0, 1, 2]]
    assert parts_within(11, rows) == [[0, 1], [0, 2]]
    assert parts_within(3, rows) == [[0, 1], [0, 2]]  # no narrower than that


@given(
    st.integers(1, 200),
    st.lists(st.lists(st.integers(0, 60), min_size=9, max_size=9), min_size=1, max_size=4),
    st.integers(1, 9),
)
def test_parts_hold_all_columns_in_order_and_no_more_than_fit(
    width: int, lengths: list[list[int]], columns: int
) -> None:
    rows = [["x" * length for length in row[:columns]] for row in lengths]
    parts = parts_within(width, rows)
    assert all(part[0] == 0 for part in parts)
    assert [index for part in parts for index in part[1:]] == list(range(1, columns))
    for part in parts:
        line = "  ".join(max((row[index] for row in rows), key=len) for index in part)
        assert len(line) <= width or len(part) <= 2


def test_no_heading_of_the_picture_is_cut() -> None:
    """However narrow the pictures are."""
    narrow = [np.zeros((40, 2, 3), np.uint8)] * 3
    picture = sheet._drawn([("photos", narrow)])
    right = np.asarray(picture)[:25, -4:]  # a gap's worth of white right of the last heading
    assert (right == 255).all()
