"""How well a hiding works: fidelity, stealth, attacks. Names are loaded at first use (PEP 562)."""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from keyss.measure.distances import against_null, attribute_distances
    from keyss.measure.hiding import measure_hiding
    from keyss.measure.images import compare_images
    from keyss.measure.sinkhorn import composite_score, sinkhorn_3d
    from keyss.measure.two_sample import two_sample_against_null, two_sample_auc

__all__ = [
    "against_null",
    "attribute_distances",
    "compare_images",
    "composite_score",
    "measure_hiding",
    "sinkhorn_3d",
    "two_sample_against_null",
    "two_sample_auc",
]

_HOME_OF = {
    "against_null": "distances",
    "attribute_distances": "distances",
    "compare_images": "images",
    "composite_score": "sinkhorn",
    "measure_hiding": "hiding",
    "sinkhorn_3d": "sinkhorn",
    "two_sample_against_null": "two_sample",
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
