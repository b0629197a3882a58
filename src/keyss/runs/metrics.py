"""`metrics.json`: the measured results of a run."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from keyss._version import __version__
from keyss.fitting.image_metrics import ImageQuality
from keyss.measure.hiding import HidingQuality, RenderFidelity


@dataclass(frozen=True, kw_only=True)
class HideMetrics(HidingQuality):
    """Results of a hiding: PSNRs in dB and SSIMs on test views, measured through the written files."""

    version: int = 1
    keyss: str = __version__  # the program that wrote it
    method: str
    gaussians: int  # of the stego model
    photos: tuple[bool, ...]  # of the cover and the secrets; False: test views are renders of a given model
    secret_gaussians: tuple[int, ...]  # of the revealed secrets
    iterations: int  # of the method's own training, 0 without one
    # Training steps of the cover and of each secret, those of the plain model included if it was trained on;
    # None: unknown, since the plain model was given.
    steps: tuple[int | None, ...] = ()
    seconds: float  # of the whole run, interrupted parts included
    width: int  # pixels of the cover's test views
    seed: int
    against_plain: tuple[RenderFidelity, ...]  # cover, then secrets, opened from the written files
    details: Mapping[str, Any] = field(default_factory=dict)  # further numbers of the method


@dataclass(frozen=True, kw_only=True)
class FitMetrics(ImageQuality):
    """Results of a plain fit on the test views."""

    version: int = 1
    keyss: str = __version__
    gaussians: int
    iterations: int
    seconds: float  # of the whole run, interrupted parts included
    width: int  # pixels of the photos
    seed: int
