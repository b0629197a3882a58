"""The input of an audit: a run opened with its keys, and plain models to compare it with."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import torch

from keyss.core.errors import UsageError
from keyss.core.gaussians import Gaussians
from keyss.core.scene import Scene
from keyss.files.models import read_model
from keyss.fitting.config import FitConfig
from keyss.fitting.plain import fit_scene
from keyss.measure.hiding import in_cover
from keyss.progress import Reporter
from keyss.runs.files import CONTROLS
from keyss.runs.folder import RunFolder
from keyss.runs.opening import HidingRun
from keyss.runs.sources import as_model


@dataclass(frozen=True)
class AuditSubject:
    """The input of the parts of an audit; models on `device`."""

    run: HidingRun
    scenes: tuple[Scene, ...]  # the cover, then the secrets, each in its own frame
    in_cover: tuple[Scene, ...]  # the secrets with their test cameras in the cover's frame
    stego: Gaussians
    revealed: tuple[Gaussians, ...]  # the secrets, in their own frames
    original: Gaussians  # plain model of the cover
    baselines: tuple[Gaussians | None, ...]  # plain models of the secrets, if there are any
    controls: tuple[Gaussians, ...]  # plain models of the cover from other seeds
    seeds: tuple[int, ...]  # of the controls
    device: torch.device


def subject_of(
    run: HidingRun,
    original: Path | str | None,
    controls: int,
    seed: int,
    device: torch.device,
    reporter: Reporter,
    folder: RunFolder,
) -> AuditSubject:
    """Read, reveal and fit what the audit needs; plain models are kept in the run's `folder` for reuse.

    `original`: a plain model of the cover, by default the run's own. `controls`: how many to train, from
    seeds derived from the run's own and `seed`. Raises UsageError without a plain model of the cover.
    """
    scenes = run.scenes()
    plain, *_ = run.plain_models()
    _, *baselines = run.baselines()
    if original is not None:
        plain = as_model(original)
    if plain is None:
        raise UsageError(f"{run.folder} has no plain model of the cover to compare with: give `original`")
    stego = run.stego.to(device)
    config = run.config.options.fit
    if original is not None or run.config.models_given[0]:  # its size is not the run's
        config = replace(config, max_gaussians=max(len(plain), 16))
    seeds = tuple(run.config.options.fit.seed_of(f"control {seed + index}") for index in range(controls))
    return AuditSubject(
        run=run,
        scenes=tuple(scenes),
        in_cover=tuple(in_cover(*pair, scenes[0]) for pair in zip(run.opened, scenes[1:], strict=True)),
        stego=stego,
        revealed=tuple(secret.reveal(stego).to(device) for secret in run.opened),
        original=plain.to(device),
        baselines=tuple(None if model is None else model.to(device) for model in baselines),
        controls=tuple(
            _plain_model(scenes[0], replace(config, seed=own), folder, device, reporter).to(device)
            for own in seeds
        ),
        seeds=seeds,
        device=device,
    )


def _plain_model(
    scene: Scene, config: FitConfig, folder: RunFolder, device: torch.device, reporter: Reporter
) -> Gaussians:
    """A plain model of a scene, from the run's folder if it was fitted there before."""
    made_of = json.dumps({"scene": scene.digest(), "config": asdict(config)}, sort_keys=True)
    name = f"seed-{config.seed}-{hashlib.sha256(made_of.encode()).hexdigest()[:12]}"
    model = f"{CONTROLS}/{name}.ply"
    if (folder.path / model).exists():
        return read_model(folder.path / model)
    checkpoint = folder.checkpoints / f"{name}.safetensors"
    result = fit_scene(
        scene,
        config,
        device=device,
        title=f"plain model of the cover, seed {config.seed}",
        checkpoint=checkpoint,
        resume=True,
        reporter=reporter,
    )
    folder.keep("controls", model, result.gaussians)
    checkpoint.unlink(missing_ok=True)
    return result.gaussians
