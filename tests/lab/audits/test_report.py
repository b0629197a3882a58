"""The report of a real audit, of parts of it, and of hostile ones."""

from __future__ import annotations

import base64
import hashlib
import re
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from keyss.core import InputError
from keyss.lab.audits import audit, read_audit
from keyss.lab.audits.report import embed_picture
from lab.audits.audited import found_in, run_with, with_all_texts
from lab.audits.pages import Parsed

SECTIONS = [
    "verdict",
    "pictures",
    "images",
    "wrong-keys",
    "leaks",
    "stealth",
    "statistics",
    "renders",
    "robustness",
    "speed",
]
PARTS = {  # fields of the record, and the sections that show them
    "wrong_key": ["wrong-keys"],
    "images": ["images", "pictures"],
    "parameters": ["statistics"],
    "stealth": ["stealth"],
    "stegexpose": ["renders"],
    "leaks": ["leaks"],
    "robustness": ["robustness"],
    "speed": ["speed"],
}


def write_report(run: Path) -> Path:
    audit(run, report_only=True)
    return run / "private" / "report.html"


def parsed(run: Path) -> Parsed:
    return Parsed(write_report(run).read_text())


@pytest.fixture(scope="module")
def page(run_folder: Path) -> Parsed:
    return parsed(run_folder)


def sections_of(page: Parsed) -> list[str]:
    return [name for name in page.values("id") if name in SECTIONS]


def test_sections_and_links(data: dict[str, Any], run_folder: Path, tmp_path: Path) -> None:
    page = parsed(run_with(run_folder, tmp_path, data))
    ids = page.values("id")
    assert sections_of(page) == SECTIONS
    assert [link[1:] for link in page.values("href")][: len(SECTIONS)] == SECTIONS
    assert {link[1:] for link in page.values("href")} <= set(ids)


def test_numbers_of_every_part(page: Parsed, data: dict[str, Any]) -> None:
    images, parameters, robustness = data["images"], data["parameters"], data["robustness"]
    psnrs = [model["images"]["mean"]["psnr"] for model in images["models"]]
    psnrs += [images["models"][0]["baseline"]["mean"]["psnr"]]
    shown = [f"{psnr:.2f}" for psnr in psnrs]
    shown += [f"{data['wrong_key']['vs_secrets'][1]['max']:.2f}"]
    shown += [f"{data['leaks'][1][0]['scores']['gradient']:z.3f}"]
    shown += [f"{parameters['sinkhorn']['sum']:.4f}", f"{parameters['score']:.2f}"]
    shown += [f"{data['stegexpose']['control']['auc']:.2f}"]
    shown += [f"{robustness[1]['secrets'][1]['psnr']:.2f}"]
    shown += [f"{data['speed']['stego model']['ratio']:.2f}×", "Mean over 3 seeds."]
    assert [number for number in shown if number.replace("-", "−") not in page.text] == []
    assert "16 bits a number" in page.text


def test_secret_that_does_not_open(data: dict[str, Any], run_folder: Path, tmp_path: Path) -> None:
    data["robustness"][1]["secrets"][1] |= {"opens": False, "error": "this key opens nothing"}
    assert "does not open" in parsed(run_with(run_folder, tmp_path, data)).text


def test_no_external_resources(page: Parsed, run_folder: Path) -> None:
    assert page.loads() == []
    html = (run_folder / "private" / "report.html").read_text()
    assert "@import" not in html
    assert all(url.startswith("#") for url in re.findall(r"url\(([^)]*)\)", html))
    assert "http://" not in html
    assert "https://" not in html


def test_content_security_policy(page: Parsed) -> None:
    (policy,) = (value for value in page.values("content") if "default-src" in value)
    (script,) = page.scripts
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    assert f"script-src 'sha256-{digest}';" in policy
    assert policy.startswith("default-src 'none'; img-src data:;")
    assert "connect-src" not in policy
    assert page.handlers() == []


def test_report_is_deterministic(run_folder: Path, tmp_path: Path) -> None:
    again = run_with(run_folder, tmp_path, found_in(run_folder))
    assert write_report(again).read_bytes() == write_report(run_folder).read_bytes()


def test_missing_parts(run_folder: Path, data: dict[str, Any], tmp_path: Path) -> None:
    for name in PARTS:
        page = parsed(run_with(run_folder, tmp_path, data | {name: None}))
        assert set(SECTIONS) - set(sections_of(page)) == set(PARTS[name])
        assert "Not measured" in page.text
    page = parsed(run_with(run_folder, tmp_path, {k: v for k, v in data.items() if k not in PARTS}))
    assert sections_of(page) == []


@pytest.mark.parametrize(
    "name", ["../outside.png", "/etc/passwd", "link.png", "missing.png", "drawing.png", "a\0b.png", ""]
)
def test_foreign_and_broken_pictures(tmp_path: Path, name: str) -> None:
    folder = tmp_path / "pictures"
    folder.mkdir()
    (folder / "drawing.png").write_text('<svg xmlns="http://www.w3.org/2000/svg"><script/></svg>')
    Image.new("RGB", (4, 5)).save(tmp_path / "outside.png")
    (folder / "link.png").symlink_to(tmp_path / "outside.png")
    with pytest.raises(InputError):
        embed_picture(folder, name)


@pytest.mark.parametrize("text", ["", "[]", '{"version": 1}', '{"version": 5, "run": {}}'])
def test_broken_audits(tmp_path: Path, text: str) -> None:
    (tmp_path / "private" / "audit").mkdir(parents=True)
    (tmp_path / "private" / "audit" / "audit.json").write_text(text)
    with pytest.raises(InputError, match=r"audit\.json: expected"):
        read_audit(tmp_path)


def test_broken_audit_keeps_the_old_report(run_folder: Path, data: dict[str, Any], tmp_path: Path) -> None:
    run = run_with(run_folder, tmp_path, data | {"images": "none"})
    (run / "private" / "report.html").write_text("old")
    with pytest.raises(InputError, match=r"audit\.json: .*`\$\.images`"):
        write_report(run)
    assert (run / "private" / "report.html").read_text() == "old"
    assert sorted(path.name for path in (run / "private").iterdir()) == ["audit", "report.html"]


ATTACKS = [
    "<script>alert(1)</script>",
    '"><img src=x onerror=alert(1)>',
    "' onmouseover='alert(1)",
    "</style></title><svg onload=alert(1)>",
    "--><iframe src=//example.org></iframe>",
    "{{ 7 * 7 }}{% raw %}",
]


@pytest.mark.parametrize("text", ATTACKS)
def test_markup_in_texts_is_escaped(
    run_folder: Path, data: dict[str, Any], tmp_path: Path, text: str
) -> None:
    """Every text and every free name of the audit, all at once."""
    data = with_all_texts(data, text, keep=("picture", "pictures"))
    files = [file for files in data["images"]["pictures"].values() for file in files.values()]
    data["images"]["pictures"] = {text: {text: files[0], "other": files[1]}}
    data["parameters"]["distances"] = {text: data["parameters"]["distances"]["opacity"]}
    page = parsed(run_with(run_folder, tmp_path, data))
    assert page.text.count(" ".join(text.split())) > 30
    assert page.loads() == []
    assert page.handlers() == []
    assert len(page.scripts) == page.tags.count("script") == 1
    assert page.tags.count("style") == page.tags.count("title") == 1
    assert not {"iframe", "object", "embed", "link", "base", "form"} & set(page.tags)
