"""Gaussians whose renders a network decodes to images."""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from keyss.core.gaussians import Gaussians

MAX_FEATURES = 32  # channels that rasterizers render at once
MAX_LAYERS, MAX_CHANNELS = 16, 256  # per network: bounds the memory for untrusted files
Layers = tuple[tuple[Tensor, Tensor], ...]  # weight [out, in, 3, 3] and bias [out] of each


@dataclass(frozen=True)
class PictureNetwork:
    """3x3 convolutions with ReLU between them, from renders [H, W, C] with zero padding to RGB images.

    Raises ValueError unless the layers fit together, from the channels of `background` to 3.
    """

    layers: Layers
    background: Tensor  # [C] behind all Gaussians in the renders

    def __post_init__(self) -> None:
        channels = len(self.background)
        if not 1 <= channels <= MAX_FEATURES or not 1 <= len(self.layers) <= MAX_LAYERS:
            raise ValueError(f"expected 1 to {MAX_FEATURES} channels and 1 to {MAX_LAYERS} layers")
        for weight, bias in self.layers:
            if weight.dim() != 4 or tuple(weight.shape[1:]) != (channels, 3, 3):
                raise ValueError(f"weight: expected [out, {channels}, 3, 3], got {list(weight.shape)}")
            channels = len(weight)
            if tuple(bias.shape) != (channels,) or not 1 <= channels <= MAX_CHANNELS:
                raise ValueError(
                    f"bias: expected [{channels}], {MAX_CHANNELS} at most, got {list(bias.shape)}"
                )
        if channels != 3:
            raise ValueError(f"layers: expected 3 channels from the last, got {channels}")

    def map(self, function: Callable[[Tensor], Tensor]) -> PictureNetwork:
        """The network with `function` applied to each tensor."""
        layers = tuple((function(weight), function(bias)) for weight, bias in self.layers)
        return PictureNetwork(layers, function(self.background))

    def tensors(self) -> dict[str, Tensor]:
        """The tensors by name: `background`, `layer.I.weight` and `layer.I.bias` of each layer I from 0."""
        tensors = {"background": self.background}
        for index, (weight, bias) in enumerate(self.layers):
            tensors |= {f"layer.{index}.weight": weight, f"layer.{index}.bias": bias}
        return tensors

    @staticmethod
    def of(tensors: Mapping[str, Tensor]) -> PictureNetwork:
        """The network of `tensors`. Raises ValueError and KeyError for others."""
        names = [(f"layer.{index}.weight", f"layer.{index}.bias") for index in range(len(tensors) // 2)]
        if unexpected := tensors.keys() - {"background", *itertools.chain(*names)}:
            raise ValueError(f"unexpected {', '.join(sorted(unexpected))}")
        background = tensors["background"]
        if background.dim() != 1:
            raise ValueError(f"background: expected [channels], got {list(background.shape)}")
        return PictureNetwork(tuple((tensors[one], tensors[two]) for one, two in names), background)


class DecodedGaussians(Gaussians):
    """Gaussians with a network, and optionally with feature channels in place of colours.

    Selecting, moving and transforming preserves the class; use `like` instead of `dataclasses.replace`.
    """

    __slots__ = ("features", "network")  # not in vars(), which are the tensors of every model

    features: Tensor | None  # [N, C]; None: the harmonics are rendered
    network: PictureNetwork

    @staticmethod
    def of(model: Gaussians, network: PictureNetwork, features: Tensor | None = None) -> DecodedGaussians:
        """`model` with a network. Raises ValueError for channels that do not fit."""
        shape = None if features is None else tuple(features.shape)
        channels = 3 if shape is None else len(network.background)
        if len(network.background) != channels or shape not in (None, (len(model), channels)):
            raise ValueError(f"features: expected [{len(model)}, {len(network.background)}], got {shape}")
        decoded = DecodedGaussians(model.means, model.quats, model.log_scales, model.opacity_logits, model.sh)
        object.__setattr__(decoded, "features", features)
        object.__setattr__(decoded, "network", network)
        return decoded

    def like(self, changed: Gaussians) -> Gaussians:
        return DecodedGaussians.of(changed, self.network, self.features)

    def map(self, function: Callable[[Tensor], Tensor]) -> Gaussians:
        features = None if self.features is None else function(self.features)
        return DecodedGaussians.of(super().map(function), self.network, features)

    def to(self, device: torch.device | str) -> Gaussians:
        moved = super().to(device)
        assert isinstance(moved, DecodedGaussians)
        return DecodedGaussians.of(moved, self.network.map(lambda tensor: tensor.to(device)), moved.features)

    def digest(self) -> str:
        state = hashlib.sha256(super().digest().encode())
        features = [] if self.features is None else [self.features]
        for tensor in (*features, self.network.background, *itertools.chain(*self.network.layers)):
            data = tensor.detach().cpu().contiguous().numpy().tobytes()
            state.update(f"{list(tensor.shape)}".encode() + data)
        return state.hexdigest()
