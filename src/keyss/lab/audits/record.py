"""The record of an audit, `audit/audit.json`, with a field for each part."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from keyss.core.errors import InputError
from keyss.lab.distances import AttributeDistance
from keyss.lab.leaks.leak_scores import AttackResult
from keyss.lab.robustness.survival import ChangeResult
from keyss.lab.sinkhorn import Sinkhorn3D
from keyss.lab.speed import SpeedResult
from keyss.lab.stealth.judging import StealthResult
from keyss.lab.stegexpose import StegExposeAuc
from keyss.lab.two_sample import TwoSampleAucs
from keyss.measure.hide_quality import WrongKeys
from keyss.measure.image_scores import ImageComparison
from keyss.runs.files import run_folder
from keyss.runs.folder import PRIVATE
from keyss.runs.json_records import read_record

AUDIT_FOLDER, AUDIT_FILE = f"{PRIVATE}/audit", "audit.json"  # folder relative to the run
PICTURES = "pictures"  # folder relative to the audit's


@dataclass(frozen=True)
class AuditedRun:
    """The audited run, and the versions that audited it."""

    path: str
    method: str
    cover: str  # a scene folder, or a model without photos; `secrets` too
    secrets: tuple[str, ...]
    width: int | None  # pixels, if photos were shrunk
    gaussians: int  # Gaussians of the stego model
    standard: bool = True  # True if a 3DGS model is published
    config: dict[str, Any] = field(default_factory=dict)
    versions: dict[str, str] = field(default_factory=dict)  # Python and libraries, by name


@dataclass(frozen=True)
class ModelImages:
    """The stego model or a revealed secret against the test views of its scene, beside a plain model."""

    scene: str  # "cover", "secret", or "secret N" of several
    photos: bool  # False: test views are renders of a given model
    images: ImageComparison
    gaussians: int
    baseline: ImageComparison | None  # plain model; None without one, like `baseline_gaussians`
    baseline_gaussians: int | None


@dataclass(frozen=True)
class ImagesResult:
    """Cover and secrets against the test views."""

    models: tuple[ModelImages, ...]  # cover, then secrets
    pictures: dict[str, dict[str, str]]  # files in the audit's folder by view and by model


@dataclass(frozen=True)
class ParametersResult:
    """Distances of the stego model's parameters from those of plain models."""

    sinkhorn: Sinkhorn3D  # published model against the cover's plain model
    sinkhorn_controls: tuple[Sinkhorn3D, ...]
    score: float  # composite score (KeySS, eq. 10)
    distances: dict[str, AttributeDistance]
    two_sample: TwoSampleAucs


@dataclass(frozen=True)
class RendersResult:
    """StegExpose on renders."""

    views: tuple[str, ...]
    stego: StegExposeAuc  # the stego model against a control
    control: StegExposeAuc  # one control against another


@dataclass(frozen=True, kw_only=True)
class Audit:
    """The result of an audit; parts that did not run are None."""

    version: int = 4
    keyss: str  # version of the program
    seconds: float
    run: AuditedRun
    controls: tuple[int, ...]  # seeds of the plain models of the cover to compare with
    wrong_key: WrongKeys | None = None  # copied from the run's `metrics.json`, like the chance level
    chance_level: tuple[float, ...] = ()  # dB, the stego model against each secret's test views
    images: ImagesResult | None = None
    parameters: ParametersResult | None = None
    stealth: StealthResult | None = None
    stegexpose: RendersResult | None = None
    leaks: tuple[tuple[AttackResult, ...], ...] | None = None  # attacks on each secret
    robustness: tuple[ChangeResult, ...] | None = None
    speed: SpeedResult | None = None


def read_audit(run: Path) -> Audit:
    """Read a run's audit. Raises InputError if it is missing, broken, too large or of another version."""
    path = run / AUDIT_FOLDER / AUDIT_FILE
    if not path.exists():
        run_folder(run)
        raise InputError(f"{path}: there is no audit; `keyss audit {run}` makes one")
    return read_record(path, Audit)
