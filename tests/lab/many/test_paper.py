"""Consistency of the paper's figures and claims, and pairs of scenes."""

from __future__ import annotations

from pathlib import Path

import pytest

from keyss import reproduce
from keyss.core import UsageError
from keyss.lab.many import reproduction

TABLES = reproduction.PAPER.tables

# The last column of Table 1.
AVERAGES = {
    ("3DGS", "cover"): 26.518,
    ("3DGS+SH", "cover"): 24.689,
    ("3DGS+SH", "secret"): 23.232,
    ("3DGS+Decoder", "cover"): 24.573,
    ("3DGS+Decoder", "secret"): 21.249,
    ("GS-Hider", "cover"): 25.817,
    ("GS-Hider", "secret"): 25.178,
    ("KeySS", "cover"): 25.980,
    ("KeySS", "secret"): 26.427,
    ("KeySS", "wrong key, cover"): 25.916,
    ("KeySS", "wrong key, secret"): 10.341,
}


def published(name: str) -> dict[str, dict[str, float | None]]:
    """The paper's figures of a table, in the form of measured ones."""
    table = TABLES[name]
    return {
        label: {measure: reproduction.mean_figure(table, figure) for measure, figure in run.figures.items()}
        for label, run in table.runs.items()
        if run.figures
    }


def test_averages_of_the_paper() -> None:
    figures = published("single")
    for (run, measure), average in AVERAGES.items():
        assert figures[run][measure] == pytest.approx(average, abs=0.0011), (run, measure)


def test_sums_and_scores_are_consistent() -> None:
    for mask, figures in published("masks").items():
        cover, secret, mean, distance, score = (value or 0.0 for value in figures.values())
        # The distance is printed with three digits; half a unit of the last is 0.026 of the score.
        assert (cover + secret) * (1 - distance) == pytest.approx(score, abs=0.03), mask
        assert (cover + secret) / 2 == pytest.approx(mean, abs=1e-6), mask
    for mask, breakdown in published("sinkhorn").items():
        distance, *parts = (value or 0.0 for value in breakdown.values())
        assert distance == published("masks")[mask]["sinkhorn"]
        assert len(parts) == 5
        assert sum(parts) == pytest.approx(distance, abs=0.004), mask
    for figures in published("combined").values():
        cover, secret, mean = (value or 0.0 for value in figures.values())
        assert (cover + secret) / 2 == pytest.approx(mean, abs=0.001)


@pytest.mark.parametrize("name", TABLES)
def test_claims_hold_for_published_figures(name: str) -> None:
    """Except one: with two secrets, a wrong key shows 16.5 dB of the bicycle instead of 22.5.

    Nobody has published plain 3DGS with half of the Gaussians.
    """
    found = {claim.text: reproduction.judge_claim(claim, published(name)) for claim in TABLES[name].claims}
    found = {text: each for text, each in found.items() if not text.startswith("KeySS costs what half")}
    assert all(each.parts for each in found.values())
    exceptions = {text: each for text, each in found.items() if each.verdict != "holds"}
    if name == "multi":
        (each,) = exceptions.values()
        assert (each.verdict, each.holding, each.parts) == ("holds in part", 1, 2)
        assert "wrong key" in each.text
    else:
        assert exceptions == {}


def test_groups_are_cyclic_by_default() -> None:
    groups_of = reproduction.groups_of
    assert groups_of(["a", "b"], 1, (), ()) == [("a", "b"), ("b", "a")]
    assert groups_of(["a", "b", "c"], 2, (), ()) == [("a", "b", "c"), ("b", "c", "a"), ("c", "a", "b")]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"table": "singel", "scenes": ["a", "b"]}, "did you mean single"),
        ({"table": "single"}, "at least 2 scenes"),
        ({"table": "single", "scenes": ["a"]}, "at least 2 scenes"),
        ({"table": "multi", "scenes": ["a", "b"]}, "at least 3 scenes"),
        ({"table": "single", "scenes": ["a", "x/a"]}, "different names"),
        ({"table": "single", "scenes": ["a", "b"], "full": True}, "a scene called 'bicycle', got a, b"),
        ({"table": "single", "scenes": ["a", "b"], "pairs": ["a,c"]}, "a scene called 'c', got a, b"),
        ({"table": "single", "scenes": ["a", "b"], "pairs": ["a"]}, "a cover and 1 secret"),
        ({"table": "multi", "scenes": ["a", "b", "c"], "pairs": ["a,b,b"]}, "different names"),
        ({"table": "single", "scenes": ["a", "b"], "iterations": 0}, "`iterations`"),
        ({"table": "single", "scenes": ["a.ply", "b"]}, "models have none"),
    ],
)
def test_invalid_arguments_write_nothing(tmp_path: Path, arguments: dict[str, object], words: str) -> None:
    for dry_run in (True, False):
        with pytest.raises(UsageError, match=words):
            reproduce(**arguments, dry_run=dry_run, out=tmp_path / "out")  # type: ignore[arg-type]
    assert not (tmp_path / "out").exists()
