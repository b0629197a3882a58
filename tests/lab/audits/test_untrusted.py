"""Broken and hostile audits."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from hypothesis import given, strategies as st

from keyss.core import InputError
from keyss.lab.audits import read_audit, report as page_module
from lab.audits.pages import Parsed

AuditPictures, check_bounds = page_module.AuditPictures, page_module.check_bounds
clean, prose = page_module.clean, page_module.prose


@pytest.fixture
def run(run_folder: Path, tmp_path: Path) -> Path:
    """A copy of the audit that may be changed, with a picture whose name is known."""
    shutil.copytree(run_folder / "private" / "audit", tmp_path / "run" / "private" / "audit")
    pictures = tmp_path / "run" / "private" / "audit" / "pictures"
    (pictures / "cover-1-photo.png").rename(pictures / "photo.png")
    return tmp_path / "run"


def test_no_audit_says_how_to_get_one(tmp_path: Path) -> None:
    (tmp_path / "private").mkdir()
    (tmp_path / "private" / "config.json").write_text("{}")
    with pytest.raises(InputError, match=r"there is no audit; `keyss audit .* makes one"):
        read_audit(tmp_path)


@pytest.mark.parametrize("text", ["", "[]", '{"version": 1}', '{"version": 2}', '{"version": 2, "run": {}}'])
def test_broken_audits_are_refused(run: Path, text: str) -> None:
    (run / "private" / "audit" / "audit.json").write_text(text)
    with pytest.raises(InputError, match=r"audit\.json: expected"):
        read_audit(run)


def test_numbers_and_lists_have_bounds(monkeypatch: pytest.MonkeyPatch) -> None:
    check_bounds({"seeds": (1, 10**15)})
    for huge in (10**400, -(10**16)):
        with pytest.raises(InputError, match=r"audit\.seeds\[1\]: expected a number of at most 1e\+15"):
            check_bounds({"seeds": (1, huge)})
    with pytest.raises(InputError, match=r"audit\.a\.b: expected a number"):
        check_bounds({"a": {"b": 1e16}})
    monkeypatch.setattr(page_module, "_MAX_ENTRIES", 2)
    check_bounds({"seeds": (1, 2)})
    with pytest.raises(InputError, match="at most 2 entries, found 3"):
        check_bounds({"seeds": (1, 2, 3)})


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
    clean(text).encode()


@given(text=st.text())
def test_prose_is_text_with_code_in_backquotes(text: str) -> None:
    page = Parsed(prose(text))
    assert set(page.tags) <= {"code"}
    assert "".join(page.texts) == clean(text).replace("`", "")


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
def test_pictures_outside_the_audit_are_refused(run: Path, tmp_path: Path, name: str) -> None:
    outside = tmp_path / "outside.png"
    shutil.copy(run / "private" / "audit" / "pictures" / "photo.png", outside)
    shutil.copy(outside, run / "outside.png")
    (run / "private" / "audit" / "link.png").symlink_to(outside)
    (run / "private" / "audit" / "linked").symlink_to(tmp_path)
    (run / "private" / "audit" / "loop").symlink_to(run / "private" / "audit" / "loop")
    with pytest.raises(InputError):
        AuditPictures(run).read(name.format(outside=outside))


def test_only_png_files_are_pictures(run: Path) -> None:
    pictures = run / "private" / "audit" / "pictures"
    (pictures / "drawing.png").write_text('<svg xmlns="http://www.w3.org/2000/svg"><script/></svg>')
    (pictures / "cut.png").write_bytes((pictures / "photo.png").read_bytes()[:20])
    for name in ("drawing.png", "cut.png", "missing.png", ""):
        with pytest.raises(InputError):
            AuditPictures(run).read(f"pictures/{name}")
