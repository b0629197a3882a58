"""All that one file shows by itself."""

from __future__ import annotations

import math

from keyss.core.gaussians import Gaussians
from keyss.measure.stealth.agreement import agreement
from keyss.measure.stealth.bits import bits
from keyss.measure.stealth.colours import colours
from keyss.measure.stealth.invariants import invariants
from keyss.measure.stealth.opacities import opacities
from keyss.measure.stealth.order import order
from keyss.measure.stealth.statistic import Statistic
from keyss.measure.stealth.words import Words

KINDS = ("bits", "agreement", "invariants", "opacities", "order", "colours")


def stealth_statistics(model: Gaussians) -> dict[str, Statistic]:
    """By name, "kind: what is counted", where there is enough to count; kinds are KINDS.

    Takes half a second for 10,000 Gaussians.
    """
    words = Words.of(model)
    found = {
        "bits": bits(words),
        "agreement": agreement(words, model.means.detach().cpu().double().numpy()),
        "invariants": invariants(model, words),
        "opacities": opacities(model),
        "order": order(model),
        "colours": colours(model),
    }
    return {
        f"{kind}: {name}": each
        for kind, own in found.items()
        for name, each in own.items()
        if not math.isnan(each.value)
    }
