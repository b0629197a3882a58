"""What the peers that train have in common as methods: one secret, one training, one file handed over."""

from __future__ import annotations

import json
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import torch

from keyss.channels.base import Content
from keyss.core.alignment import align
from keyss.core.decoded import PictureNetwork
from keyss.core.gaussians import Gaussians
from keyss.core.similarity import Similarity
from keyss.fitting.loop import train
from keyss.methods.base import Capabilities, Context, KeyedSource, Outlook, SceneInput, Source, Stego
from keyss.methods.peers.options import PeerOptions
from keyss.methods.peers.payload import HandedSecret, HandedTensors
from keyss.methods.peers.training import PeerRun
from keyss.methods.poses import PlacedScene


class JointPeer(ABC):
    """See `keyss.methods.base.Method`."""

    name: str
    summary: str
    capabilities: Capabilities
    trains = True
    most_secrets = 1
    options: type[PeerOptions]
    presets: Mapping[str, PeerOptions]
    networks: tuple[PictureNetwork | None, ...] = ()  # see `Outlook`

    @abstractmethod
    def begin(self, scenes: Sequence[PlacedScene], options: PeerOptions, device: torch.device) -> PeerRun:
        """The training, not begun."""

    @abstractmethod
    def publish(self, run: Any, frame: Similarity) -> tuple[Gaussians, HandedTensors]:
        """What a finished training gives: the published model, on the CPU, and what is handed over."""

    @abstractmethod
    def open(self, handed: HandedTensors) -> HandedSecret:
        """The secret in what was handed over. Raises InputError for damage."""

    def prepare(self, inputs: Sequence[SceneInput], options: PeerOptions) -> PeerOptions:
        """All scenes will do."""
        return options

    def outlook(self, inputs: Sequence[SceneInput], options: PeerOptions) -> Outlook:
        """As many Gaussians as a plain model has show both scenes."""
        fit = options.fit
        most = fit.max_gaussians
        drawn = (most, most)
        return Outlook(most, fit.sh_degree, most, most, fit.iterations, drawn, networks=self.networks)

    def hide(
        self, cover: Source, secrets: Sequence[KeyedSource], options: PeerOptions, context: Context
    ) -> Stego:
        """Train both scenes together. Raises Interrupted, and InputError for another run's checkpoint."""
        scenes = [cover.scene, secrets[0].source.scene]
        models = [cover.model, secrets[0].source.model]
        cameras = [[view.camera for view in scene.train] for scene in scenes]
        frames = [Similarity.identity(), align(cameras[1], cameras[0])]
        placed = [PlacedScene.of(*parts) for parts in zip(scenes, models, frames, strict=True)]
        run = self.begin(placed, options, context.device)
        fit = options.fit
        seconds = train(
            run,
            f"hide, {self.name}",
            fingerprint={
                "method": self.name,
                "scenes": [scene.digest() for scene in scenes],
                "models": [model.digest() for model in models],
                "options": json.loads(json.dumps(asdict(options))),
            },
            seed=fit.known_seed,
            checkpoint=context.checkpoints / "joint.safetensors" if context.checkpoints else None,
            resume=context.resume,
            checkpoint_seconds=fit.checkpoint_seconds,
            evaluate_every=fit.evaluate_every,
            reporter=context.reporter,
        )
        stego, handed = self.publish(run, frames[1])
        payload = handed.payload(self.name)
        return Stego(stego, (self.unpack(payload),), seconds, fit.iterations, handed=(payload,))

    def unpack(self, content: Content) -> HandedSecret:
        """See `open`."""
        return self.open(HandedTensors.of(content))
