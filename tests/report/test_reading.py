"""Audits that are broken, hostile or from somewhere else."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import pytest

from keyss.core.errors import InputError
from keyss.report import reading
from keyss.report.reading import Part, Pictures, clean, read_audit
from report.audits import write_run


def part(**entries: Any) -> Part:
    return Part("audit.json: ", entries)


def written(folder: Path, text: str | bytes) -> Path:
    (folder / "audit").mkdir()
    (folder / "audit" / "audit.json").write_bytes(text.encode() if isinstance(text, str) else text)
    return folder


def test_no_audit_says_how_to_get_one(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"found nothing there; `keyss audit .* makes one"):
        read_audit(tmp_path)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "{",
        "[]",
        '"text"',
        "{}",
        '{"version": 2}',
        '{"version": "1"}',
        '{"version": true}',
        b"\xff\xfe\x00",
        '{"version": ' + 5000 * "1" + "}",
        '{"version": 1, "a": ' + 100_000 * "[",
        "[" * 900 + "]" * 900,
    ],
    ids=lambda text: repr(text)[:20],
)
def test_broken_files_are_refused(tmp_path: Path, text: str | bytes) -> None:
    with pytest.raises(InputError, match=r"audit\.json"):
        read_audit(written(tmp_path, text))


def test_a_file_that_is_too_large_is_not_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reading, "_MAX_BYTES", 10)
    with pytest.raises(InputError, match="at most 10 bytes"):
        read_audit(written(tmp_path, '{"version": 1}'))


def test_what_is_missing_or_null_is_empty() -> None:
    for empty in (part(), part(a=None)):
        assert empty.text("a") == ""
        assert empty.number("a") is None
        assert empty.flag("a") is None
        assert not empty.part("a")
        assert not empty.part("a").part("b").number("c")
        assert empty.parts("a") == empty.numbers("a") == empty.texts("a") == empty.lists("a", 1) == []
        assert empty.named("a") == {}


@pytest.mark.parametrize("wrong", ["text", 1, 1.5, True, [], {}, [[]], [1], ["a"], [{}]], ids=repr)
def test_another_type_is_refused_with_its_place(wrong: Any) -> None:
    inside = Part("f: ", {"x": {"a": wrong}}).part("x")
    readers = {
        "text": (inside.text, str),
        "number": (inside.number, (int, float)),
        "true or false": (inside.flag, bool),
        "an object": (inside.part, dict),
        "a list": (inside.parts, list),
    }
    for expected, (read, kind) in readers.items():
        if isinstance(wrong, kind) and not (expected == "number" and wrong is True):
            continue
        with pytest.raises(InputError, match=rf"f: x\.a: expected (a )?{expected}, found"):
            read("a")


def test_entries_of_lists_are_checked_too() -> None:
    with pytest.raises(InputError, match=r"audit\.json: a\[1\]: expected an object, found a text"):
        part(a=[{}, "b"]).parts("a")
    with pytest.raises(InputError, match=r"audit\.json: a\[0\]: expected a number, found a text"):
        part(a=["b"]).numbers("a")
    with pytest.raises(InputError, match=r"audit\.json: a\[0\]\[0\]: expected an object, found a number"):
        part(a=[[1]]).lists("a", 10)
    with pytest.raises(InputError, match=r"audit\.json: a\[0\]\[1\]: expected a finite number"):
        part(a=[[1, math.inf]]).number_lists("a", 10)
    with pytest.raises(InputError, match="at most 2 entries, found 3"):
        part(a=[{}, {}, {}]).parts("a", at_most=2)
    with pytest.raises(InputError, match="at most 1 entries, found 2"):
        part(a={"b": {}, "c": {}}).named("a", at_most=1)


def test_numbers_have_bounds() -> None:
    assert part(a=math.nan).number("a") is None
    assert part(a=math.inf).number("a") == math.inf
    assert part(a=10**15).number("a") == 1e15
    for huge in (10**400, -(10**16), 1e16):
        with pytest.raises(InputError, match="at most 1e\\+15"):
            part(a=huge).number("a")


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("Füchse 狐 🦊", "Füchse 狐 🦊"),
        ("two\nlines\ttab", "two lines tab"),
        ("nul\0 bell\a", "nul\ufffd bell\ufffd"),
        ("right\u202eleft", "right\ufffdleft"),
        ("half \ud83e", "half \ufffd"),
        ("x" * 5000, "x" * 999 + "…"),
    ],
)
def test_texts_are_made_printable(text: str, shown: str) -> None:
    assert clean(text) == shown
    assert part(a=text).text("a") == shown
    clean(text).encode()


def test_nested_values_as_rows() -> None:
    config: dict[str, Any] = {"fit": {"seed": 7, "rate": 0.1, "on": True}, "mask": ["op", "sc"], "none": None}
    assert part(**config).flat() == [
        ("fit.seed", "7"),
        ("fit.rate", "0.1"),
        ("fit.on", "yes"),
        ("mask", "op, sc"),
        ("none", "none"),
    ]
    deep_list: Any = 1
    deep: dict[str, Any] = {}
    for _ in range(900):
        deep, deep_list = {"a": deep}, [deep_list]
    assert len(part(deep=deep, list=deep_list).flat()) == 2


def test_a_picture_comes_with_its_size(run_folder: Path) -> None:
    picture = Pictures(run_folder).read(part(file="pictures/photo.png"), "file")
    assert picture is not None
    assert (picture.width, picture.height) == (8, 6)
    assert picture.url.startswith("data:image/png;base64,iVBORw0KGgo")
    assert Pictures(run_folder).read(part(), "file") is None


@pytest.mark.parametrize(
    "name",
    [
        "../outside.png",
        "pictures/../../outside.png",
        "link.png",
        "linked/outside.png",
        "loop",
        "{outside}",
        "/etc/passwd",
        "a\0b.png",
        "x" * 900,
    ],
)
def test_pictures_outside_the_audit_are_refused(tmp_path: Path, name: str) -> None:
    outside = tmp_path / "outside.png"
    run = write_run(tmp_path / "run", {"version": 1})
    (run / "audit" / "pictures" / "photo.png").rename(outside)
    (run / "outside.png").write_bytes(outside.read_bytes())
    (run / "audit" / "link.png").symlink_to(outside)
    (run / "audit" / "linked").symlink_to(tmp_path)
    (run / "audit" / "loop").symlink_to(run / "audit" / "loop")
    with pytest.raises(InputError):
        Pictures(run).read(part(file=name.format(outside=outside)), "file")


def test_only_png_files_are_pictures(tmp_path: Path) -> None:
    run = write_run(tmp_path, {"version": 1})
    pictures = run / "audit" / "pictures"
    (pictures / "drawing.png").write_text('<svg xmlns="http://www.w3.org/2000/svg"><script/></svg>')
    (pictures / "cut.png").write_bytes((pictures / "photo.png").read_bytes()[:20])
    for name in ("drawing.png", "cut.png", "missing.png", ""):
        with pytest.raises(InputError):
            Pictures(run).read(part(file=f"pictures/{name}"), "file")


def test_pictures_have_a_limit_together(run_folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    size = (run_folder / "audit" / "pictures" / "photo.png").stat().st_size
    monkeypatch.setattr(reading, "_MAX_PICTURES", 2 * size)
    pictures = Pictures(run_folder)
    for _ in range(2):
        pictures.read(part(file="pictures/photo.png"), "file")
    with pytest.raises(InputError, match="at most 0 bytes"):
        pictures.read(part(file="pictures/photo.png"), "file")


def test_a_whole_audit_is_read(tmp_path: Path) -> None:
    run = written(tmp_path, json.dumps({"version": 1, "keyss": "0.2.0", "unknown": [1]}))
    assert read_audit(run).text("keyss") == "0.2.0"
