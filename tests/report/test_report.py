"""The whole file, from a hand-made audit, from parts of it, and from hostile ones."""

from __future__ import annotations

import base64
import contextlib
import hashlib
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from keyss.core.errors import InputError, OutputError
from keyss.report import figures, write_report
from keyss.report.markup import Html
from report.audits import audit, write_run
from report.pages import Parsed

SECTIONS = [
    "verdict",
    "pictures",
    "images",
    "wrong-keys",
    "leaks",
    "statistics",
    "renders",
    "robustness",
    "speed",
    "not-measured",
    "configuration",
]


def parsed(run: Path) -> Parsed:
    return Parsed(write_report(run).read_text())


@pytest.fixture
def without_drawing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Figures take most of the time; what is drawn is tested elsewhere."""
    monkeypatch.setattr(figures, "_figure", lambda *_, **__: Html(""))


@pytest.fixture(scope="module")
def page(run_folder: Path) -> Parsed:
    return parsed(run_folder)


def test_every_section_is_there_once_and_linked(page: Parsed) -> None:
    ids = page.values("id")
    assert [name for name in ids if name in SECTIONS] == SECTIONS
    assert [link[1:] for link in page.values("href")][: len(SECTIONS)] == SECTIONS
    assert {link[1:] for link in page.values("href")} <= set(ids)


def test_what_was_hidden_where(page: Parsed) -> None:
    assert "treasure and map, hidden in garden" in page.text
    for fact in (
        "12,345",
        "320 pixels",
        "3 plain 3DGS models, seeds 11, 12, 13",
        "keyss 0.2.0, took 90.5 s",
    ):
        assert fact in page.text
    assert "8 of 10 measures are within their limits." in page.text
    assert "fit.iterations 3000" in page.text
    assert "sealwatch: sealwatch is not installed: pip install sealwatch" in page.text.replace(" .", ".")


def test_pictures_and_figures_are_in_the_file(page: Parsed) -> None:
    assert page.tags.count("img") == 3 + 3  # of the cover, and one for each leak
    assert page.tags.count("svg") == 6  # ratios, two-sample, histogram, ROC, losses of two secrets
    assert all(alt for alt in page.values("alt"))


def test_nothing_is_loaded_from_elsewhere(page: Parsed, run_folder: Path) -> None:
    assert page.loads() == []
    html = (run_folder / "report.html").read_text()
    assert "@import" not in html
    assert all(url.startswith("#") for url in re.findall(r"url\(([^)]*)\)", html))
    assert set(re.findall(r"https?://[^\"' <]*", html)) == {
        "http://www.w3.org/2000/svg",
        "http://www.w3.org/1999/xlink",
    }


def test_the_policy_allows_the_one_script_and_nothing_else(page: Parsed) -> None:
    (policy,) = (value for value in page.values("content") if "default-src" in value)
    (script,) = page.scripts
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    assert f"script-src 'sha256-{digest}';" in policy
    assert policy.startswith("default-src 'none'; img-src data:;")
    assert page.handlers() == []


def test_the_same_audit_gives_the_same_bytes(run_folder: Path, tmp_path: Path) -> None:
    again = write_run(tmp_path, audit())
    assert write_report(again).read_bytes() == write_report(run_folder).read_bytes()


@pytest.mark.usefixtures("without_drawing")
@pytest.mark.parametrize("name", [name for name in audit() if name != "version"])
def test_any_section_may_be_absent(tmp_path: Path, name: str) -> None:
    data = audit()
    del data[name]
    assert parsed(write_run(tmp_path, data)).tags.count("h1") == 1


@pytest.mark.usefixtures("without_drawing")
def test_an_empty_audit_says_how_to_fill_it(tmp_path: Path) -> None:
    page = parsed(write_run(tmp_path, {"version": 1}))
    assert [name for name in page.values("id") if name in SECTIONS] == ["not-measured"]
    assert page.tags.count("li") == 1 + 13  # the link to the section, and every measure
    assert "keyss audit RUN --key-file KEY --null 3" in page.text
    assert "A secret, hidden in a cover" in page.text


def test_a_broken_audit_leaves_the_old_report(tmp_path: Path) -> None:
    run = write_run(tmp_path, {"version": 1, "images": "none"})
    (run / "report.html").write_text("old")
    with pytest.raises(InputError, match=r"audit\.json: images: expected an object, found a text"):
        write_report(run)
    assert (run / "report.html").read_text() == "old"
    assert sorted(path.name for path in run.iterdir()) == ["audit", "report.html"]


def test_a_report_that_cannot_be_written(tmp_path: Path) -> None:
    run = write_run(tmp_path, {"version": 1})
    (run / "report.html").mkdir()
    with pytest.raises(OutputError, match=r"report\.html"):
        write_report(run)


ATTACKS = [
    "<script>alert(1)</script>",
    '"><img src=x onerror=alert(1)>',
    "' onmouseover='alert(1)",
    "</style></title><svg onload=alert(1)>",
    "--><iframe src=//example.org></iframe>",
]


@pytest.mark.parametrize("text", ATTACKS)
def test_texts_of_others_stay_text(tmp_path: Path, text: str) -> None:
    """Every text and every free name of the audit, all at once, figures included."""
    data = _with_all_texts(audit(), text)
    data["histograms"] = {text: data["histograms"]["opacity"]}
    data["distances"]["attributes"] = {text: data["distances"]["attributes"]["opacity"]}
    data["run"]["config"] = {text: {text: text}}
    page = parsed(write_run(tmp_path, data))
    harmless(page)
    assert page.text.count(" ".join(text.split())) > 30


def _with_all_texts(value: Any, text: str) -> Any:
    match value:
        case str() if not value.startswith("pictures/"):
            return text
        case list():
            return [_with_all_texts(item, text) for item in value]
        case dict():
            return {name: _with_all_texts(item, text) for name, item in value.items()}
    return value


def harmless(page: Parsed) -> None:
    assert page.loads() == []
    assert page.handlers() == []
    assert len(page.scripts) == page.tags.count("script") == 1
    assert page.tags.count("style") == page.tags.count("title") == 1
    assert not {"iframe", "object", "embed", "link", "base", "form"} & set(page.tags)


def _places(value: Any, path: tuple[str | int, ...] = ()) -> Iterator[tuple[str | int, ...]]:
    yield path
    entries = (
        value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    )
    for name, item in entries:
        yield from _places(item, (*path, name))


PLACES = [place for place in _places(audit()) if place and place != ("version",)]
ANYTHING = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats()
    | st.text()
    | st.sampled_from([*ATTACKS, 10**400]),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
)


@pytest.mark.usefixtures("without_drawing")
@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(place=st.sampled_from(PLACES), value=ANYTHING)
def test_any_other_value_anywhere_is_refused_or_harmless(
    place: tuple[str | int, ...], value: Any, tmp_path: Path
) -> None:
    data: Any = audit()
    at = data
    for step in place[:-1]:
        at = at[step]
    at[place[-1]] = value
    run = write_run(tmp_path, data)
    with contextlib.suppress(InputError):
        harmless(parsed(run))
