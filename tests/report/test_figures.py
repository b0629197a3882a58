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
from keyss.measure.robustness.survival import ChangeResult
from keyss.measure.roc import Roc
from keyss.measure.two_sample import TwoSample
from keyss.report import figures, plots
from keyss.report.figures import AttackCurve, Interval, RocCurve
from keyss.report.verdicts import DetectorRocs
from report.pages import Parsed

HOSTILE = "--></text><script>alert(1)</script> $\\frac$ 狐 & #010101"
DRAWN: dict[str, Callable[[], Markup]] = {
    "ratios": lambda: figures.ratio_bars([("position", 1.1), (HOSTILE, 9.0)], 1.5, HOSTILE),
    "intervals": lambda: figures.intervals([Interval(HOSTILE, 0.5, 0.4, 0.6, True)], 0.6, HOSTILE),
    "histogram": lambda: figures.histogram(HOSTILE, [0, 1, 2], [0.5, 0.5], [[0.4, 0.6]], HOSTILE),
    "roc": lambda: figures.roc([RocCurve(HOSTILE, [0, 0.5, 1], [0, 0.8, 1])], HOSTILE),
    "losses": lambda: figures.losses(HOSTILE, [AttackCurve(HOSTILE, [(0, 1), (1, None)])], HOSTILE),
}


@pytest.mark.parametrize("draw", DRAWN.values(), ids=DRAWN)
def test_figures_are_part_of_the_page(draw: Callable[[], Markup]) -> None:
    figure = draw()
    page = Parsed(figure)
    assert page.tags[:2] == ["div", "svg"]
    assert "script" not in page.tags
    assert "style" not in page.tags
    assert page.loads() == []
    assert page.values("aria-label") == [HOSTILE]
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
    texts = Parsed(figures.ratio_bars([("x" * 500, 1), ("position", 2)], 1.5, "")).texts
    assert "x" * 27 + "…" in texts
    assert "position" in texts


@pytest.mark.parametrize("value", [1e-300, 1.0, 1e15])
def test_extreme_ratios_can_be_drawn(value: float) -> None:
    assert figures.ratio_bars([("position", value)], 1.5, "").count("<svg") == 1


def test_extreme_losses_can_be_drawn() -> None:
    curve = AttackCurve("noise", [(-1e15, 1e15), (0, -1e15), (1e15, None)])
    many = [AttackCurve(f"attack {index}", [(index, index)]) for index in range(70)]
    assert figures.losses("secret", [curve, *many], "").count("<svg") == 1


def test_secrets_that_do_not_open_are_marked() -> None:
    def texts(*curves: AttackCurve) -> list[str]:
        return Parsed(figures.losses("secret", curves, "")).texts

    survived = AttackCurve("noise", [(0, 0.5), (1, 2)])
    once = AttackCurve("cropping", [(0, 0.5), (1, None)])
    never = [AttackCurve("half floats", [(0, None)]), AttackCurve(".splat", [(0, None)])]
    assert not {"does not open", "opens at no strength"} & set(texts(survived))
    assert {"noise", "cropping", "does not open"} <= set(texts(survived, once))
    assert "opens at no strength" not in texts(survived, once)
    assert texts(survived, *never).count("opens at no strength") == 1
    assert "half floats" not in texts(survived, *never)


def test_nothing_is_drawn_from_nothing() -> None:
    assert plots.distances({}) is None
    assert plots.distances({"position": AttributeDistance(0.0, 1.0, 0.0)}) is None
    assert plots.distances({"position": AttributeDistance(0.1, 0.0, None)}) is None
    assert plots.two_sample(TwoSample((), ())) is None
    assert plots.histograms({}) == []
    assert plots.roc([]) is None
    assert plots.losses([]) == []
    skipped = ChangeResult("conversion", 1, "times", "", None, skipped="no tool")
    assert plots.losses([skipped]) == []


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
        plots.roc([DetectorRocs("SPA", roc, None)])
