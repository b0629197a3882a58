"""The whole file, from a real audit, from parts of it, and from hostile ones; its numbers as texts."""

from __future__ import annotations

import base64
import contextlib
import hashlib
import json
import math
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings, strategies as st

from keyss.core import InputError, OutputError
from keyss.lab.audits import audit, numbers
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
    "not-measured",
    "configuration",
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


def test_every_section_is_there_once_and_linked(
    data: dict[str, Any], run_folder: Path, tmp_path: Path
) -> None:
    page = parsed(run_with(run_folder, tmp_path, data))
    ids = page.values("id")
    expected = [name for name in SECTIONS if name != "not-measured"]
    assert sections_of(page) == expected
    assert [link[1:] for link in page.values("href")][: len(expected)] == expected
    assert {link[1:] for link in page.values("href")} <= set(ids)


def test_what_was_hidden_where(page: Parsed, data: dict[str, Any]) -> None:
    assert "treasure and map, hidden in garden" in page.text
    for fact in (
        f"{data['run']['gaussians']:,} Gaussians",
        "40 pixels wide",
        f"2 plain models of the cover, seeds {', '.join(map(str, data['controls']))}",
        f"keyss {data['keyss']}, took ",
        "measures are within their limits.",
        '"iterations": 20',
        f'"torch": "{data["run"]["versions"]["torch"]}"',
    ):
        assert fact in page.text


def test_numbers_of_every_part_are_shown(page: Parsed, data: dict[str, Any]) -> None:
    images, parameters, robustness = data["images"], data["parameters"], data["robustness"]
    psnrs = [model["images"]["mean"]["psnr"] for model in images["models"]]
    psnrs += [images["models"][0]["baseline"]["mean"]["psnr"]]
    shown = [f"{psnr:.2f}" for psnr in psnrs]
    shown += [f"{data['wrong_key']['vs_secrets'][1]['max']:.2f}"]
    shown += [f"{data['leaks'][1][0]['scores']['gradient']:.3f}"]
    shown += [f"{parameters['sinkhorn']['sum']:.4f}", f"{parameters['score']:.2f}"]
    shown += [f"{data['stegexpose']['stego']['plain'][3]['rs']:.4f}"]
    shown += [f"{robustness[1]['secrets'][1]['psnr']:.2f}"]
    shown += [f"{data['speed']['render']['stego']['ratio']:.2f}×", "does not open", "Mean over 3 seeds."]
    assert [number for number in shown if number.replace("-", "−") not in page.text] == []
    assert "16 bits a number" in page.text


def test_pictures_are_in_the_file(page: Parsed, data: dict[str, Any]) -> None:
    named = [file for files in data["images"]["pictures"].values() for file in files]
    leaks = [row["picture"] for attacks in data["leaks"] for row in attacks]
    assert page.tags.count("img") == len(named) + len(leaks)
    assert all(alt for alt in page.values("alt"))


def test_nothing_is_loaded_from_elsewhere(page: Parsed, run_folder: Path) -> None:
    assert page.loads() == []
    html = (run_folder / "private" / "report.html").read_text()
    assert "@import" not in html
    assert all(url.startswith("#") for url in re.findall(r"url\(([^)]*)\)", html))
    assert "http://" not in html
    assert "https://" not in html


def test_the_policy_allows_the_one_script_and_nothing_else(page: Parsed) -> None:
    (policy,) = (value for value in page.values("content") if "default-src" in value)
    (script,) = page.scripts
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    assert f"script-src 'sha256-{digest}';" in policy
    assert policy.startswith("default-src 'none'; img-src data:;")
    assert "connect-src" not in policy
    assert page.handlers() == []


def test_the_same_audit_gives_the_same_bytes(run_folder: Path, tmp_path: Path) -> None:
    again = run_with(run_folder, tmp_path, found_in(run_folder))
    assert write_report(again).read_bytes() == write_report(run_folder).read_bytes()


@pytest.mark.parametrize("name", PARTS)
def test_a_part_that_did_not_run_is_left_out(
    run_folder: Path, data: dict[str, Any], tmp_path: Path, name: str
) -> None:
    data[name] = None
    page = parsed(run_with(run_folder, tmp_path, data))
    assert set(SECTIONS) - set(sections_of(page)) == set(PARTS[name])
    assert "KEY measures it" in page.text


def test_an_empty_audit_says_how_to_fill_it(run_folder: Path, data: dict[str, Any], tmp_path: Path) -> None:
    page = parsed(run_with(run_folder, tmp_path, {k: v for k, v in data.items() if k not in PARTS}))
    assert sections_of(page) == ["not-measured", "configuration"]
    assert page.tags.count("li") == 2 + len(PARTS)  # links to the sections, and every measure
    assert "keyss audit RUN --key-file KEY measures it" in page.text


def test_a_broken_audit_leaves_the_old_report(run_folder: Path, data: dict[str, Any], tmp_path: Path) -> None:
    run = run_with(run_folder, tmp_path, data | {"images": "none"})
    (run / "private" / "report.html").write_text("old")
    with pytest.raises(InputError, match=r"audit\.json: .*`\$\.images`"):
        write_report(run)
    assert (run / "private" / "report.html").read_text() == "old"
    assert sorted(path.name for path in (run / "private").iterdir()) == ["audit", "report.html"]


def test_a_report_that_cannot_be_written(run_folder: Path, data: dict[str, Any], tmp_path: Path) -> None:
    run = run_with(run_folder, tmp_path, data)
    (run / "private" / "report.html").mkdir()
    with pytest.raises(OutputError, match=r"report\.html"):
        write_report(run)


def test_a_configuration_may_be_nested_but_not_without_end(
    run_folder: Path, data: dict[str, Any], tmp_path: Path
) -> None:
    run = run_with(run_folder, tmp_path, data)
    text = json.dumps(data | {"run": data["run"] | {"config": "HERE"}})

    def nested(depth: int) -> str:
        return text.replace('"HERE"', '{"a": ' * depth + "1" + "}" * depth)

    (run / "private" / "audit" / "audit.json").write_text(nested(300))
    assert parsed(run).text.count('"a": {') == 299
    (run / "private" / "audit" / "audit.json").write_text(nested(50_000))
    with pytest.raises(InputError):
        write_report(run)


ATTACKS = [
    "<script>alert(1)</script>",
    '"><img src=x onerror=alert(1)>',
    "' onmouseover='alert(1)",
    "</style></title><svg onload=alert(1)>",
    "--><iframe src=//example.org></iframe>",
    "{{ 7 * 7 }}{% raw %}",
]


@pytest.mark.parametrize("text", ATTACKS)
def test_texts_of_others_stay_text(run_folder: Path, data: dict[str, Any], tmp_path: Path, text: str) -> None:
    """Every text and every free name of the audit, all at once."""
    data = with_all_texts(data, text, lambda name: name in ("picture", "pictures"))
    files = [file for files in data["images"]["pictures"].values() for file in files.values()]
    data["images"]["pictures"] = {text: {text: files[0], "other": files[1]}}
    data["parameters"]["distances"] = {text: data["parameters"]["distances"]["opacity"]}
    data["run"]["config"] = {text: {text: text}}
    page = parsed(run_with(run_folder, tmp_path, data))
    harmless(page)
    assert page.text.count(" ".join(text.split())) > 30


def harmless(page: Parsed) -> None:
    assert page.loads() == []
    assert page.handlers() == []
    assert len(page.scripts) == page.tags.count("script") == 1
    assert page.tags.count("style") == page.tags.count("title") == 1
    assert not {"iframe", "object", "embed", "link", "base", "form"} & set(page.tags)


def _places(value: Any, path: tuple[str | int, ...] = ()) -> Iterator[tuple[str | int, ...]]:
    """Every place of the JSON; of lists the first entry stands for all."""
    yield path
    entries = (
        value.items() if isinstance(value, dict) else enumerate(value[:1]) if isinstance(value, list) else ()
    )
    for name, item in entries:
        yield from _places(item, (*path, name))


ANYTHING = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats()
    | st.text()
    | st.sampled_from([*ATTACKS, 10**400]),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
)


@settings(
    max_examples=150,
    deadline=None,
    database=None,  # every audit has other numbers: kept examples would not fit
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(where=st.integers(0, 100_000), value=ANYTHING)
def test_any_other_value_anywhere_is_refused_or_harmless(
    run_folder: Path, data: dict[str, Any], tmp_path: Path, where: int, value: Any
) -> None:
    places = [place for place in _places(data) if place and place != ("version",)]
    place = places[where % len(places)]
    changed = found_in(run_folder)
    at: Any = changed
    for step in place[:-1]:
        at = at[step]
    at[place[-1]] = value
    run = run_with(run_folder, tmp_path, changed)
    with contextlib.suppress(InputError):
        harmless(parsed(run))


@pytest.mark.parametrize(
    ("value", "digits", "text"),
    [
        (27.2715, 2, "27.27"),
        (-0.5, 1, "−0.5"),
        (-0.001, 2, "0.00"),
        (12345, 0, "12,345"),
        (1e12, 2, "1.00e+12"),
        (math.inf, 2, "∞"),
        (-math.inf, 2, "−∞"),
        (None, 2, "–"),
        (math.nan, 2, "–"),
    ],
)
def test_number(value: float | None, digits: int, text: str) -> None:
    assert numbers.number(value, digits) == text


def test_a_difference_has_its_sign_unless_it_rounds_to_nothing() -> None:
    texts = [numbers.difference(value) for value in (0.42, -0.42, 0.0, 0.001, -0.001, None)]
    assert texts == ["+0.42", "−0.42", "0.00", "0.00", "0.00", "–"]


def test_units() -> None:
    assert [numbers.bytes_text(v) for v in (999, 1500, 4961530)] == ["999 B", "1.5 kB", "4.96 MB"]
    assert [numbers.seconds_text(v) for v in (0.0214, 3.14, 612, 9000)] == [
        "0.0214 s",
        "3.1 s",
        "10.2 min",
        "2.5 h",
    ]
    assert [numbers.times(v) for v in (1.124, 84.2, None)] == ["1.12×", "84×", "–"]
    assert numbers.significant(0.004) == "0.00400"
