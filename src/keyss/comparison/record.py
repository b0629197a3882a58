"""`comparison.json`: methods beside each other on the same scenes, as `keyss compare` found them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from keyss._version import __version__
from keyss.measure.speed import ReaderResult
from keyss.methods.base import Capabilities


@dataclass(frozen=True, kw_only=True)
class SceneScores:
    """A scene on its test views."""

    psnr: float  # dB
    ssim: float  # the 3DGS variant
    lpips: float | None  # with AlexNet; None where its weights are not installed
    render_seconds: float  # of a picture, median
    render_ratio: float  # that over the plain model's


@dataclass(frozen=True, kw_only=True)
class Secrecy:
    """Figures of an audit that a single file has, each beside the cover's plain model from the same seed.

    None where there is no 3DGS model to look at, or too little of it.
    """

    classifier: float | None  # AUC of trees that tell its Gaussians from those of plain models, other seeds
    classifier_plain: float | None  # the plain model from those
    stealth: float | None  # least p-value of all statistics, corrected for their number
    stealth_plain: float | None
    stealth_statistic: str | None  # which statistic it is
    stegexpose: float  # AUC on renders, against a plain model's of another seed
    stegexpose_plain: float


@dataclass(frozen=True, kw_only=True)
class WrongKeysShow:
    """What a method's decoder makes of wrong keys, against test views."""

    cover: float  # dB, mean
    secret: float  # dB, of the one nearest to the secret
    chance: float  # dB, the published model itself against the secret


@dataclass(frozen=True, kw_only=True)
class Survival:
    """What a change of the published model costs."""

    change: str  # short, the head of a column
    sentence: str  # what is done
    cover_loss: float | None = None  # dB
    secret_loss: float | None = None  # dB; None where the secret does not open any more
    skipped: str | None = None  # why it was not tried


@dataclass(frozen=True, kw_only=True)
class ComparedMethod:
    """One method. What it could not do is in `error`, and then nothing else was measured."""

    version: int = 2
    name: str  # METHOD, or METHOD:PRESET where it is not the first
    error: str | None = None
    capabilities: Capabilities = field(default_factory=Capabilities)
    most_secrets: int = 1
    cover: SceneScores | None = None
    secret: SceneScores | None = None
    secrecy: Secrecy | None = None
    wrong_keys: WrongKeysShow | None = None  # None where a wrong key opens nothing, and without keys
    survival: tuple[Survival, ...] = ()
    readers: tuple[ReaderResult, ...] = ()  # other people's programs on what is published
    steps: int = 0  # of its own training, after plain models
    trained: tuple[int | None, ...] = ()  # steps in which cover and secret were drawn, plain models included
    gaussians: int = 0  # that are published
    published_bytes: int = 0
    handed_bytes: int = 0  # beside what is published
    seconds: float = 0.0  # of hiding, without plain models
    measuring_seconds: float = 0.0  # of all that is above


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """All of them."""

    version: int = 2
    keyss: str = __version__
    arguments: dict[str, Any]
    methods: tuple[ComparedMethod, ...] = ()
