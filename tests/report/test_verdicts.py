"""Which word each number gets, on both sides of each threshold."""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any

import pytest
from keyss.report.reading import Part
from keyss.report.survival import survivals
from report.audits import audit

from keyss.report.verdicts import Verdict, headline, verdicts


def judged(data: dict[str, Any]) -> dict[str, Verdict]:
    return {line.measure: line for line in verdicts(Part("audit.json: ", data))}


def test_the_whole_audit() -> None:
    lines = judged(audit())
    assert {name: line.word for name, line in lines.items()} == {
        "cover on test photos": "fine",
        "secret 1 on test photos": "fine",
        "secret 2 on test photos": "missed",
        "wrong keys": "fine",
        "leaks without the key": "fine",
        "attributes of the Gaussians": "visible",
        "classifier between models": "fine",
        "StegExpose on renders": "fine",
        "loss of a random 25% of the Gaussians": "fine",
        "other readers of the file": "fine",
    }
    assert lines["wrong keys"].value == "8.50 dB, best of 16"
    assert lines["attributes of the Gaussians"].value == "opacity 9.00×"
    assert lines["leaks without the key"].value == "+0.40 dB, +0.010 SSIM"
    assert lines["loss of a random 25% of the Gaussians"].value == "secret −3.70 dB"
    assert lines["loss of a random 25% of the Gaussians"].beside == "cover −2.50 dB"


def _set(*path: str | int) -> Callable[[dict[str, Any], Any], None]:
    def change(data: dict[str, Any], value: Any) -> None:
        at: Any = data
        for step in path[:-1]:
            at = at[step]
        at[path[-1]] = value

    return change


@pytest.mark.parametrize(
    ("measure", "change", "fine", "beyond", "word"),
    [
        ("cover on test photos", _set("images", "cover", "mean", "psnr"), 26.0, 25.9, "visible"),
        ("secret 1 on test photos", _set("images", "secrets", 0, "mean", "psnr"), 29.5, 29.4, "missed"),
        ("wrong keys", _set("wrong_key", "vs_secrets", 0, "max"), 8.0, 8.1, "visible"),
        ("leaks without the key", _set("leaks", 0, 1, "leak", "psnr"), 1.0, 1.01, "visible"),
        ("leaks without the key", _set("leaks", 1, 0, "leak", "ssim"), 0.05, 0.051, "visible"),
        (
            "attributes of the Gaussians",
            _set("distances", "attributes", "opacity", "ratio"),
            1.5,
            1.51,
            "visible",
        ),
        ("classifier between models", _set("two_sample", "stego", 0, "auc"), 0.6, 0.61, "visible"),
        ("StegExpose on renders", _set("stegexpose", "roc", "low"), 0.5, 0.51, "visible"),
        ("StegExpose on renders", _set("stegexpose", "roc", "high"), 0.75, 0.45, "visible"),
        (
            "loss of a random 25% of the Gaussians",
            _set("robustness", 2, "secrets", 1, "loss"),
            4.0,
            4.1,
            "missed",
        ),
        (
            "loss of a random 25% of the Gaussians",
            _set("robustness", 2, "secrets", 0, "opens"),
            True,
            False,
            "missed",
        ),
        ("other readers of the file", _set("speed", "readers", 0, "loads"), True, False, "missed"),
    ],
)
def test_each_threshold(
    measure: str, change: Callable[[dict[str, Any], Any], None], fine: Any, beyond: Any, word: str
) -> None:
    data = audit()
    change(data, fine)
    assert judged(data)[measure].word == "fine"
    change(data, beyond)
    assert judged(data)[measure].word == word


def test_a_detector_near_a_half_is_fine_however_narrow_its_interval() -> None:
    data = audit()
    data["stegexpose"]["roc"] = {"auc": 0.58, "low": 0.57, "high": 0.59}
    assert judged(data)["StegExpose on renders"].word == "fine"
    data["stegexpose"]["roc"] = {"auc": 0.62}
    assert judged(data)["StegExpose on renders"].word == "visible"


def test_the_loss_may_be_unknown_where_the_secret_does_not_open() -> None:
    data = audit()
    data["robustness"][2]["secrets"] = [{"psnr": None, "loss": None, "opens": False}]
    line = judged(data)["loss of a random 25% of the Gaussians"]
    assert (line.word, line.value) == ("missed", "the secret does not open")


def test_draws_are_taken_together() -> None:
    data = audit()
    data["robustness"].append(copy.deepcopy(data["robustness"][2]))
    data["robustness"][-1]["cover"]["loss"] = 3.5
    data["robustness"][-1]["secrets"][1]["loss"] = 4.7
    line = judged(data)["loss of a random 25% of the Gaussians"]
    assert (line.value, line.beside) == ("secret −4.20 dB", "cover −3.00 dB")
    rows = survivals(Part("audit.json: ", data))
    assert [row.draws for row in rows] == [1, 1, 2, 1, 1]
    data["robustness"][-1]["secrets"][1] = {"opens": False, "error": "too few Gaussians"}
    secret = survivals(Part("audit.json: ", data))[2].secrets[1]
    assert (secret.opens, secret.error, secret.loss) == (False, "too few Gaussians", 3.7)


def test_controls_are_expected_to_leak() -> None:
    data = audit()
    data["leaks"][0][1].update(control=True, leak={"psnr": 20.0, "ssim": 0.7})
    assert judged(data)["leaks without the key"].word == "fine"


def test_of_several_detectors_the_most_suspicious_counts() -> None:
    data = audit()
    near, far = {"auc": 0.45, "low": 0.4, "high": 0.6}, {"auc": 0.2, "low": 0.1, "high": 0.3}
    wide = {"auc": 0.95, "low": 0.4, "high": 1.0}
    data["sealwatch"] = {"spa": {"roc": near}, "ws": {"roc": far}, "spam": {"roc": wide}}
    line = judged(data)["sealwatch on renders"]
    assert (line.word, line.value) == ("visible", "AUC 0.20 (0.10 to 0.30), sealwatch WS")


def test_what_was_not_measured_is_not_judged() -> None:
    assert judged({}) == {}
    data = audit()
    data["robustness"][2]["strength"] = 0.3
    data["distances"]["attributes"] = {"position": {"distance": 0.1, "null": None, "ratio": None}}
    missing = {"loss of a random 25% of the Gaussians", "attributes of the Gaussians"}
    assert set(judged(audit())) - set(judged(data)) == missing


def test_the_headline() -> None:
    assert headline([]) == "Nothing was measured that could be judged."
    lines = verdicts(Part("audit.json: ", audit()))
    assert (
        headline([line for line in lines if line.word == "fine"]) == "All 8 measures are within their limits."
    )
    assert headline(lines) == (
        "8 of 10 measures are within their limits. Visible: attributes of the Gaussians. "
        "Missed: secret 2 on test photos."
    )


def test_fog_and_shapes_are_told_apart() -> None:
    data = audit()
    assert "the secret's shapes in them" not in judged(data)  # an audit without these scores
    leak = data["leaks"][0][0]["leak"]
    leak |= {"psnr": 4.0, "psnr_fitted": 0.3, "ssim_fitted": 0.01, "gradient_coarse": 0.02}
    lines = judged(data)
    assert lines["leaks without the key"].word == "visible"
    assert lines["the secret's shapes in them"].word == "fine"
    for score in ("psnr_fitted", "ssim_fitted", "gradient_coarse"):
        before = leak[score]
        leak[score] = 2.0
        assert judged(data)["the secret's shapes in them"].word == "visible"
        leak[score] = before


def test_a_detector_is_judged_beside_what_it_finds_between_plain_models() -> None:
    data = audit()
    data["sealwatch"] = {"spam": {"roc": {"auc": 0.73, "low": 0.68, "high": 0.78}}}
    assert judged(data)["sealwatch on renders"].word == "visible"
    data["sealwatch_null"] = {"spam": {"roc": {"auc": 0.70, "low": 0.65, "high": 0.75}}}
    line = judged(data)["sealwatch on renders"]
    assert (line.word, line.beside) == ("fine", "0.70 (0.65 to 0.75), between plain models")


def test_an_attribute_may_lie_as_far_off_as_that_of_the_covers_plain_model() -> None:
    data = audit()
    data["distances"] = {"attributes": {"scale": {"ratio": 1.9}, "opacity": {"ratio": 1.4}}}
    assert judged(data)["attributes of the Gaussians"].word == "visible"
    data["distances"]["original"] = {"scale": {"ratio": 1.9}, "opacity": {"ratio": 1.0}}
    assert judged(data)["attributes of the Gaussians"].word == "fine"
    data["distances"]["attributes"]["opacity"]["ratio"] = 1.6
    line = judged(data)["attributes of the Gaussians"]
    assert (line.word, line.value) == ("visible", "opacity 1.60×")


def test_a_classifier_may_tell_as_much_as_of_the_covers_plain_model() -> None:
    data = audit()
    data["two_sample"] = {"stego": [{"auc": 0.9}], "null": [{"auc": 0.6}]}
    assert judged(data)["classifier between models"].word == "visible"
    data["two_sample"]["original"] = [{"auc": 0.9}]
    assert judged(data)["classifier between models"].word == "fine"
    data["two_sample"]["original"] = [{"auc": 0.88}]
    assert judged(data)["classifier between models"].word == "visible"


def test_what_nobody_sees_is_fine_however_perfect_the_bound() -> None:
    data = audit()
    data["images"]["cover_bound"]["mean"]["psnr"] = 120.0
    for psnr, word in ((45.1, "fine"), (44.9, "visible")):
        data["images"]["cover"]["mean"]["psnr"] = psnr
        assert judged(data)["cover on test photos"].word == word
