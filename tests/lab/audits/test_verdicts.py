"""The verdict on each number, on both sides of each limit."""

from __future__ import annotations

from typing import Any

import pytest

from keyss.lab.audits import Audit, Verdict, headline, verdicts
from lab.audits.audited import changed, put

Data = dict[str, Any]
Change = tuple[str, Any]
IMAGES, BASELINES = "images.models.{}.images.mean.psnr", "images.models.{}.baseline.mean.psnr"
LEAK = "leaks.{}.{}.leak.{}"
STEGEXPOSE, CONTROL = "stegexpose.stego", "stegexpose.control"


def judged(audit: Audit) -> dict[str, Verdict]:
    return {line.measure: line for line in verdicts(audit)}


def _auc(auc: float, low: float, high: float) -> Data:
    return {"auc": auc, "low": low, "high": high}


ALL_FINE: list[Change] = [
    (IMAGES.format(0), 27.5),
    (BASELINES.format(0), 27.0),
    (IMAGES.format(1), 30.0),
    (BASELINES.format(1), 30.5),
    (IMAGES.format(2), 27.5),
    (BASELINES.format(2), 28.0),
    (
        "wrong_key.vs_secrets",
        [{"mean": 7.1, "min": 7.0, "max": 7.2}, {"mean": 8, "min": 7, "max": 8.5}],
    ),
    ("chance_level", [7.0, 8.0]),
    ("wrong_key.keys", 16),
    ("parameters.two_sample.stego", [{"auc": 0.55, "low": 0.54, "high": 0.56}]),
    ("parameters.two_sample.control", [{"auc": 0.52, "low": 0.51, "high": 0.53}]),
    ("parameters.two_sample.original", []),
    ("stealth.least", 0.2),
    ("stealth.least_of_controls", 0.5),
    (STEGEXPOSE, _auc(0.75, 0.3, 1.0)),
    (CONTROL, _auc(0.5, 0.4, 0.6)),
]


@pytest.fixture
def fine(data: Data) -> Data:
    """A real audit with numbers that are all within their limits."""
    no_leak = dict.fromkeys(data["leaks"][0][0]["leak"], -0.1)
    for attacks in data["leaks"]:
        for row in attacks:
            row["leak"] = dict(no_leak)
    data["leaks"][1][2]["leak"] |= {"psnr_fitted": 0.4, "ssim_fitted": 0.01}
    data["leaks"][1][2] |= {"attack": "matched opacities", "best": "below 0.05"}
    for each in data["parameters"]["distances"].values():
        each |= {"ratio": 1.1, "original": None}
    for row in data["robustness"]:
        pruned = (row["attack"], row["strength"]) == ("random pruning", 0.25)
        for each in [row["cover"], *row["secrets"]] if row["cover"] else ():
            each["loss"] = 2.5 if pruned else each["loss"]
    put(data, *ALL_FINE)
    return data


def test_verdicts_of_a_whole_audit(fine: Data) -> None:
    lines = judged(changed(fine, (IMAGES.format(2), 25.5)))
    assert {name: line.word for name, line in lines.items()} == {
        "cover on test photos": "fine",
        "secret 1 on test photos": "fine",
        "secret 2 on test photos": "missed",
        "wrong keys": "fine",
        "leaks without the key": "fine",
        "the file by itself": "fine",
        "attributes of the Gaussians": "fine",
        "classifier between models": "fine",
        "StegExpose on renders": "fine",
        "loss of a random 25% of the Gaussians": "fine",
    }
    assert lines["wrong keys"].value == "8.50 dB, best of 16"
    assert lines["leaks without the key"].value == (
        "+0.40 dB, +0.010 SSIM, −0.10 gradients (secret 2, matched opacities: below 0.05)"
    )
    assert lines["loss of a random 25% of the Gaussians"].value == "secret −2.50 dB"
    assert lines["loss of a random 25% of the Gaussians"].beside == "cover −2.50 dB"


@pytest.mark.parametrize(
    ("measure", "place", "within", "beyond", "word"),
    [
        ("cover on test photos", IMAGES.format(0), 26.0, 25.9, "visible"),
        ("secret 1 on test photos", IMAGES.format(1), 29.5, 29.4, "missed"),
        ("wrong keys", "wrong_key.vs_secrets.0.max", 8.0, 8.1, "visible"),
        ("leaks without the key", LEAK.format(0, 1, "psnr_fitted"), 1.0, 1.01, "visible"),
        ("leaks without the key", LEAK.format(0, 1, "ssim_fitted"), 0.05, 0.051, "visible"),
        ("leaks without the key", LEAK.format(0, 1, "gradient"), 0.1, 0.11, "visible"),
        ("the file by itself", "stealth.least", 0.01, 0.009, "visible"),
        ("the file by itself", "stealth.least", 0.2, 0.0, "visible"),
        ("attributes of the Gaussians", "parameters.distances.opacity.ratio", 1.5, 1.51, "visible"),
        ("classifier between models", "parameters.two_sample.stego.0.auc", 0.6, 0.61, "visible"),
        ("StegExpose on renders", f"{STEGEXPOSE}.low", 0.5, 0.51, "visible"),
        ("StegExpose on renders", f"{STEGEXPOSE}.high", 0.75, 0.45, "visible"),
    ],
)
def test_each_threshold(fine: Data, measure: str, place: str, within: Any, beyond: Any, word: str) -> None:
    assert judged(changed(fine, (place, within)))[measure].word == "fine"
    assert judged(changed(fine, (place, beyond)))[measure].word == word


@pytest.mark.parametrize(
    ("least", "of_controls", "word"),
    [
        (0.2, 0.5, "fine"),
        (0.2, 1e-10, "inconclusive"),  # plain models fail too: the test finds anything, or nothing
        (0.121, 1.8e-10, "inconclusive"),
        (1e-10, 1e-10, "inconclusive"),
        (1e-13, 1e-10, "visible"),  # far beyond what plain models have
        (0.001, 0.5, "visible"),
    ],
)
def test_controls_that_fail_decide_nothing(fine: Data, least: float, of_controls: float, word: str) -> None:
    changes = (("stealth.least", least), ("stealth.least_of_controls", of_controls))
    lines = verdicts(changed(fine, *changes))
    assert {line.measure: line.word for line in lines}["the file by itself"] == word
    assert (word == "inconclusive") == ("Inconclusive: the file by itself." in headline(lines))


def test_missing_parts_have_no_verdict(fine: Data) -> None:
    parts = ("images", "wrong_key", "leaks", "parameters", "stealth", "stegexpose", "robustness", "speed")
    assert judged(changed(fine, *((part, None) for part in parts))) == {}
    for each in fine["parameters"]["distances"].values():
        each["ratio"] = None
    left_out = [
        ("robustness", [row for row in fine["robustness"] if row["strength"] != 0.25]),
        ("images.models.0.baseline", None),
        ("stealth.statistics", []),
        ("chance_level", []),
        ("leaks", [[], []]),
    ]
    assert set(judged(changed(fine, *left_out))) == {
        "secret 1 on test photos",
        "secret 2 on test photos",
        "classifier between models",
        "StegExpose on renders",
    }


def test_the_headline(fine: Data) -> None:
    assert headline([]) == "Nothing was measured that could be judged."
    lines = verdicts(changed(fine))
    assert headline(lines) == "All 10 measures are within their limits."
    changes = ((f"{STEGEXPOSE}.high", 0.45), (IMAGES.format(2), 25.5))
    assert headline(verdicts(changed(fine, *changes))) == (
        "8 of 10 measures are within their limits. Visible: StegExpose on renders. "
        "Missed: secret 2 on test photos."
    )
