"""The record of an audit, `audit/audit.json`, with a field for each part."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from keyss.core.errors import InputError
from keyss.measure.auc import StegExposeAuc
from keyss.measure.distances import AttributeDistance
from keyss.measure.hiding import WrongKeys
from keyss.measure.images import ImageComparison
from keyss.measure.leaks.looking import AttackResult
from keyss.measure.robustness.survival import BreakdownPoint, ChangeResult
from keyss.measure.sinkhorn import Sinkhorn3D
from keyss.measure.speed import SpeedResult
from keyss.measure.stealth.judging import StealthResult
from keyss.measure.two_sample import TwoSample
from keyss.runs.files import run_folder
from keyss.runs.folder import PRIVATE
from keyss.runs.records import read_record

AUDIT_FOLDER, AUDIT_FILE = f"{PRIVATE}/audit", "audit.json"  # the folder is in that of the run
PICTURES = "pictures"  # folder in that of the audit


@dataclass(frozen=True)
class AuditedRun:
    """The audited run, and the versions that audited it."""

    path: str
    method: str
    cover: str  # a scene folder, or a model without photos; so are the secrets
    secrets: tuple[str, ...]
    width: int | None  # pixels, if photos were shrunk
    gaussians: int  # of the stego model
    photos: tuple[bool, ...]  # of the cover and the secrets; False: test views are renders of a given model
    standard: bool = True  # whether a 3DGS model is published
    config: dict[str, Any] = field(default_factory=dict)
    versions: dict[str, str] = field(default_factory=dict)  # of Python and of libraries, by name
    up: str = "-y"  # the way up in the cover: "-y", "z" or "y"


@dataclass(frozen=True)
class Controls:
    """Plain models of the cover from other seeds."""

    models: int
    seeds: tuple[int, ...]


@dataclass(frozen=True)
class WrongKeyResult:
    """What wrong keys show, from the run's `metrics.json`."""

    shown: WrongKeys
    chance_level: tuple[float, ...]  # dB, the stego model itself against each secret's test views


@dataclass(frozen=True)
class LabelledPicture:
    label: str
    file: str  # in the audit's folder


@dataclass(frozen=True)
class PicturedView:
    """Pictures of one view by several models."""

    title: str
    items: tuple[LabelledPicture, ...]


@dataclass(frozen=True)
class ImagesResult:
    """Cover and secrets against the test views, with plain models as baselines if there are any."""

    cover: ImageComparison
    cover_baseline: ImageComparison | None
    secrets: tuple[ImageComparison, ...]
    secret_baselines: tuple[ImageComparison | None, ...]
    gaussians: tuple[int, ...]  # of the stego model and of the revealed secrets
    baseline_gaussians: tuple[int | None, ...]  # of the plain models
    pictures: tuple[PicturedView, ...]


@dataclass(frozen=True)
class SinkhornResult:
    """3D-Sinkhorn as published, from the cover's plain model."""

    stego: Sinkhorn3D
    control: tuple[Sinkhorn3D, ...]
    score: float  # composite score (KeySS, eq. 10)


@dataclass(frozen=True)
class ParametersResult:
    """Distances of the stego model's parameters from those of plain models."""

    sinkhorn: SinkhornResult
    distances: dict[str, AttributeDistance]
    two_sample: TwoSample


@dataclass(frozen=True)
class RendersResult:
    """StegExpose on renders."""

    views: tuple[str, ...]
    stego: StegExposeAuc  # the stego model against a control
    control: StegExposeAuc  # one control against another


@dataclass(frozen=True)
class LeaksResult:
    """What attacks without the key show of each secret."""

    secrets: tuple[tuple[AttackResult, ...], ...]


@dataclass(frozen=True)
class RobustnessResult:
    """What changes of the stego model cost."""

    changes: tuple[ChangeResult, ...]
    breakdown_points: tuple[BreakdownPoint, ...]


@dataclass(frozen=True, kw_only=True)
class Audit:
    """The result of an audit; parts that did not run are None."""

    version: int = 3
    keyss: str  # version of the program
    seconds: float
    run: AuditedRun
    controls: Controls
    wrong_key: WrongKeyResult | None = None
    images: ImagesResult | None = None
    parameters: ParametersResult | None = None
    stealth: StealthResult | None = None
    stegexpose: RendersResult | None = None
    leaks: LeaksResult | None = None
    robustness: RobustnessResult | None = None
    speed: SpeedResult | None = None


def read_audit(run: Path) -> Audit:
    """A run's audit. Raises InputError if it is missing, broken, too large or of another version."""
    path = run / AUDIT_FOLDER / AUDIT_FILE
    if not path.exists():
        run_folder(run)
        raise InputError(f"{path}: there is no audit; `keyss audit {run}` makes one")
    return read_record(path, Audit)
