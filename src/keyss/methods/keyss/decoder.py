"""The decoder D of equation 6, from the cover and a key to a secret (section 3.2, appendix B)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from keyss.core.gaussians import Gaussians
from keyss.methods.keyss.keyss_options import DecoderShape

FIELDS = {"op": "opacity_logits", "ro": "quats", "sc": "log_scales", "xyz": "means", "sh": "sh"}
ROWS = 1024  # Gaussians decoded at a time, whose activations fit in a processor's cache
LAYERS = 4  # of the decoder


class Decoder(nn.Module):
    """`decoder(cover, key)` returns D(G_cover, k) of equation 6 for the vector [key_size] of a key."""

    def __init__(self, shape: DecoderShape) -> None:
        super().__init__()
        self.shape = shape
        first, second = shape.hidden
        self.common = nn.ModuleList([nn.Linear(shape.inputs, first), nn.Linear(first, second)])
        self.inner = nn.ModuleDict({name: nn.Linear(second, shape.branch) for name in shape.mask})
        self.outer = nn.ModuleDict(
            {name: nn.Linear(shape.branch, shape.channels(name)) for name in shape.mask}
        )
        for layer in linear(self.modules()) if shape.released else ():
            nn.init.kaiming_normal_(layer.weight, nonlinearity="relu")
            nn.init.zeros_(layer.bias)
        for layer in () if shape.released else linear(self.outer.values()):  # residuals start at 0
            nn.init.zeros_(layer.weight)
            nn.init.zeros_(layer.bias)

    def forward(self, cover: Gaussians, key: Tensor, whole: Gaussians | None = None) -> Gaussians:
        """Decode `cover`, which may be a part of `whole`."""
        inputs = torch.cat(self.normalize(cover, whole or cover), dim=1)
        residuals = Mlp.apply(inputs, *self.layers(key))  # type: ignore[no-untyped-call]
        sizes = [self.shape.channels(name) for name in self.shape.mask]
        return self.add_residuals(cover, dict(zip(self.shape.mask, residuals.split(sizes, 1), strict=True)))

    def layers(self, key: Tensor) -> list[Tensor]:
        """Weights and biases of four layers that equal the common branch and all others side by side.

        The key k is one input of all Gaussians: its part of the first layer is added to the bias.
        """
        first, second = linear(self.common)
        inner, outer = linear(self.inner.values()), linear(self.outer.values())
        weights, of_key = first.weight.split([self.shape.inputs - len(key), len(key)], dim=1)
        return [
            *(weights, first.bias + of_key @ F.normalize(key, dim=0)),
            *(second.weight, second.bias),
            *(torch.cat([layer.weight for layer in inner]), torch.cat([layer.bias for layer in inner])),
            *(
                torch.block_diag(*(layer.weight for layer in outer)),
                torch.cat([layer.bias for layer in outer]),
            ),
        ]

    def normalize(self, cover: Gaussians, whole: Gaussians) -> list[Tensor]:
        """alpha, r, s, mu and c of section 3.2, each divided by its length ("L2-normalized", appendix B).

        The opacity is a single number, so normalising would leave only its sign: alpha in (0, 1) is not
        normalised. The authors' program divides raw opacities by the norm of all of them.
        """
        alpha = cover.opacities
        if self.shape.released:
            alpha = cover.opacity_logits / whole.opacity_logits.norm()
        others = (cover.quats, cover.log_scales, cover.means, cover.sh.flatten(1))
        return [alpha[:, None], *(F.normalize(values, dim=1) for values in others)]

    def add_residuals(self, cover: Gaussians, residuals: Mapping[str, Tensor]) -> Gaussians:
        """attribute* = attribute + theta . residual (equation 8), on raw attributes.

        In the authors' program, all residuals but the opacity's are clamped at 0.
        """
        changed = {}
        for name, residual in residuals.items():
            before: Tensor = getattr(cover, FIELDS[name])
            one_sided = self.shape.released and name != "op"
            changed[FIELDS[name]] = before + (F.relu(residual) if one_sided else residual).view_as(before)
        return replace(cover, **changed)


def linear(modules: Iterable[nn.Module]) -> list[nn.Linear]:
    """The linear layers among `modules`."""
    return [module for module in modules if isinstance(module, nn.Linear)]


class Mlp(torch.autograd.Function):
    """[N, C] an MLP of inputs [N, I]: linear layers (weight, bias, weight, bias, ...) with ReLU between them.

    It works on few rows at a time and keeps no activations. Backward computes those of the rows that have a
    gradient once more: a view sees only a part of the Gaussians.
    """

    @staticmethod
    def forward(ctx: Any, inputs: Tensor, *layers: Tensor) -> Tensor:
        ctx.save_for_backward(inputs, *layers)
        return torch.cat([activations(rows, layers)[-1] for rows in inputs.split(ROWS)])

    @staticmethod
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor, ...]:
        inputs, *layers = ctx.saved_tensors
        of_inputs, of_layers = torch.zeros_like(inputs), [torch.zeros_like(layer) for layer in layers]
        for rows in upstream.any(1).nonzero()[:, 0].split(ROWS):
            gradient, values = upstream[rows], activations(inputs[rows], layers[:-2])
            for index, value in reversed(list(enumerate(values))):
                of_layers[2 * index].addmm_(gradient.T, value)
                of_layers[2 * index + 1] += gradient.sum(0)
                gradient = gradient @ layers[2 * index]
                if index:
                    gradient *= value > 0
            of_inputs[rows] = gradient
        return of_inputs, *of_layers


def activations(rows: Tensor, layers: Sequence[Tensor]) -> list[Tensor]:
    """The inputs of an MLP, and the results of its layers; without ReLU after the last of all four."""
    values = [rows]
    for weight, bias in zip(layers[::2], layers[1::2], strict=True):
        values.append(torch.addmm(bias, values[-1], weight.T))
        if len(values) <= LAYERS:
            values[-1].relu_()
    return values
