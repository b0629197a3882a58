"""A run, and what its measures share: scenes, models, plain models of the cover."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property

import torch

from keyss.core.errors import InputError
from keyss.core.gaussians import Gaussians
from keyss.core.scene import Scene
from keyss.files.models import read_model
from keyss.fitting.config import FitConfig
from keyss.fitting.plain import fit_scene
from keyss.measure.hide_quality import in_cover
from keyss.methods import registry
from keyss.progress import Reporter
from keyss.runs.files import CONTROLS
from keyss.runs.folder import RunFolder
from keyss.runs.open_run import HidingRun
from keyss.runs.planning import view_seconds


@dataclass
class Subject:
    """A run, and data that its measures share; models on `device`."""

    run: HidingRun
    device: torch.device
    controls: Sequence[Gaussians] = ()  # plain models of the cover from other seeds

    @property
    def standard(self) -> bool:
        """True if the published file is a 3DGS model."""
        return registry.get(self.run.config.method).capabilities.standard

    @cached_property
    def scenes(self) -> list[Scene]:
        """The cover, then the secrets, each in its own frame."""
        return self.run.scenes()

    @cached_property
    def in_cover(self) -> list[Scene]:
        """The secrets with their test cameras in the cover's frame."""
        cover, *secrets = self.scenes
        return [in_cover(*pair, cover) for pair in zip(self.run.opened, secrets, strict=True)]

    @cached_property
    def stego(self) -> Gaussians:
        """The published model."""
        return self.run.stego.to(self.device)

    @cached_property
    def revealed(self) -> list[Gaussians]:
        """The secrets, in their own frames."""
        return [secret.reveal(self.stego).to(self.device) for secret in self.run.opened]

    @cached_property
    def original(self) -> Gaussians:
        """The plain model of the cover. Raises InputError without one."""
        plain, *_ = self.run.plain_models()
        if plain is None:
            raise InputError(f"{self.run.folder}: expected the plain model of the cover, found none")
        return plain.to(self.device)

    @cached_property
    def baselines(self) -> list[Gaussians | None]:
        """Plain models of the secrets; None for missing ones."""
        _, *models = self.run.baselines()
        return [None if model is None else model.to(self.device) for model in models]

    @property
    def shown(self) -> list[tuple[Scene, Gaussians, Gaussians | None]]:
        """The scene, the model and the plain model of the cover and of each secret."""
        models, plains = [self.stego, *self.revealed], [self.original, *self.baselines]
        return list(zip(self.scenes, models, plains, strict=True))

    @property
    def view_seconds(self) -> float:
        """About the seconds to measure the cover and the secrets on one test view each."""
        models = [self.stego, *self.revealed]
        pairs = zip(models, self.scenes, strict=True)
        return sum(view_seconds(self.device.type, len(model), scene) for model, scene in pairs)

    def fit_controls(self, seeds: Sequence[int], folder: RunFolder, reporter: Reporter) -> None:
        """Fit plain models of the cover with these seeds; they are kept in the run's `folder` for reuse.

        Raises InputError without a plain model of the cover.
        """
        config, count = self.run.config.options.fit, len(self.original)
        if self.run.config.models_given[0]:  # the run's maximum is not for this model
            config = replace(config, max_gaussians=max(count, 16))
        configs = [replace(config, seed=seed) for seed in seeds]
        self.controls = [self._fit_control(control, folder, reporter).to(self.device) for control in configs]

    def _fit_control(self, config: FitConfig, folder: RunFolder, reporter: Reporter) -> Gaussians:
        """Fit a plain model of the cover, or read it from the run's folder."""
        cover = self.scenes[0]
        inputs = json.dumps({"scene": cover.digest(), "config": asdict(config)}, sort_keys=True)
        name = f"seed-{config.known_seed}-{hashlib.sha256(inputs.encode()).hexdigest()[:12]}.ply"
        model = f"{CONTROLS}/{name}"
        if (folder.path / model).exists():
            return read_model(folder.path / model)
        checkpoint = folder.checkpoints / name.replace(".ply", ".safetensors")
        result = fit_scene(
            cover,
            config,
            device=self.device,
            title=f"plain model of the cover, seed {config.seed}",
            checkpoint=checkpoint,
            resume=True,
            reporter=reporter,
        )
        folder.keep("controls", model, result.gaussians)
        checkpoint.unlink(missing_ok=True)
        return result.gaussians
