"""How well a hiding works: fidelity, stealth, attacks. Names are loaded at first use (PEP 562)."""

import importlib
from typing import Any

_HOME_OF = {
    "against_controls": "distances",
    "attribute_distances": "distances",
    "candidate_scores": "stealth.confirmation",
    "compare_images": "images",
    "composite_score": "sinkhorn",
    "judge": "stealth.judging",
    "look_for_secret": "leaks.looking",
    "measure_hiding": "hiding",
    "sealwatch_roc": "sealwatch_detectors",
    "search_embeddings": "leaks.attacks",
    "sinkhorn_3d": "sinkhorn",
    "stealth_statistics": "stealth.suite",
    "stegexpose_roc": "roc",
    "two_sample_against_controls": "two_sample",
    "two_sample_auc": "two_sample",
}
__all__ = list(_HOME_OF)


def __getattr__(name: str) -> Any:
    if name not in _HOME_OF:
        raise AttributeError(f"module 'keyss.measure' has no attribute {name!r}")
    value = getattr(importlib.import_module(f"keyss.measure.{_HOME_OF[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return __all__
