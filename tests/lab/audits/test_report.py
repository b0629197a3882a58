"""The report of a whole audit, of parts of it, and with hostile texts."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import pytest
from PIL import Image

from keyss.core import InputError
from keyss.lab.audits import PARTS, Audit, Section, Verdict, read_audit
from keyss.lab.audits.report import report_of

PICTURE = re.compile(r"!\[[^\]]+\]\(([^)]+)\)")


def test_numbers_and_pictures_of_every_part(run_folder: Path) -> None:
    audit = read_audit(run_folder)
    report = (run_folder / "private" / "report.md").read_text()
    assert [line[3:] for line in report.splitlines() if line.startswith("## ")] == [
        "Verdicts",
        *(part.title for part in PARTS.values()),
    ]
    numbers = {name: section.numbers for name, section in audit.sections.items()}
    changes = numbers["robustness"]["changes"]
    shown = [
        f"{numbers['images']['cover, published model']['psnr']:.2f}",
        f"{numbers['images']['secret 2, revealed']['psnr']:.2f}",
        f"{numbers['leaks']['secret 2'][0]['scores']['gradient']:.3f}",
        f"{numbers['parameters']['sinkhorn']['sum']:.4f}",
        f"{numbers['parameters']['score']:.2f}",
        f"{numbers['stegexpose']['control']['auc']:.2f}",
        f"{changes[1]['secrets'][1]['psnr']:.2f}",
        f"{numbers['speed']['published model']['ratio']:.2f}",
        "Mean over 3 seeds.",
        "not tried: ",
        "Every number is rounded to half precision.",
    ]
    assert [text for text in shown if text not in report] == []
    files = PICTURE.findall(report)
    assert len(files) == 3 + 2  # scenes, and attacks on secrets
    for file in files:
        with Image.open(run_folder / "private" / file) as picture:
            picture.verify()


def test_tables_have_equal_rows(run_folder: Path) -> None:
    """Cells are escaped, so a row has as many of them as its heads."""
    rows = [
        line for line in (run_folder / "private" / "report.md").read_text().splitlines() if line[:1] == "|"
    ]
    widths = [len(re.findall(r"(?<!\\)\|", row)) for row in rows]
    starts = [index for index, row in enumerate(rows) if "| --- |" in row]
    for start, end in zip(starts, [*starts[1:], len(rows) + 1], strict=True):
        assert len(set(widths[start - 1 : end - 1])) == 1


def test_parts_that_were_not_measured(run_folder: Path) -> None:
    audit = read_audit(run_folder)
    report = report_of(replace(audit, sections={"speed": audit.sections["speed"]}), "pictures")
    assert "No part that was measured has a limit." in report
    assert "Not measured: Test views" in report
    assert "## Robustness" not in report


@pytest.mark.parametrize(
    "text",
    [
        "<script>alert(1)</script>",
        "![x](http://example.org/x.png)",
        "a | b",
        "two\n# lines",
        "`code` *bold* \\",
    ],
)
def test_markup_in_texts_is_escaped(text: str) -> None:
    verdict = Verdict(text, text, text, text, "fine")
    section = Section(verdicts=[verdict], pictures={text: "speed-1.png"}, numbers={})
    fields = {"method": text, "cover": text, "secrets": (text,), "width": None, "gaussians": 1}
    report = report_of(Audit(**fields, controls=(1,), sections={"speed": section}), "pictures")  # type: ignore[arg-type]
    unescaped = re.sub(r"\\.", "", report)
    assert "<" not in unescaped
    assert PICTURE.findall(unescaped) == ["pictures/speed-1.png"]
    assert [line[:4] for line in report.splitlines() if line.startswith("# ")] == [report[:4]]


@pytest.mark.parametrize("text", ["", "[]", '{"version": 1}', '{"version": 6, "method": {}}'])
def test_broken_audits(tmp_path: Path, text: str) -> None:
    (tmp_path / "private" / "audit").mkdir(parents=True)
    (tmp_path / "private" / "audit" / "audit.json").write_text(text)
    with pytest.raises(InputError, match=r"audit\.json: expected"):
        read_audit(tmp_path)
