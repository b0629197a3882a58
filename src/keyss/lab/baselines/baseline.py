"""The common part of the baselines: one secret, one joint training, one companion file."""

from __future__ import annotations

import hashlib
from abc import abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from keyss.channels import Payload
from keyss.core.errors import InputError, UsageError
from keyss.core.gaussians import Gaussians
from keyss.core.scene import Camera
from keyss.core.similarity import Similarity
from keyss.fitting.adam import RowAdam
from keyss.lab.baselines.baseline_options import BaselineOptions
from keyss.methods.hidden import Frame, HiddenScene
from keyss.methods.keyss.training import KeyssTraining, Picture
from keyss.methods.method import Capabilities, Context, Prepared, Source, Stego
from keyss.methods.placed_scene import PlacedScene
from keyss.methods.tensors import Header, pack_tensors, refuse_damage, unpack_tensors

FORMAT, VERSION = "keyss-baseline", 1
DAMAGED = "the companion file is damaged"


@dataclass(frozen=True)
class _Header(Header):
    rows: int | None
    frame: Similarity | None


@dataclass(frozen=True)
class CompanionTensors:
    """Tensors of a companion file, and the placement of the secret in the cover's frame."""

    tensors: Mapping[str, Tensor]  # float32
    frame: Similarity | None = None  # secret frame to cover frame; None: never placed there
    rows: int | None = None  # Gaussians of the published model, if their order matters

    def payload(self, method: str) -> Payload:
        """The companion file; `method`: name of the method."""
        header = _Header(FORMAT, VERSION, self.rows, self.frame)
        return Payload(method, pack_tensors(self.tensors, header))

    @staticmethod
    def of(payload: Payload) -> CompanionTensors:
        """Read a payload. Raises InputError for other data."""
        with refuse_damage(DAMAGED):
            header, tensors = unpack_tensors(payload.data, _Header, FORMAT, VERSION)
            if any(tensor.dtype != torch.float32 for tensor in tensors.values()):
                raise ValueError("expected numbers of single precision")
        return CompanionTensors(tensors, header.frame, header.rows)

    def take(self, names: Iterable[str]) -> list[Tensor]:
        """The tensors of these names. Raises InputError for others, and for missing ones."""
        expected = list(names)
        if set(expected) != self.tensors.keys():
            present = ", ".join(sorted(self.tensors))[:200]
            raise InputError(f"{DAMAGED}: expected {', '.join(expected)}, found {present}")
        return [self.tensors[name] for name in expected]


Show = Callable[[Gaussians], Gaussians]  # takes a model on the CPU in the cover's frame; raises ValueError


@dataclass(frozen=True)
class CompanionSecret(HiddenScene):
    """A companion file applied to the published model."""

    frame: Similarity | None
    companion: CompanionTensors
    show: Show

    def reveal(self, stego: Gaussians, *, frame: Frame = "secret") -> Gaussians:
        """See `HiddenScene.reveal`; raises InputError for a model with other Gaussians."""
        rows = self.companion.rows
        if rows is not None and len(stego) != rows:
            raise InputError(
                f"expected the {rows:,} Gaussians that were published, in their order, got {len(stego):,}: "
                "each row of the companion file belongs to one of them"
            )
        if frame == "cover" and self.frame is None:
            raise UsageError('this secret never was in the cover\'s frame: leave out `frame="cover"`')
        with refuse_damage("the companion file does not fit"):
            shown = self.show(stego.detach().to("cpu"))
        if self.frame is None or frame == "cover":
            return shown
        return self.frame.inverse().apply_gaussians(shown)

    def fingerprint(self) -> str:
        return hashlib.sha256(self.companion.payload("baseline").data).hexdigest()[:16]


class BaselineTraining(KeyssTraining):
    """The joint training of a baseline: `prepare` adds parameters and networks, `draw` renders scenes."""

    options: BaselineOptions

    @abstractmethod
    def prepare(self, start: Gaussians) -> None:
        """Add parameters (`add`) and networks (`networks`); their random numbers are the run's own."""

    @abstractmethod
    def draw(self, scenes: Sequence[int], camera: Camera, sh_degree: int) -> list[Picture]:
        """Render scenes in the given order; they may share a render."""

    @abstractmethod
    def result(self) -> tuple[Gaussians, CompanionTensors]:
        """The published model, on the CPU, and the tensors of the companion file, after the training."""

    def add(self, name: str, values: Tensor, rate: float, scale: Tensor | None = None) -> None:
        """Add a parameter [N, ...] of the Gaussians; its rates: see `RowAdam`."""
        self.parameters[name] = parameter = torch.nn.Parameter(values.to(self.device).contiguous())
        self.optimizers[name] = RowAdam(parameter, rate, scale)

    def opacity_for_pruning(self) -> Tensor:
        """[N] maximum opacity over the scenes."""
        return self.parameters["opacities"].detach().sigmoid()

    def visible(self) -> Tensor:
        """[N] True for Gaussians above the opacity limit of pruning; all True if none is."""
        visible = self.opacity_for_pruning() >= self.options.fit.prune_opacity
        return visible if bool(visible.any()) else torch.ones_like(visible)


@dataclass(frozen=True)
class Baseline:
    """A `Method` with a joint training, one secret and one companion file."""

    options: type[BaselineOptions]
    capabilities: Capabilities
    open: Callable[[CompanionTensors], Show]  # raises InputError and ValueError for damage
    training: type[BaselineTraining] | None = None  # None: a subclass overrides `hide`
    max_secrets: int = 1

    @property
    def name(self) -> str:
        return self.options.method

    def prepare(
        self, sources: Sequence[Source], options: BaselineOptions, earlier: Prepared | None = None
    ) -> Prepared:
        """Accept all scenes; both share the Gaussians of one model."""
        return Prepared.of(options, len(sources), options.joint_plan(1))

    def hide(self, sources: Sequence[Source], prepared: Prepared, context: Context) -> Stego:
        """Train both scenes jointly. Raises Interrupted, and InputError for another run's checkpoint."""
        training, options = self.training, prepared.options
        assert training is not None
        run = training(PlacedScene.all_of(sources), [], options, context.device)
        run.train(sources, context)
        return self.stego(*run.result(), run.iterations)

    def stego(self, published: Gaussians, companion: CompanionTensors, iterations: int = 0) -> Stego:
        """The result of hiding, opened from the companion payload."""
        payload = companion.payload(self.name)
        return Stego(published, (self.unpack(payload),), iterations, companions=(payload,))

    def unpack(self, payload: Payload) -> CompanionSecret:
        """The secret of a companion file. Raises InputError for damage."""
        companion = CompanionTensors.of(payload)
        with refuse_damage(DAMAGED):
            return CompanionSecret(companion.frame, companion, self.open(companion))
