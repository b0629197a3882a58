"""Figures: the same on every day, part of the page, and drawn from whatever numbers an audit may hold."""

from __future__ import annotations

import re
from collections.abc import Callable
from importlib.resources import files
from typing import Any

import matplotlib
import pytest
from markupsafe import Markup

from keyss.core.errors import InputError
from keyss.measure.distances import AttributeDistance
from keyss.measure.histograms import Histogram
from keyss.measure.robustness.survival import ChangedQuality, ChangeResult
from keyss.measure.roc import Roc
from keyss.measure.two_sample import AucInterval, TwoSample
from keyss.report import figures
from keyss.report.verdicts import DetectorRocs
from report.pages import Parsed

HOSTILE = "--></text><script>alert(1)</script> $\\frac$ 狐 & #010101"
Points = list[tuple[float, float | None]]  # dB of the cover and of the secret; None: it does not open


def ratios(**values: float) -> dict[str, AttributeDistance]:
    return {name: AttributeDistance(value, 1.0, value) for name, value in values.items()}


def lost(attack: str, points: Points) -> list[ChangeResult]:
    """Strength after strength of an attack."""
    return [
        ChangeResult(
            attack,
            strength,
            "u",
            "",
            None,
            cover=ChangedQuality(30.0, 0.9, cover),
            secrets=(ChangedQuality(30.0, 0.9, secret or 0.0, opens=secret is not None),),
        )
        for strength, (cover, secret) in enumerate(points)
    ]


def drawn(figure: Markup | None) -> Markup:
    assert figure is not None
    return figure


DETECTOR = DetectorRocs(HOSTILE, Roc(0.65, 0.4, 0.9, (0.0, 0.5, 1.0), (0.0, 0.8, 1.0), (0, 0)), None)
HISTOGRAM = Histogram((0.0, 1.0, 2.0), (0.5, 0.5), ((0.4, 0.6),))
DRAWN: dict[str, Callable[[], Markup]] = {
    "ratios": lambda: drawn(figures.distances(ratios(**{"position": 1.1, HOSTILE: 9.0}))),
    "intervals": lambda: drawn(figures.two_sample(TwoSample((AucInterval(0.5, 0.4, 0.6),), ()))),
    "histogram": lambda: figures.histograms({HOSTILE: HISTOGRAM})[0],
    "roc": lambda: drawn(figures.roc([DETECTOR])),
    "losses": lambda: figures.losses(lost(HOSTILE, [(0, 1), (1, None)]))[0],
}


@pytest.mark.parametrize("draw", DRAWN.values(), ids=DRAWN)
def test_figures_are_part_of_the_page(draw: Callable[[], Markup]) -> None:
    figure = draw()
    page = Parsed(figure)
    assert page.tags[:2] == ["div", "svg"]
    assert "script" not in page.tags
    assert "style" not in page.tags
    assert page.loads() == []
    (label,) = page.values("aria-label")
    assert HOSTILE in label or "stego model 0.50" in label
    ids = page.values("id")
    referred = re.findall(r"url\(#([^)]*)\)", figure) + [link[1:] for link in page.values("xlink:href")]
    assert set(referred) == set(ids)
    assert len(set(ids)) == len(ids)


@pytest.mark.parametrize("draw", DRAWN.values(), ids=DRAWN)
def test_the_same_data_give_the_same_bytes(
    draw: Callable[[], Markup], monkeypatch: pytest.MonkeyPatch
) -> None:
    first = draw()
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "1000000000")
    with matplotlib.rc_context({"font.size": 30, "axes.grid": False, "svg.fonttype": "path"}):
        assert draw() == first


@pytest.mark.parametrize("draw", DRAWN.values(), ids=DRAWN)
def test_all_colours_are_the_page_s(draw: Callable[[], Markup]) -> None:
    style = files("keyss.report").joinpath("assets", "page.css").read_text()
    styles = " ".join(Parsed(draw()).values("style"))
    assert not re.search(r"(fill|stroke): (?!none|var)", styles)
    used = set(re.findall(r"var\((--[\w-]+)\)", styles))
    assert used
    for variable in used:
        assert style.count(f"  {variable}: #") == 2, "light and dark"


def test_long_names_are_cut_and_short_ones_are_not() -> None:
    texts = Parsed(drawn(figures.distances(ratios(**{"x" * 500: 1, "position": 2})))).texts
    assert "x" * 27 + "…" in texts
    assert "position" in texts


@pytest.mark.parametrize("value", [1e-300, 1.0, 1e15])
def test_extreme_ratios_can_be_drawn(value: float) -> None:
    assert drawn(figures.distances(ratios(position=value))).count("<svg") == 1


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
    assert figures.distances({}) is None
    assert figures.distances({"position": AttributeDistance(0.0, 1.0, 0.0)}) is None
    assert figures.distances({"position": AttributeDistance(0.1, 0.0, None)}) is None
    assert figures.two_sample(TwoSample((), ())) is None
    assert figures.histograms({}) == []
    assert figures.roc([]) is None
    assert figures.losses([]) == []
    skipped = ChangeResult("conversion", 1, "times", "", None, skipped="no tool")
    assert figures.losses([skipped]) == []


@pytest.mark.parametrize(
    "shares",
    [
        ((0.0, 1.0), (0.5, 0.5), ()),
        ((1.0, 0.0), (1.0,), ()),
        ((0.0, 0.0), (1.0,), ()),
        ((0.0, 1.0), (1.0,), ((1.0, 2.0),)),
    ],
)
def test_histograms_that_do_not_fit_are_refused(shares: tuple[Any, Any, Any]) -> None:
    with pytest.raises(ValueError, match="expected rising edges"):
        Histogram(*shares)


def test_a_curve_that_does_not_fit_is_refused() -> None:
    roc = Roc(0.5, 0.4, 0.6, (0.0, 1.0), (0.0,), (0, 0))
    with pytest.raises(InputError, match="as many fpr as tpr, found 2 and 1"):
        figures.roc([DetectorRocs("SPA", roc, None)])
