"""Figures: always the same bytes, part of the page, and plotted from any numbers."""

from __future__ import annotations

import re
from importlib.resources import files

import matplotlib
import pytest
from markupsafe import Markup

from audits.pages import Parsed
from keyss.audits import figures
from keyss.measure import ChangedQuality, ChangeResult

HOSTILE = "--></text><script>alert(1)</script> $\\frac$ 狐 & #010101"
Points = list[tuple[float, float | None]]  # dB of the cover and of the secret; None: it does not open


def lost(attack: str, points: Points) -> list[ChangeResult]:
    """Strength after strength of an attack."""
    return [
        ChangeResult(
            attack,
            strength,
            "u",
            "",
            cover=ChangedQuality(30.0, cover),
            secrets=(ChangedQuality(30.0, secret or 0.0, opens=secret is not None),),
        )
        for strength, (cover, secret) in enumerate(points)
    ]


def hostile() -> Markup:
    return figures.losses(lost(HOSTILE, [(0, 1), (1, None)]))[0]


def test_figures_are_part_of_the_page() -> None:
    figure = hostile()
    page = Parsed(figure)
    assert page.tags[:2] == ["div", "svg"]
    assert "script" not in page.tags
    assert "style" not in page.tags
    assert page.loads() == []
    (label,) = page.values("aria-label")
    assert HOSTILE in label
    ids = page.values("id")
    referred = re.findall(r"url\(#([^)]*)\)", figure) + [link[1:] for link in page.values("xlink:href")]
    assert set(referred) == set(ids)
    assert len(set(ids)) == len(ids)


def test_the_same_data_give_the_same_bytes(monkeypatch: pytest.MonkeyPatch) -> None:
    first = hostile()
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "1000000000")
    with matplotlib.rc_context({"font.size": 30, "axes.grid": False, "svg.fonttype": "path"}):
        assert hostile() == first


def test_all_colours_are_the_page_s() -> None:
    style = files("keyss.audits").joinpath("assets", "page.css").read_text()
    styles = " ".join(Parsed(hostile()).values("style"))
    assert not re.search(r"(fill|stroke): (?!none|var)", styles)
    used = set(re.findall(r"var\((--[\w-]+)\)", styles))
    assert used
    for variable in used:
        assert style.count(f"  {variable}: #") == 2, "light and dark"


def test_long_names_are_cut_and_short_ones_are_not() -> None:
    texts = Parsed(figures.losses([*lost("x" * 500, [(0, 1)]), *lost("noise", [(0, 1)])])[0]).texts
    assert "x" * 27 + "…" in texts
    assert "noise" in texts


def test_extreme_losses_can_be_drawn() -> None:
    rows = lost("noise", [(-1e15, 1e15), (0, -1e15), (1e15, None)])
    many = [row for index in range(70) for row in lost(f"attack {index}", [(index, index)])]
    (figure,) = figures.losses([*rows, *many])
    assert figure.count("<svg") == 1


def test_secrets_that_do_not_open_are_marked() -> None:
    def texts(*attacks: list[ChangeResult]) -> list[str]:
        return Parsed(figures.losses([row for rows in attacks for row in rows])[0]).texts

    survived = lost("noise", [(0, 0.5), (1, 2)])
    once = lost("cropping", [(0, 0.5), (1, None)])
    never = [lost("half floats", [(0, None)]), lost(".splat", [(0, None)])]
    assert not {"does not open", "opens at no strength"} & set(texts(survived))
    assert {"noise", "cropping", "does not open"} <= set(texts(survived, once))
    assert "opens at no strength" not in texts(survived, once)
    assert texts(survived, *never).count("opens at no strength") == 1
    assert "half floats" not in texts(survived, *never)


def test_nothing_is_drawn_from_nothing() -> None:
    assert figures.losses([]) == []
    skipped = ChangeResult("conversion", 1, "times", "", skipped="no tool")
    assert figures.losses([skipped]) == []
