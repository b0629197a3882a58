"""What the numbers of an audit come to: one line each, with a word. All thresholds are here.

*fine*: within the limit. *visible*: somebody without the key may see that something is hidden, or see
something of it. *missed*: nothing shows, but the hiding does not do as well as it should.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

from keyss.report.numbers import decibel, difference, integer, number, times
from keyss.report.reading import Part
from keyss.report.survival import survivals

QUALITY_LOSS = 1.0  # dB that cover or secret may be below plain 3DGS of the same photos
INVISIBLE = 45.0  # dB from which on nobody sees a difference: models that are their own bound have 120
DISTANCE_RATIO = 1.5  # of a distance from a plain model, to the one between two plain models
TWO_SAMPLE_AUC = 0.6  # of a classifier that tells the Gaussians of two models apart
AS_THE_PLAIN_MODEL = 0.01  # more than that of the cover's own plain model an AUC may be
IMAGE_AUC = 0.1  # distance from 0.5 of a detector's AUC on renders
LEAK_PSNR = 1.0  # dB nearer to the secret's photos than an innocent model comes
LEAK_SSIM = 0.05
LEAK_GRADIENT = 0.1  # correlation of coarse gradients with the photos', above an innocent model's
PRUNING, PRUNED = "random pruning", 0.25  # the share of the Gaussians that is removed ...
PRUNING_LOSS = 1.5  # ... and the dB that it may cost the secret more than the cover

PROGRAMS = {"stegexpose": "StegExpose", "sealwatch": "sealwatch"}
_SEALWATCH = ("spa", "ws", "spam")  # each with a ROC of its own

Word = Literal["fine", "visible", "missed"]


@dataclass(frozen=True)
class Verdict:
    """A line of the summary."""

    measure: str
    value: str
    beside: str  # the bound or the null that the value means something beside
    limit: str
    word: Word
    section: str  # where more of it is


def verdicts(audit: Part) -> list[Verdict]:
    """The lines of what the audit measured, most important first. Raises InputError."""
    lines = (
        _cover(audit),
        *_secrets(audit),
        _wrong_keys(audit),
        _leaks(audit),
        _shapes(audit),
        _distances(audit),
        _two_sample(audit),
        _detectors(audit, "stegexpose"),
        _detectors(audit, "sealwatch"),
        _pruning(audit),
        _readers(audit),
    )
    return [line for line in lines if line is not None]


def headline(lines: Sequence[Verdict]) -> str:
    """The summary in a sentence or two."""
    if not lines:
        return "Nothing was measured that could be judged."
    fine = sum(line.word == "fine" for line in lines)
    if fine == len(lines):
        return (
            f"All {fine} measures are within their limits."
            if fine > 1
            else "The one measure is within its limit."
        )
    parts = [f"{fine} of {len(lines)} measures are within their limits."]
    for word in ("visible", "missed"):
        names = [line.measure for line in lines if line.word == word]
        if names:
            parts.append(f"{word.capitalize()}: {', '.join(names)}.")
    return " ".join(parts)


def auc_text(part: Part) -> str:
    """An AUC with its interval: 0.54 (0.43 to 0.65)."""
    low, high = part.number("low"), part.number("high")
    interval = "" if low is None or high is None else f" ({number(low, 2)} to {number(high, 2)})"
    return number(part.number("auc"), 2) + interval


def rocs(audit: Part, key: str, which: Literal["", "_null"] = "") -> list[tuple[str, Part]]:
    """The ROCs that a program's detectors have in an audit, with their names; null: between plain models."""
    program, name = audit.part(key + which), PROGRAMS[key]
    found = [(name, program.part("roc"))]
    found += [(f"{name} {each.upper()}", program.part(each).part("roc")) for each in _SEALWATCH]
    return [(name, roc) for name, roc in found if roc]


def _cover(audit: Part) -> Verdict | None:
    images = audit.part("images")
    return _quality("cover on test photos", images.part("cover"), images.part("cover_bound"), "visible")


def _secrets(audit: Part) -> Iterable[Verdict | None]:
    images = audit.part("images")
    secrets, bounds = images.parts("secrets"), images.parts("secret_bounds")
    for index, (secret, bound) in enumerate(zip(secrets, bounds, strict=False), start=1):
        name = f"secret {index}" if len(secrets) > 1 else "secret"
        yield _quality(f"{name} on test photos", secret, bound, "missed")


def _quality(measure: str, found: Part, bound: Part, otherwise: Word) -> Verdict | None:
    got, limit = found.part("mean").number("psnr"), bound.part("mean").number("psnr")
    if got is None or limit is None:
        return None
    return Verdict(
        measure,
        decibel(got),
        f"{decibel(limit)}, plain 3DGS",
        f"at most {decibel(QUALITY_LOSS, 1)} less",
        "fine" if got >= min(limit - QUALITY_LOSS, INVISIBLE) else otherwise,
        "images",
    )


def _wrong_keys(audit: Part) -> Verdict | None:
    wrong = audit.part("wrong_key")
    pairs = [
        (shown, floor)
        for each, floor in zip(wrong.parts("vs_secrets"), wrong.numbers("floor"), strict=False)
        if (shown := each.number("max")) is not None
    ]
    if not pairs:
        return None
    shown, floor = max(pairs, key=lambda pair: pair[0] - pair[1])
    return Verdict(
        "wrong keys",
        f"{decibel(shown)}, best of {integer(wrong.number('keys'))}",
        f"{decibel(floor)}, published model",
        f"at most {decibel(LEAK_PSNR, 1)} more",
        "fine" if shown - floor <= LEAK_PSNR else "visible",
        "wrong-keys",
    )


def _leaks(audit: Part) -> Verdict | None:
    psnr, ssim = _largest_leak(audit, "psnr"), _largest_leak(audit, "ssim")
    if psnr is None or ssim is None:
        return None
    return Verdict(
        "leaks without the key",
        f"{difference(psnr)} dB, {difference(ssim, 3)} SSIM",
        "0, plain model",
        f"at most {decibel(LEAK_PSNR, 1)} and {LEAK_SSIM} SSIM",
        "fine" if psnr <= LEAK_PSNR and ssim <= LEAK_SSIM else "visible",
        "leaks",
    )


def _shapes(audit: Part) -> Verdict | None:
    """Fog is nearer to most photos than darkness is. What is left when colours are fitted is the secret."""
    psnr, ssim = _largest_leak(audit, "psnr_fitted"), _largest_leak(audit, "ssim_fitted")
    gradient = _largest_leak(audit, "gradient_coarse")
    if psnr is None or ssim is None or gradient is None:
        return None
    within = psnr <= LEAK_PSNR and ssim <= LEAK_SSIM and gradient <= LEAK_GRADIENT
    return Verdict(
        "the secret's shapes in them",
        f"{difference(psnr)} dB, {difference(ssim, 3)} SSIM, {difference(gradient)} gradients",
        "0, plain model; colours fitted",
        f"at most {decibel(LEAK_PSNR, 1)}, {LEAK_SSIM} and {LEAK_GRADIENT}",
        "fine" if within else "visible",
        "leaks",
    )


def _largest_leak(audit: Part, score: str) -> float | None:
    attacks = [attack for attacks in audit.lists("leaks", 500) for attack in attacks]
    leaks = [attack.part("leak") for attack in attacks if not attack.flag("control")]
    return _largest(leaks, lambda leak: leak.number(score))


def _distances(audit: Part) -> Verdict | None:
    attributes = audit.part("distances").named("attributes", 100)
    ratios = {n: ratio for n, part in attributes.items() if (ratio := part.number("ratio")) is not None}
    if not ratios:
        return None
    plain = {
        n: part.number("ratio") or 0.0 for n, part in audit.part("distances").named("original", 100).items()
    }
    worst = max(ratios, key=lambda name: ratios[name] / max(plain.get(name, 0.0), DISTANCE_RATIO))
    own = f"; the cover's plain model {times(plain[worst])}" if worst in plain else ""
    within = ratios[worst] <= max(DISTANCE_RATIO, 1.01 * plain.get(worst, 0.0))
    return Verdict(
        "attributes of the Gaussians",
        f"{worst} {times(ratios[worst])}",
        f"1×, between plain models{own}",
        f"at most {DISTANCE_RATIO}×, or as the plain model's",
        "fine" if within else "visible",
        "statistics",
    )


def _two_sample(audit: Part) -> Verdict | None:
    part = audit.part("two_sample")
    stego = _largest(part.parts("stego", 1000), lambda each: each.number("auc"))
    null = _largest(part.parts("null", 1000), lambda each: each.number("auc"))
    if stego is None:
        return None
    own = _largest(part.parts("original", 1000), lambda each: each.number("auc"))
    beside = [] if null is None else [f"{number(null, 2)}, between plain models"]
    beside += [] if own is None else [f"the cover's plain model {number(own, 2)}"]
    within = stego <= max(TWO_SAMPLE_AUC, 0.0 if own is None else own + AS_THE_PLAIN_MODEL)
    return Verdict(
        "classifier between models",
        f"AUC {number(stego, 2)}",
        "; ".join(beside),
        f"at most {TWO_SAMPLE_AUC}" + ("" if own is None else ", or as the plain model's"),
        "fine" if within else "visible",
        "statistics",
    )


def _detectors(audit: Part, key: str) -> Verdict | None:
    """One line for all detectors of a program: the one that finds most beyond its null."""
    nulls = dict(rocs(audit, key, "_null"))
    curves = [(name, roc, nulls.get(name)) for name, roc in rocs(audit, key) if roc.number("auc") is not None]
    if not curves:
        return None
    name, roc, null = max(curves, key=lambda curve: _suspicion(*curve[1:]))
    return Verdict(
        f"{PROGRAMS[key]} on renders",
        f"AUC {auc_text(roc)}" + (f", {name}" if len(curves) > 1 else ""),
        "0.5, guessing" if null is None else f"{auc_text(null)}, between plain models",
        f"{IMAGE_AUC} further from 0.5, or within interval",
        "visible" if _suspicion(roc, null)[0] else "fine",
        "renders",
    )


def _suspicion(roc: Part, null: Part | None) -> tuple[bool, float]:
    """Whether an AUC is too much further from guessing than that between plain models, and by how much."""
    auc, low, high = roc.number("auc") or 0.0, roc.number("low"), roc.number("high")
    plain = 0.5 if null is None else null.number("auc")
    beyond = abs(auc - 0.5) - (0.0 if plain is None else abs(plain - 0.5))
    undecided = low is not None and high is not None and low <= 0.5 <= high
    return beyond > IMAGE_AUC and not undecided, beyond


def _pruning(audit: Part) -> Verdict | None:
    found = (each for each in survivals(audit) if (each.attack, each.strength) == (PRUNING, PRUNED))
    pruned = next(found, None)
    if pruned is None or pruned.cover.loss is None or not pruned.secrets:
        return None
    opens = all(secret.opens for secret in pruned.secrets)
    worst = max((secret.loss for secret in pruned.secrets if secret.loss is not None), default=None)
    if opens and worst is None:
        return None
    within = opens and worst is not None and worst - pruned.cover.loss <= PRUNING_LOSS
    return Verdict(
        f"loss of a random {PRUNED:.0%} of the Gaussians",
        f"secret {_change(worst)}" if opens else "the secret does not open",
        f"cover {_change(pruned.cover.loss)}",
        f"at most {decibel(PRUNING_LOSS, 1)} more",
        "fine" if within else "missed",
        "robustness",
    )


def _change(loss: float | None) -> str:
    return f"{difference(None if loss is None else -loss)} dB"


def _readers(audit: Part) -> Verdict | None:
    readers = [
        reader for reader in audit.part("speed").parts("readers", 500) if reader.flag("loads") is not None
    ]
    if not readers:
        return None
    loads = sum(reader.flag("loads") is True for reader in readers)
    return Verdict(
        "other readers of the file",
        f"{loads} of {len(readers)}",
        "",
        "all",
        "fine" if loads == len(readers) else "missed",
        "speed",
    )


def _largest(parts: Iterable[Part], read: Callable[[Part], float | None]) -> float | None:
    return max((value for part in parts if (value := read(part)) is not None), default=None)
