"""The summary of an audit: a verdict for each measure.

*fine*: within the limit. *visible*: without the key it may be visible that something is hidden, or what.
*missed*: nothing is visible, but the quality is lower than it should be. *not measured*: a tool was missing.
All limits are here, except those of leaks, which are in `keyss.measure.leaks.scores`.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

from keyss.audits.numbers import decibel, difference, number, numbered, significant, times
from keyss.audits.record import Audit
from keyss.measure.auc import Auc
from keyss.measure.images import ImageComparison
from keyss.measure.leaks.looking import AttackResult
from keyss.measure.leaks.scores import GRADIENT_LIMIT, PSNR_LIMIT, SSIM_LIMIT
from keyss.measure.robustness.survival import mean_over_draws

QUALITY_LOSS = 1.0  # dB of cover or secret below the plain model of the same scene
INVISIBLE = 45.0  # dB: a higher PSNR makes no visible difference
IDENTICAL = 119.9  # dB; a given model has 120 against its own renders
DISTANCE_RATIO = 1.5  # distance from controls / distance between controls
TWO_SAMPLE_AUC = 0.6  # of the classifier between the Gaussians of two models
AUC_TOLERANCE = 0.01  # above the AUC of the cover's own plain model
UNUSUAL = 0.01  # p, corrected for the number of statistics
IMAGE_AUC = 0.1  # distance of StegExpose's AUC from 0.5
WRONG_KEY = 1.0  # dB above chance level
PRUNING, PRUNED = "random pruning", 0.25  # the attack, and its share of the Gaussians
PRUNING_LOSS = 1.5  # dB that the secret may lose more than the cover

Word = Literal["fine", "visible", "missed", "not measured"]


JUDGED: tuple[Word, ...] = ("fine", "visible", "missed")


@dataclass(frozen=True)
class Verdict:
    """A line of the summary."""

    measure: str
    value: str
    beside: str  # the baseline or control
    limit: str
    word: Word
    section: str  # of the report


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
        *_readers(audit),
    ]


def headline(lines: Sequence[Verdict]) -> str:
    """The summary in one or two sentences."""
    if all(line.word not in JUDGED for line in lines):
        return "Nothing was measured that could be judged."
    fine, judged = (sum(line.word in words for line in lines) for words in (("fine",), JUDGED))
    if fine == judged == 1:
        parts = ["The one measure is within its limit."]
    elif fine == judged:
        parts = [f"All {fine} measures are within their limits."]
    else:
        parts = [f"{fine} of {judged} measures are within their limits."]
    for word in ("visible", "missed", "not measured"):
        names = [line.measure for line in lines if line.word == word]
        if names:
            parts.append(f"{word.capitalize()}: {', '.join(names)}.")
    return " ".join(parts)


def auc_text(found: Auc | None) -> str:
    """An AUC with its interval: 0.54 (0.43 to 0.65)."""
    if found is None:
        return number(None)
    return f"{number(found.auc, 2)} ({number(found.low, 2)} to {number(found.high, 2)})"


def _qualities(audit: Audit) -> Iterator[Verdict]:
    if audit.images is None:
        return
    images, count = audit.images, len(audit.images.secrets)
    rows: list[tuple[str, ImageComparison, ImageComparison | None, Word]]
    rows = [("cover", images.cover, images.cover_baseline, "visible")]
    for index, pair in enumerate(zip(images.secrets, images.secret_baselines, strict=False)):
        rows.append((numbered("secret", index, count), *pair, "missed"))
    for (name, found, baseline, otherwise), photos in zip(rows, _photos(audit), strict=False):
        if baseline is not None:
            got, plain = found.mean.psnr, baseline.mean.psnr
            limit = f"at most {decibel(QUALITY_LOSS, 1)} less"
            if (least := plain - QUALITY_LOSS) > INVISIBLE:
                least, limit = INVISIBLE, f"at least {decibel(INVISIBLE, 0)}"
            word = _word(got >= least, otherwise)
            beside = "the given model itself" if plain >= IDENTICAL else f"{decibel(plain)}, plain model"
            yield Verdict(f"{name} on {_views(photos)}", decibel(got), beside, limit, word, "images")


def _wrong_keys(audit: Audit) -> Iterator[Verdict]:
    wrong = audit.wrong_key
    if wrong is None or not (wrong.shown.vs_secrets and wrong.chance_level):
        return
    pairs = zip(wrong.shown.vs_secrets, wrong.chance_level, strict=False)
    shown, chance = max(((each.max, chance) for each, chance in pairs), key=lambda pair: pair[0] - pair[1])
    value, beside = f"{decibel(shown)}, best of {wrong.shown.keys:,}", f"{decibel(chance)}, chance level"
    limit = f"at most {decibel(WRONG_KEY, 1)} more"
    yield Verdict("wrong keys", value, beside, limit, _word(shown - chance <= WRONG_KEY), "wrong-keys")


def worst_leak(attacks: Iterable[AttackResult]) -> AttackResult | None:
    """The attack without the key that shows the most of the secret."""
    without_key = (attack for attack in attacks if not attack.with_key)
    return max(without_key, key=lambda attack: attack.best_leak.evidence(), default=None)


def _leaks(audit: Audit) -> Iterator[Verdict]:
    secrets = audit.leaks.secrets if audit.leaks else ()
    worst = worst_leak(attack for attacks in secrets for attack in attacks)
    if worst is None:
        return
    index = next(index for index, attacks in enumerate(secrets) if worst in attacks)
    of = f"{numbered('secret', index, len(secrets))}, " if len(secrets) > 1 else ""
    # With colours fitted: haze is closer to most photos than black, but shows nothing of the secret.
    leak = worst.best_leak
    value = f"{difference(leak.psnr_fitted)} dB, {difference(leak.ssim_fitted, 3)} SSIM, "
    value += f"{difference(leak.gradient_coarse)} gradients ({of}{worst.attack}: {worst.best})"
    limit = f"at most {decibel(PSNR_LIMIT, 1)}, {SSIM_LIMIT} and {GRADIENT_LIMIT}"
    beside = "0, plain models; colours fitted"
    yield Verdict("leaks without the key", value, beside, limit, _word(leak.evidence() <= 1), "leaks")


def _distances(audit: Audit) -> Iterator[Verdict]:
    attributes = audit.parameters.distances if audit.parameters else {}
    ratios = {name: each.ratio for name, each in attributes.items() if each.ratio is not None}
    if not ratios:
        return
    plain = {name: each.original for name, each in attributes.items() if each.original is not None}
    worst = max(ratios, key=lambda name: ratios[name] / max(plain.get(name, 0.0), DISTANCE_RATIO))
    own = f"; the cover's plain model {times(plain[worst])}" if worst in plain else ""
    value, beside = f"{worst} {times(ratios[worst])}", f"1×, between plain models{own}"
    limit = f"at most {DISTANCE_RATIO}×, or as the plain model's"
    word = _word(ratios[worst] <= max(DISTANCE_RATIO, 1.01 * plain.get(worst, 0.0)))
    yield Verdict("attributes of the Gaussians", value, beside, limit, word, "statistics")


def _stealth(audit: Audit) -> Iterator[Verdict]:
    """Statistics of the file, and whether a guess of a secret can be confirmed."""
    found = audit.stealth
    if found is None or not found.statistics:
        return
    worst = found.statistics[0]
    limit = f"at least {UNUSUAL}, or as between plain models"
    beside = f"{significant(found.least_of_controls)}, between plain models"
    word = _word(found.least >= min(UNUSUAL, found.least_of_controls))
    value = f"p = {significant(found.least)} ({worst.name})"
    yield Verdict("the file by itself", value, beside, limit, word, "stealth")
    rows = [row for each in found.confirmations if each is not None for row in each.scores]
    if rows:
        likeliest = min(rows, key=lambda row: row.p)
        value = f"p = {significant(found.least_confirmation)} ({likeliest.name})"
        word = _word(found.least_confirmation >= UNUSUAL)
        yield Verdict(
            "guessing the secret", value, "plain models of the cover", f"at least {UNUSUAL}", word, "stealth"
        )


def _two_sample(audit: Audit) -> Iterator[Verdict]:
    found = audit.parameters.two_sample if audit.parameters else None
    if found is None or not found.stego:
        return
    stego = max(each.auc for each in found.stego)
    control = max((each.auc for each in found.control), default=None)
    own = max((each.auc for each in found.original), default=None)
    beside = [] if control is None else [f"{number(control, 2)}, between plain models"]
    beside += [] if own is None else [f"the cover's plain model {number(own, 2)}"]
    limit = f"at most {TWO_SAMPLE_AUC}" + ("" if own is None else ", or as the plain model's")
    word = _word(stego <= max(TWO_SAMPLE_AUC, 0.0 if own is None else own + AUC_TOLERANCE))
    value = f"AUC {number(stego, 2)}"
    yield Verdict("classifier between models", value, "; ".join(beside), limit, word, "statistics")


def _renders(audit: Audit) -> Iterator[Verdict]:
    if audit.stegexpose is None:
        return
    stego, control = audit.stegexpose.stego.fused, audit.stegexpose.control.fused
    excess = abs(stego.auc - 0.5) - abs(control.auc - 0.5)
    undecided = stego.low <= 0.5 <= stego.high
    value, beside = f"AUC {auc_text(stego)}", f"{auc_text(control)}, between plain models"
    limit = f"at most {IMAGE_AUC} further from 0.5, or 0.5 in the interval"
    word = _word(undecided or excess <= IMAGE_AUC)
    yield Verdict("StegExpose on renders", value, beside, limit, word, "renders")


def _word(within: bool, otherwise: Word = "visible") -> Word:
    return "fine" if within else otherwise


def _pruning(audit: Audit) -> Iterator[Verdict]:
    changes = mean_over_draws(audit.robustness.changes) if audit.robustness else []
    pruned = next((each for each in changes if (each.attack, each.strength) == (PRUNING, PRUNED)), None)
    if pruned is None or pruned.cover is None or not pruned.secrets:
        return
    opens, worst = all(each.opens for each in pruned.secrets), max(each.loss for each in pruned.secrets)
    word = _word(opens and worst - pruned.cover.loss <= PRUNING_LOSS, "missed")
    measure = f"loss of a random {PRUNED:.0%} of the Gaussians"
    value = f"secret {difference(-worst)} dB" if opens else "the secret does not open"
    beside, limit = f"cover {difference(-pruned.cover.loss)} dB", f"at most {decibel(PRUNING_LOSS, 1)} more"
    yield Verdict(measure, value, beside, limit, word, "robustness")


def missing_readers(audit: Audit) -> dict[str, str]:
    """Readers that are not installed, and how to install them."""
    readers = audit.speed.readers if audit.speed else ()
    return {each.reader: each.note or "not installed" for each in readers if each.loads is None}


def _readers(audit: Audit) -> Iterator[Verdict]:
    there = [each for each in (audit.speed.readers if audit.speed else ()) if each.loads is not None]
    if there:
        word = _word(all(each.loads for each in there), "missed")
        failing = dict.fromkeys(each.reader for each in there if not each.loads)
        reading = dict.fromkeys(each.reader for each in there if each.reader not in failing)
        parts = [f"by {', '.join(reading)}"] if reading else []
        parts += [f"not by {', '.join(failing)}"] if failing else []
        yield Verdict("reading by other programs", "; ".join(parts), "", "by all", word, "speed")
    if missing := missing_readers(audit):
        name = f"reading by {', '.join(missing)}"
        yield Verdict(name, "not installed", "", "by all", "not measured", "not-measured")


def _photos(audit: Audit) -> list[bool]:
    """Whether the cover and each secret have photos."""
    count = 1 + len(audit.images.secrets if audit.images else ())
    return [*audit.run.photos[:count], *[True] * (count - len(audit.run.photos))]


def _views(photos: bool) -> str:
    return "test photos" if photos else "renders of its model"
