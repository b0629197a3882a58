"""The record of an audit, `audit/audit.json`, with a field for each part."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from keyss.core.errors import InputError
from keyss.fitting.image_metrics import ImageQuality
from keyss.lab.auc import Auc
from keyss.lab.distances import AttributeDistance
from keyss.lab.leaks.leak_scores import AttackResult
from keyss.lab.render_time import RenderTime
from keyss.lab.robustness.survival import ChangeResult
from keyss.lab.sinkhorn import Sinkhorn3D
from keyss.lab.stealth.judging import StealthResult
from keyss.lab.two_sample import TwoSampleAucs
from keyss.measure.hide_quality import WrongKeys
from keyss.runs.files import run_folder
from keyss.runs.folder import PRIVATE
from keyss.runs.json_records import read_record

AUDIT, PICTURES = f"{PRIVATE}/audit/audit.json", f"{PRIVATE}/audit/pictures"  # relative to the run


@dataclass(frozen=True)
class AuditedRun:
    """The audited run."""

    path: str
    method: str
    cover: str  # a scene folder, or a model without photos; `secrets` too
    secrets: tuple[str, ...]
    width: int | None  # pixels, if photos were shrunk
    gaussians: int  # Gaussians of the stego model
    standard: bool = True  # True if a 3DGS model is published


@dataclass(frozen=True)
class ImageComparison:
    """8-bit renders of a model against the test views."""

    views: dict[str, ImageQuality]  # by name
    mean: ImageQuality  # over the views


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
    pictures: dict[str, dict[str, str]]  # files of PICTURES by view and by model


@dataclass(frozen=True)
class ParametersResult:
    """Distances of the stego model's parameters from those of plain models."""

    sinkhorn: Sinkhorn3D  # published model against the cover's plain model
    sinkhorn_controls: tuple[Sinkhorn3D, ...]
    score: float  # composite score (KeySS, eq. 10)
    distances: dict[str, AttributeDistance]
    two_sample: TwoSampleAucs


@dataclass(frozen=True)
class StegExposeResult:
    """StegExpose on renders."""

    stego: Auc  # the stego model against a control
    control: Auc  # one control against another


@dataclass(frozen=True, kw_only=True)
class Audit:
    """The result of an audit; parts that did not run are None."""

    version: int = 5
    keyss: str  # version of the program
    seconds: float
    run: AuditedRun
    controls: tuple[int, ...]  # seeds of the plain models of the cover to compare with
    wrong_key: WrongKeys | None = None  # copied from the run's `metrics.json`, like the chance level
    chance_level: tuple[float, ...] = ()  # dB, the stego model against each secret's test views
    images: ImagesResult | None = None
    parameters: ParametersResult | None = None
    stealth: StealthResult | None = None
    stegexpose: StegExposeResult | None = None
    leaks: tuple[tuple[AttackResult, ...], ...] | None = None  # attacks on each secret
    robustness: tuple[ChangeResult, ...] | None = None
    speed: dict[str, RenderTime] | None = None


def read_audit(run: Path) -> Audit:
    """Read a run's audit. Raises InputError if it is missing, broken, too large or of another version."""
    path = run / AUDIT
    if not path.exists():
        run_folder(run)
        raise InputError(f"{path}: there is no audit; `keyss audit {run}` makes one")
    return read_record(path, Audit)
