"""The verdict on each number, on both sides of its limit."""

from __future__ import annotations

from dataclasses import replace

import pytest

from keyss.lab import AttackResult, Auc, ChangedQuality
from keyss.lab.audits import Verdict, headline
from keyss.lab.audits.parts import (
    distance_verdicts,
    leak_verdicts,
    pruning_verdicts,
    quality_verdict,
    stealth_verdicts,
    stegexpose_verdict,
    two_sample_verdict,
    wrong_key_verdicts,
)
from keyss.lab.distances import AttributeDistance
from keyss.lab.leaks.leak_scores import LeakScores
from keyss.lab.robustness.survival import ChangeResult
from keyss.lab.stealth.judging import JudgedStatistic, StealthResult
from keyss.measure import PsnrRange, WrongKeys


@pytest.mark.parametrize(
    ("psnr", "plain", "word"),
    [(26.0, 27.0, "fine"), (25.9, 27.0, "missed"), (45.0, 120.0, "fine"), (44.9, 120.0, "missed")],
)
def test_quality(psnr: float, plain: float, word: str) -> None:
    assert quality_verdict("secret", psnr, plain, "missed").word == word
    assert quality_verdict("secret", psnr, plain, "missed", 150).beside.endswith(
        "plain model of only 150 steps"
    )


def test_wrong_keys() -> None:
    wrong = WrongKeys(16, PsnrRange(30, 29, 31), (PsnrRange(7.1, 7.0, 8.0), PsnrRange(8, 7, 9.1)))
    one, two = wrong_key_verdicts(wrong, (7.0, 8.0))
    assert (one.measure, one.word, one.value) == ("wrong keys, secret 1", "fine", "8.00 dB, best of 16")
    assert (two.measure, two.word) == ("wrong keys, secret 2", "visible")
    assert wrong_key_verdicts(wrong, ()) == []


@pytest.mark.parametrize(
    ("leak", "word"),
    [
        ((1.0, 0.05, 0.1), "fine"),
        ((1.01, 0.0, 0.0), "visible"),
        ((0.0, 0.051, 0.0), "visible"),
        ((0.0, 0.0, 0.11), "visible"),
    ],
)
def test_the_worst_leak_decides(leak: tuple[float, float, float], word: str) -> None:
    nothing = LeakScores(-0.1, -0.1, -0.1)
    row = AttackResult("clusters", "Groups alone.", "1 of 2", nothing, nothing)
    worst = replace(row, attack="matched opacities", best="below 0.05", leak=LeakScores(*leak))
    (verdict,) = leak_verdicts({"secret 1": [row], "secret 2": [row, worst, row]})
    assert verdict.word == word
    assert verdict.value.endswith("(secret 2, matched opacities: below 0.05)")
    assert leak_verdicts({"secret 1": []}) == []


@pytest.mark.parametrize(
    ("least", "of_controls", "of_original", "word"),
    [
        (0.2, 0.5, 0.5, "fine"),
        (0.01, 0.5, 0.5, "fine"),
        (0.009, 0.5, 0.5, "visible"),
        (0.2, 1e-10, 0.5, "inconclusive"),  # plain models fail too: the test finds anything, or nothing
        (0.0, 1e-10, 0.5, "inconclusive"),
        (1e-40, 0.5, 1e-55, "inconclusive"),  # a given cover of another trainer
    ],
)
def test_plain_models_that_fail_decide_nothing(
    least: float, of_controls: float, of_original: float, word: str
) -> None:
    statistic = JudgedStatistic("bits: ones", 0.5, 0.4, 0.6, least, None)
    (verdict,) = stealth_verdicts(StealthResult((statistic,), least, of_controls, of_original))
    assert verdict.word == word
    assert stealth_verdicts(StealthResult((), 1.0, 1.0)) == []


def test_distances() -> None:
    near, far = AttributeDistance(1.0, 1.0, 1.1, 1.0), AttributeDistance(1.0, 1.0, 1.51, None)
    assert [line.word for line in distance_verdicts({"scale": near})] == ["fine"]
    assert [(line.value, line.word) for line in distance_verdicts({"scale": near, "opacity": far})] == [
        ("opacity 1.51×", "visible")
    ]
    as_plain = replace(far, original=1.5)
    assert [line.word for line in distance_verdicts({"opacity": as_plain})] == ["fine"]
    assert distance_verdicts({"opacity": replace(far, ratio=None)}) == []


def test_classifiers() -> None:
    def auc(value: float) -> Auc:
        return Auc(value, value - 0.01, value + 0.01)

    assert two_sample_verdict([auc(0.55), auc(0.6)], [auc(0.52)], []).word == "fine"
    assert two_sample_verdict([auc(0.55), auc(0.61)], [auc(0.52)], []).word == "visible"
    assert two_sample_verdict([auc(0.7)], [auc(0.52)], [auc(0.695)]).word == "fine"
    control = Auc(0.5, 0.4, 0.6)
    assert stegexpose_verdict(Auc(0.75, 0.3, 1.0), control).word == "fine"
    assert stegexpose_verdict(Auc(0.75, 0.51, 1.0), control).word == "visible"
    assert stegexpose_verdict(Auc(0.25, 0.1, 0.45), control).word == "visible"
    assert stegexpose_verdict(Auc(0.6, 0.51, 0.7), control).word == "fine"


def test_pruning() -> None:
    whole = ChangeResult("none", 0, "")
    secret = ChangedQuality(20.0, 4.0)
    pruned = ChangeResult("random pruning", 0.25, "", 3, None, ChangedQuality(25.0, 2.5), (secret,))
    (verdict,) = pruning_verdicts([whole, pruned])
    assert (verdict.value, verdict.beside, verdict.word) == ("secret -4.00 dB", "cover -2.50 dB", "fine")
    for worse in (replace(secret, loss=4.1), replace(secret, opens=False)):
        assert [line.word for line in pruning_verdicts([replace(pruned, secrets=(worse,))])] == ["missed"]
    assert pruning_verdicts([whole, replace(pruned, strength=0.1)]) == []


def test_the_headline() -> None:
    assert headline([]) == "No part that was measured has a limit."
    fine = Verdict("leaks", "0 dB", "", "", "fine")
    assert headline([fine, fine]) == "Fine: 2 of 2 measures."
    lines = [
        fine,
        replace(fine, measure="renders", word="visible"),
        replace(fine, measure="file", word="inconclusive"),
    ]
    assert headline(lines) == "Fine: 1 of 3 measures. Visible: renders. Inconclusive: file."
