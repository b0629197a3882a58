"""The summary of an audit: a verdict for each measure.

*fine*: within the limit. *visible*: that something is hidden, or what, may be visible without the key.
*missed*: nothing is visible, but the quality is too low. *inconclusive*: controls differ as much from each
other, so that the measure says nothing. Limits of leaks are in `leak_scores`, all others here.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

from keyss.lab.auc import Auc
from keyss.lab.audits.audit_run import Audit
from keyss.lab.audits.formatting import decibel, difference, number, numbered, significant, times
from keyss.lab.leaks.leak_scores import GRADIENT_LIMIT, PSNR_LIMIT, SSIM_LIMIT, AttackResult

QUALITY_LOSS = 1.0  # dB of cover or secret below the plain model of the same scene
INVISIBLE = 45.0  # dB: a higher PSNR makes no visible difference
IDENTICAL = 119.9  # dB; a given model has 120 against its own renders
DISTANCE_RATIO = 1.5  # distance from controls / distance between controls
TWO_SAMPLE_AUC = 0.6  # classifier between the Gaussians of two models
AUC_TOLERANCE = 0.01  # above the AUC of the cover's own plain model
UNUSUAL = 0.01  # p, corrected for the number of statistics
IMAGE_AUC = 0.1  # distance of StegExpose's AUC from 0.5
WRONG_KEY = 1.0  # dB above chance level
PRUNING, PRUNED = "random pruning", 0.25  # the attack, and its share of the Gaussians
PRUNING_LOSS = 1.5  # dB that the secret may lose more than the cover

Word = Literal["fine", "visible", "missed", "inconclusive"]


@dataclass(frozen=True)
class Verdict:
    """A line of the summary."""

    measure: str
    value: str
    beside: str  # the baseline or control
    limit: str
    word: Word
    section: str  # section of the report


def verdicts(audit: Audit) -> list[Verdict]:
    """The verdicts on everything that the audit measured, the most important first."""
    return [
        *_qualities(audit),
        *_wrong_keys(audit),
        *_leaks(audit),
        *_stealth(audit),
        *_distances(audit),
        *_two_sample(audit),
        *_renders(audit),
        *_pruning(audit),
    ]


def headline(lines: Sequence[Verdict]) -> str:
    """The summary in one or two sentences."""
    if not lines:
        return "Nothing was measured that could be judged."
    fine = sum(line.word == "fine" for line in lines)
    if fine == len(lines):
        parts = [f"All {fine} measures are within their limits."]
    else:
        parts = [f"{fine} of {len(lines)} measures are within their limits."]
    for word in ("visible", "missed", "inconclusive"):
        names = [line.measure for line in lines if line.word == word]
        if names:
            parts.append(f"{word.capitalize()}: {', '.join(names)}.")
    return " ".join(parts)


def auc_text(auc: Auc) -> str:
    """An AUC with its interval: 0.54 (0.43 to 0.65)."""
    return f"{number(auc.auc, 2)} ({number(auc.low, 2)} to {number(auc.high, 2)})"


def worst_leak(attacks: Iterable[AttackResult]) -> AttackResult | None:
    """The attack without the key that shows the most of the secret."""
    return max(attacks, key=lambda attack: attack.leak.evidence(), default=None)


def _word(within: bool, otherwise: Word = "visible") -> Word:
    return "fine" if within else otherwise


def _qualities(audit: Audit) -> Iterator[Verdict]:
    for index, model in enumerate(audit.images.models if audit.images else ()):
        if model.baseline is None:
            continue
        psnr, plain = model.images.mean.psnr, model.baseline.mean.psnr
        lowest, limit = plain - QUALITY_LOSS, f"at most {decibel(QUALITY_LOSS, 1)} less"
        if lowest > INVISIBLE:
            lowest, limit = INVISIBLE, f"at least {decibel(INVISIBLE, 0)}"
        measure = f"{model.scene} on {'test photos' if model.photos else 'renders of its model'}"
        beside = "the given model itself" if plain >= IDENTICAL else f"{decibel(plain)}, plain model"
        word = _word(psnr >= lowest, "missed" if index else "visible")
        yield Verdict(measure, decibel(psnr), beside, limit, word, "images")


def _wrong_keys(audit: Audit) -> Iterator[Verdict]:
    if audit.wrong_key is None:
        return
    pairs = zip(audit.wrong_key.vs_secrets, audit.chance_level, strict=False)
    found = [(psnr.max - chance, psnr.max, chance) for psnr, chance in pairs]
    if found:
        more, psnr, chance = max(found)
        value = f"{decibel(psnr)}, best of {audit.wrong_key.keys:,}"
        beside = f"{decibel(chance)}, chance level"
        limit = f"at most {decibel(WRONG_KEY, 1)} more"
        yield Verdict("wrong keys", value, beside, limit, _word(more <= WRONG_KEY), "wrong-keys")


def _leaks(audit: Audit) -> Iterator[Verdict]:
    secrets = audit.leaks or ()
    worst = worst_leak(attack for attacks in secrets for attack in attacks)
    if worst is None:
        return
    index = next(index for index, attacks in enumerate(secrets) if worst in attacks)
    of = f"{numbered('secret', index, len(secrets))}, " if len(secrets) > 1 else ""
    leak = worst.leak
    value = f"{difference(leak.psnr_fitted)} dB, {difference(leak.ssim_fitted, 3)} SSIM, "
    value += f"{difference(leak.gradient)} gradients ({of}{worst.attack}: {worst.best})"
    limit = f"at most {decibel(PSNR_LIMIT, 1)}, {SSIM_LIMIT} and {GRADIENT_LIMIT}"
    beside = "0, plain models; colours fitted"
    yield Verdict("leaks without the key", value, beside, limit, _word(leak.evidence() <= 1), "leaks")


def _stealth(audit: Audit) -> Iterator[Verdict]:
    result = audit.stealth
    if result is None or not result.statistics:
        return
    limit = f"at least {UNUSUAL}, as between plain models"
    beside = f"{significant(result.least_of_controls)}, between plain models"
    word = _word(result.least >= UNUSUAL)
    if result.least_of_controls < UNUSUAL and result.least >= UNUSUAL * result.least_of_controls:
        word = "inconclusive"
    value = f"p = {significant(result.least)} ({result.statistics[0].name})"
    yield Verdict("the file by itself", value, beside, limit, word, "stealth")


def _distances(audit: Audit) -> Iterator[Verdict]:
    distances = audit.parameters.distances if audit.parameters else {}
    judged = {name: each for name, each in distances.items() if each.ratio is not None}
    if not judged:
        return
    limits = {name: max(DISTANCE_RATIO, 1.01 * (each.original or 0)) for name, each in judged.items()}
    name, worst = max(judged.items(), key=lambda item: (item[1].ratio or 0) / limits[item[0]])
    own = "" if worst.original is None else f"; the cover's plain model {times(worst.original)}"
    value, beside = f"{name} {times(worst.ratio)}", f"1×, between plain models{own}"
    limit = f"at most {DISTANCE_RATIO}×, or as the plain model's"
    word = _word((worst.ratio or 0) <= limits[name])
    yield Verdict("attributes of the Gaussians", value, beside, limit, word, "statistics")


def _two_sample(audit: Audit) -> Iterator[Verdict]:
    if audit.parameters is None:
        return
    result = audit.parameters.two_sample
    stego, control = (max((auc.auc for auc in aucs), default=0.0) for aucs in (result.stego, result.control))
    own = max((auc.auc for auc in result.original), default=0.0)
    beside = f"{number(control, 2)}, between plain models; the cover's plain model {number(own, 2)}"
    limit = f"at most {TWO_SAMPLE_AUC}, or as the plain model's"
    word = _word(stego <= max(TWO_SAMPLE_AUC, own + AUC_TOLERANCE))
    yield Verdict("classifier between models", f"AUC {number(stego, 2)}", beside, limit, word, "statistics")


def _renders(audit: Audit) -> Iterator[Verdict]:
    if audit.stegexpose is None:
        return
    stego, control = audit.stegexpose.stego, audit.stegexpose.control
    excess = abs(stego.auc - 0.5) - abs(control.auc - 0.5)
    undecided = stego.low <= 0.5 <= stego.high
    value, beside = f"AUC {auc_text(stego)}", f"{auc_text(control)}, between plain models"
    limit = f"at most {IMAGE_AUC} further from 0.5, or 0.5 in the interval"
    word = _word(undecided or excess <= IMAGE_AUC)
    yield Verdict("StegExpose on renders", value, beside, limit, word, "renders")


def _pruning(audit: Audit) -> Iterator[Verdict]:
    for change in audit.robustness or ():
        if (change.attack, change.strength) != (PRUNING, PRUNED) or not (change.cover and change.secrets):
            continue
        opens = all(secret.opens for secret in change.secrets)
        worst = max(secret.loss for secret in change.secrets)
        word = _word(opens and worst - change.cover.loss <= PRUNING_LOSS, "missed")
        measure = f"loss of a random {PRUNED:.0%} of the Gaussians"
        value = f"secret {difference(-worst)} dB" if opens else "the secret does not open"
        beside = f"cover {difference(-change.cover.loss)} dB"
        yield Verdict(measure, value, beside, f"at most {decibel(PRUNING_LOSS, 1)} more", word, "robustness")
