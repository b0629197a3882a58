"""How well a hiding works: fidelity, stealth, attacks. Names are loaded at first use (PEP 562)."""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from keyss.measure.distances import against_controls, attribute_distances
    from keyss.measure.hiding import measure_hiding
    from keyss.measure.images import compare_images
    from keyss.measure.leaks import look_for_secret
    from keyss.measure.roc import stegexpose_roc
    from keyss.measure.sealwatch_detectors import sealwatch_roc
    from keyss.measure.sinkhorn import composite_score, sinkhorn_3d
    from keyss.measure.two_sample import two_sample_against_controls, two_sample_auc
    from keyss.measure.white_box import search_embeddings

__all__ = [
    "against_controls",
    "attribute_distances",
    "compare_images",
    "composite_score",
    "look_for_secret",
    "measure_hiding",
    "sealwatch_roc",
    "search_embeddings",
    "sinkhorn_3d",
    "stegexpose_roc",
    "two_sample_against_controls",
    "two_sample_auc",
]

_HOME_OF = {
    "against_controls": "distances",
    "attribute_distances": "distances",
    "compare_images": "images",
    "composite_score": "sinkhorn",
    "look_for_secret": "leaks",
    "measure_hiding": "hiding",
    "sealwatch_roc": "sealwatch_detectors",
    "search_embeddings": "white_box",
    "sinkhorn_3d": "sinkhorn",
    "stegexpose_roc": "roc",
    "two_sample_against_controls": "two_sample",
    "two_sample_auc": "two_sample",
}


def __getattr__(name: str) -> Any:
    if name not in _HOME_OF:
        raise AttributeError(f"module 'keyss.measure' has no attribute {name!r}")
    value = getattr(importlib.import_module(f"keyss.measure.{_HOME_OF[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
