"""The decoder D: maps the cover's Gaussians to a secret's.

`Decoder` is the paper's (KeySS, section 3.2 and appendix B); `LatentDecoder` is the design `latent`'s (ours),
with the encryption of its input.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from keyss.channels.harmonics import (
    RANKS,
    Harmonics,
    harmonics_above,
    high_harmonics,
    make_increasing,
    pads,
    row_ids,
)
from keyss.core.arrays import Bytes, Doubles, Flags, doubles
from keyss.core.errors import UsageError
from keyss.core.gaussians import Gaussians
from keyss.keys.derivation import expand
from keyss.methods.keyss.keyss_options import DecoderShape

FIELDS = {"op": "opacity_logits", "ro": "quats", "sc": "log_scales", "xyz": "means", "sh": "sh"}
DECODED_NUMBERS = 1 << 23  # maximum activations at a time: 32 MiB, even for untrusted files

# Of the design `latent`
OWN = 13  # latents without the code: opacity 1, rotation 3, log scales 3, position 3, constant colour 3
MAX_LATENTS = (24, 14)  # for one secret, for each of two: more cost the cover more than secrets gain
MIN_KEPT = 2  # directions that stay the cover's, and give the spread of a row
SHARE = 4  # a latent takes 1 / SHARE of the circle: a foreign row passes with probability SHARE ** -latents
GUARD = 1 / 256  # margin for rounding, at both ends of a latent's share
NONCE_BYTES = 16


class Decoder(nn.Module):
    """`decoder(cover, key)` returns D(G_cover, k) of equation 6 for the vector [key_size] of a key."""

    def __init__(self, shape: DecoderShape) -> None:
        super().__init__()
        self.shape = shape
        first, second = shape.hidden
        self.common = nn.Sequential(
            nn.Linear(shape.inputs, first), nn.ReLU(), nn.Linear(first, second), nn.ReLU()
        )
        self.branches = nn.ModuleDict(
            {
                each: nn.Sequential(
                    nn.Linear(second, shape.branch), nn.ReLU(), nn.Linear(shape.branch, shape.channels(each))
                )
                for each in shape.mask
            }
        )
        if shape.released:
            for layer in self.modules():
                if isinstance(layer, nn.Linear):
                    nn.init.kaiming_normal_(layer.weight, nonlinearity="relu")
                    nn.init.zeros_(layer.bias)

    def forward(self, cover: Gaussians, key: Tensor, whole: Gaussians | None = None) -> Gaussians:
        """Decode `cover`, which may be a part of `whole`."""
        features = [*self.normalize(cover, whole or cover), F.normalize(key, dim=0).expand(len(cover), -1)]
        h = self.common(torch.cat(features, dim=1))
        return self.add_residuals(cover, {name: branch(h) for name, branch in self.branches.items()})

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

    @torch.no_grad()
    def decode(self, stego: Gaussians, key: Tensor) -> Gaussians:
        """`forward` in parts, to bound memory."""
        shape = self.shape
        numbers = 4 * (shape.inputs + sum(shape.hidden) + len(shape.mask) * shape.branch)
        step = max(1, DECODED_NUMBERS // numbers)
        starts = range(0, max(1, len(stego)), step)
        return Gaussians.cat([self(stego[at : at + step], key, stego) for at in starts])


def latents_of(sh_degree: int, secrets: int) -> int:
    """D, the latents of each of `secrets`. Raises UsageError if a row cannot hold them."""
    count = min(MAX_LATENTS[min(secrets, 2) - 1], (harmonics_above(sh_degree) - MIN_KEPT) // secrets)
    if count < OWN:
        raise UsageError(
            f"SH degree {sh_degree} with {secrets} secrets: the harmonics of a Gaussian have no room for one "
            "of each; use a higher degree, fewer secrets, or `method='carry'`"
        )
    return count


class LatentDecoder(Decoder):
    """The linear decoder of one secret among those that share the rows.

    Every row of the published model is a Gaussian of the cover. Its harmonics hold the *latents* of a
    Gaussian of each secret (`keyss.channels.harmonics`): opacity, rotation, scale, position, constant colour,
    and a code that a trained basis expands to harmonics.

    Latents are encrypted by a stream cipher on real numbers: the rank of a latent, scaled to (0, 1/4), plus a
    pad in [0, 1) derived from the key and the row, modulo 1. The result is uniform for any latents. A row
    belongs to a key if all its latents decrypt to (0, 1/4): another key opens no row and shows the cover.
    """

    knots: Tensor  # [D, 33] quantiles of the secret's latents, at RANKS
    nonce: Tensor  # [16] bytes derived from the secret, so that pads are never reused

    def __init__(self, shape: DecoderShape) -> None:
        nn.Module.__init__(self)
        self.shape, count = shape, latents_of(shape.sh_degree, shape.secrets)
        if shape.secret >= shape.secrets:
            raise ValueError(f"secret {shape.secret} of {shape.secrets}")
        self.place = Harmonics(harmonics_above(shape.sh_degree), count * shape.secrets)
        self.basis = nn.Parameter(torch.zeros(count - OWN, 3 * ((shape.sh_degree + 1) ** 2 - 1)))
        self.register_buffer("knots", torch.linspace(-1, 1, len(RANKS)).repeat(count, 1))
        self.register_buffer("nonce", torch.zeros(NONCE_BYTES, dtype=torch.uint8))

    @property
    def own(self) -> slice:
        """The directions of this secret."""
        count = len(self.knots)
        return slice(self.shape.secret * count, (self.shape.secret + 1) * count)

    def forward(self, cover: Gaussians, key: Tensor, whole: Gaussians | None = None) -> Gaussians:
        """The secret's Gaussians in the rows that belong to `key`; `cover` itself if there are none."""
        ids, (ranks, alive) = row_ids(cover), self.place.read(high_harmonics(cover))
        latents, fits = self.decrypt(ranks[alive][:, self.own], key, ids[alive])
        if not fits.any():
            return cover
        _, first = np.unique(ids[alive][fits], axis=0, return_index=True)  # copies of a row count once
        return self.to_gaussians(torch.from_numpy(latents[np.sort(first)]).to(self.basis))

    @torch.no_grad()
    def decode(self, stego: Gaussians, key: Tensor) -> Gaussians:
        return self(stego, key)  # type: ignore[no-any-return]

    def fit_secret(self, latents: Doubles) -> None:
        """Learn the quantiles of latents [N, D], and a nonce that no other secret has."""
        for j, column in enumerate(latents.T):
            self.knots[j] = make_increasing(np.quantile(column, RANKS))
        digest = hashlib.sha256(np.ascontiguousarray(latents).tobytes()).digest()[:NONCE_BYTES]
        self.nonce.copy_(torch.frombuffer(bytearray(digest), dtype=torch.uint8))

    def encrypt(self, latents: Doubles, key: Tensor, ids: Bytes) -> Doubles:
        """[N, D] ranks in [0, 1) for latents [N, D] in rows with the `ids` [N, 16]."""
        knots = doubles(self.knots)
        ranks = np.stack([np.interp(*each, RANKS) for each in zip(latents.T, knots, strict=True)], axis=1)
        inside: Doubles = (GUARD + (1 - 2 * GUARD) * ranks) / SHARE
        return (inside + self._pads(key, ids)) % 1

    def decrypt(self, ranks: Doubles, key: Tensor, ids: Bytes) -> tuple[Doubles, Flags]:
        """[M, D] latents in the rows that belong to `key`, and [N] which rows these are."""
        inside = SHARE * ((ranks - self._pads(key, ids)) % 1)
        fits: Flags = np.all(inside <= 1, axis=1)
        own = ((inside[fits] - GUARD) / (1 - 2 * GUARD)).clip(0, 1)
        knots = doubles(self.knots)
        return np.stack([np.interp(x, RANKS, y) for x, y in zip(own.T, knots, strict=True)], axis=1), fits

    def _pads(self, key: Tensor, ids: Bytes) -> Doubles:
        seed = key.detach().cpu().numpy().astype("<f4").tobytes() + self.nonce.cpu().numpy().tobytes()
        return pads(expand(hashlib.sha256(seed).digest(), "latents", 32), ids, len(self.knots))

    def to_latents(self, model: Gaussians, colours: Tensor) -> Tensor:
        """[N, D] the latents of Gaussians whose harmonics are `self.colours(colours)`."""
        quats = F.normalize(model.quats, dim=1)
        rotation = quats[:, 1:] * torch.where(quats[:, :1] < 0, -1.0, 1.0)
        opacity = model.opacity_logits[:, None]
        return torch.cat([opacity, rotation, model.log_scales, model.means, colours], dim=1)

    def colours(self, rows: Tensor) -> Tensor:
        """[N, K, 3] harmonics of rows [N, 3 + C]: constant colours, and the code times the basis."""
        return Colours.apply(rows, self.basis, None)  # type: ignore[no-any-return,no-untyped-call]

    def to_gaussians(self, latents: Tensor) -> Gaussians:
        """The Gaussians of latents [N, D]."""
        opacity, rotation, scales, means, colours = latents.split([1, 3, 3, 3, 3 + len(self.basis)], dim=1)
        first = (1 - rotation.square().sum(1, keepdim=True)).clamp_min(0).sqrt()
        quats = torch.cat([first, rotation], dim=1)
        return Gaussians(means, quats, scales, opacity[:, 0], self.colours(colours))


class Colours(torch.autograd.Function):
    """[N, K, 3] harmonics of rows [N, W]: the first numbers unchanged, the others times `basis` [C, H].

    `noise` [N, H] is added to the product. Takes one pass; torch's own operations take four.
    """

    @staticmethod
    def forward(ctx: Any, rows: Tensor, basis: Tensor, noise: Tensor | None) -> Tensor:
        ctx.save_for_backward(rows, basis)
        first = rows.shape[1] - len(basis)
        sh = rows.new_empty(len(rows), first + basis.shape[1])
        sh[:, :first] = rows[:, :first]
        if noise is None:
            torch.mm(rows[:, first:], basis, out=sh[:, first:])
        else:
            torch.addmm(noise, rows[:, first:], basis, out=sh[:, first:])
        return sh.view(len(rows), -1, 3)

    @staticmethod
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor, Tensor | None, None]:
        rows, basis = ctx.saved_tensors
        first, upstream = rows.shape[1] - len(basis), upstream.reshape(len(rows), -1)
        gradient = torch.empty_like(rows)
        gradient[:, :first] = upstream[:, :first]
        torch.mm(upstream[:, first:], basis.T, out=gradient[:, first:])
        of_basis = rows[:, first:].T @ upstream[:, first:] if ctx.needs_input_grad[1] else None
        return gradient, of_basis, None


DECODERS: dict[str, type[Decoder]] = {"mlp": Decoder, "latent": LatentDecoder}  # keys: `DecoderShape.kind`
