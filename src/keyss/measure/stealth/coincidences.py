"""Numbers of two Gaussians that agree in all bits that embedding leaves alone: are the others equal too?

Training leaves numbers equal in clones where it freezes or copies them: saturated opacities, the harmonics of
one channel, whole Gaussians. Embedding keeps the high bits and bit 0 and makes the others random, unless it
leaves both Gaussians alone. The null of pairs with a usable Gaussian is exact: independent low bits.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from keyss.channels import usable_carriers
from keyss.core.gaussians import Gaussians
from keyss.measure.stealth.agreement import nearest_pairs
from keyss.measure.stealth.statistic import Statistic, excess
from keyss.measure.stealth.words import ATTRIBUTES, Flags, Ints, Words, doubles

_WRITTEN = {"scale": 8, "rotation": 8, "opacity": 8, "sh1": 12, "sh2": 12, "sh3": 12}  # bits above bit 0
_CHANNELS = ("red", "green", "blue")
_LAGS = 4  # between pairs in the order of their high bits
_NEAREST = 16
_SATURATED = 16.0  # logit


def coincidences(model: Gaussians, words: Words) -> dict[str, Statistic]:
    """Equal low bits among pairs with equal high bits, over those expected by chance."""
    return {
        name: excess(equal, pairs, 2.0**-bits)
        for name, (equal, pairs, bits) in count_coincidences(model, words).items()
    }


def count_coincidences(model: Gaussians, words: Words) -> dict[str, tuple[int, int, int]]:
    """By name: pairs with equal low bits, pairs with equal high bits, and the number of low bits.

    Of all pairs and of neighbours in space, with a usable Gaussian; then of neighbours that are saturated,
    usable or not.
    """
    usable = usable_carriers(model)
    near = nearest_pairs(doubles(model.means), _NEAREST)
    saturated = model.opacity_logits.detach().cpu().numpy() > _SATURATED
    bright = near[saturated[near].all(axis=1)]
    counts: dict[str, tuple[int, int, int]] = {}
    for name, field, bits in _columns(words):
        low = np.uint32(((1 << bits) - 1) << 1)
        own = words.bits[:, field]
        of_all, of_near, of_bright = f"all, {name}", f"neighbours, {name}", f"saturated, {name}"
        for kind, pairs, chosen in (
            (of_all, _agreeing(own & ~low), usable),
            (of_near, near, usable),
            (of_bright, bright, np.ones(len(usable), bool)),
        ):
            one, other = pairs[chosen[pairs].any(axis=1)].T
            agree = (own[one] & ~low) == (own[other] & ~low)
            equal, trials, _ = counts.get(kind, (0, 0, bits))
            equal += int((own[one] == own[other])[agree].sum())
            counts[kind] = equal, trials + int(agree.sum()), bits
    return counts


def _columns(words: Words) -> Iterator[tuple[str, int, int]]:
    """Name, number and written bits of each column; the harmonics of a channel have one name."""
    for index, attribute in enumerate(ATTRIBUTES):
        if attribute in _WRITTEN:
            for number, column in enumerate(np.flatnonzero(words.attribute == index)):
                name = _CHANNELS[number % 3] if attribute.startswith("sh") else attribute
                yield name, int(column), _WRITTEN[attribute]


def _agreeing(kept: np.ndarray) -> Ints:
    """[P, 2] rows whose `kept` bits [N] agree, near each other in the order of these."""
    order = np.argsort(kept, kind="stable")
    pairs = [np.zeros((0, 2), np.int64)]
    for lag in range(1, min(_LAGS, len(kept) - 1) + 1):
        same: Flags = kept[order[lag:]] == kept[order[:-lag]]
        pairs.append(np.stack([order[:-lag][same], order[lag:][same]], axis=1))
    return np.concatenate(pairs)
