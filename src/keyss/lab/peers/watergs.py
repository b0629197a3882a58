"""Splats in Splats, also WaterGS (Guo et al. 2024): harmonics in the low bits of harmonics, mapped opacities.

Both scenes share positions, scales and rotations. The secret's harmonics are encrypted in the low bits of the
cover's, and a small convolutional autoencoder maps the cover's opacities to the secret's. The published file
is a 3DGS model; the autoencoder and the cipher's key are handed over, encrypted with the secret's key.

The paper does not specify the number of bits and when the autoencoder is trained. Here:

- Bits are graded by importance: the secret's constant coefficients get the most bits and degree 3 the fewest,
  and the most important bits are stored where they cost the cover least, in the lowest bits of its highest
  degrees.
- When growth stops, the Gaussians are sorted along a Morton curve, so that neighbours in the list are
  neighbours in space. The autoencoder is fitted to the secret's opacities and replaces them for the rest of
  the training, in which everything else adapts to it.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cache
from itertools import pairwise

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from keyss.core.arrays import Bits, Words32
from keyss.core.errors import InputError
from keyss.core.gaussians import Gaussians
from keyss.core.scene import Camera
from keyss.files.formats.common import morton_order
from keyss.fitting.parameters import make_optimizers, to_gaussians
from keyss.keys.derivation import stream
from keyss.lab.peers.method import HandedTensors, Peer, PeerTraining, Show
from keyss.lab.peers.options import WaterGsOptions
from keyss.methods.base import Capabilities
from keyss.methods.keyss.training import Picture

COVER_BITS = (8, 10, 12, 14)  # low bits in use by degree; a mantissa has 23
SECRET_BITS = (16, 13, 11, 10)  # bits per coefficient by degree, if all secrets fit
WIDTHS, KERNEL = (1, 16, 32, 16, 1), 9  # autoencoder: channels, and kernel size along the list of Gaussians
_FIT_STEPS = 200  # steps that fit the autoencoder to the secret's own opacities
_RANGE = 0.999  # coefficients above degree 0 are clipped at this quantile
_BLOCK = 1 << 14  # Gaussians per block
_CIPHER_BYTES = 32


def graded_bits(degree: int) -> tuple[int, ...]:
    """Maximum bits of a secret's coefficients by degree, in a model of SH `degree`."""
    room = sum((2 * each + 1) * COVER_BITS[each] for each in range(degree + 1))
    candidates = (
        [max(0, bits - less) for bits in SECRET_BITS[: degree + 1]] for less in range(SECRET_BITS[0])
    )
    return next(
        tuple(bits) for bits in candidates if sum((2 * i + 1) * n for i, n in enumerate(bits)) <= room
    )


@cache
def _places(degree: int) -> tuple[list[tuple[int, int]], list[tuple[int, int]]]:
    """(coefficient, bit) of the secret's bits, most important first, and of the cover's bits for them.

    The cover has more bits. Bit 0 is the lowest.
    """
    degrees = [math.isqrt(index) for index in range((degree + 1) ** 2)]
    sizes = graded_bits(degree)
    secret = [(index, bit) for index, each in enumerate(degrees) for bit in range(sizes[each])]
    # Importance: high bits first, then low degrees.
    secret.sort(key=lambda place: (sizes[degrees[place[0]]] - place[1], degrees[place[0]]))
    cover = [(index, bit) for index, each in enumerate(degrees) for bit in range(COVER_BITS[each])]
    cover.sort(key=lambda place: (place[1], -degrees[place[0]]))
    return secret, cover


def ranges_of(sh: Tensor) -> Tensor:
    """[degree + 1] magnitudes at which the coefficients of each degree are clipped."""
    found = []
    for degree in range(math.isqrt(sh.shape[1])):
        values = sh[:, degree**2 : (degree + 1) ** 2].abs().flatten().double().numpy()
        found.append(max(float(np.quantile(values, _RANGE if degree else 1)), 1e-6))
    return torch.tensor(found)


def write_bits(cover: Tensor, secret: Tensor, ranges: Tensor, cipher: bytes) -> Tensor:
    """Encrypt `secret` [N, K, 3] in the low bits of `cover` [N, K, 3], all of which become random."""
    degree = math.isqrt(cover.shape[1]) - 1
    sizes, (places, homes) = graded_bits(degree), _places(degree)
    words = cover.contiguous().numpy().view(np.uint32).copy()
    for block, bits in _blocks(len(cover), len(homes), cipher):
        codes = _codes(secret[block], ranges, sizes)
        for row, (index, bit) in enumerate(places):
            bits[:, row] ^= ((codes[:, index] >> np.uint32(bit)) & np.uint32(1)).astype(np.uint8)
        part = words[block]
        for row, (index, bit) in enumerate(homes):
            one = np.uint32(1 << bit)
            part[:, index] = (part[:, index] & ~one) | (bits[:, row].astype(np.uint32) << np.uint32(bit))
    return torch.from_numpy(words.view(np.float32))


def read_bits(stego: Tensor, ranges: Tensor, cipher: bytes) -> Tensor:
    """Decrypt the secret [N, K, 3] of `write_bits`, with quantised coefficients."""
    degree = math.isqrt(stego.shape[1]) - 1
    sizes, (places, homes) = graded_bits(degree), _places(degree)
    words = stego.contiguous().numpy().view(np.uint32)
    found = np.empty(words.shape, np.float32)
    for block, bits in _blocks(len(words), len(homes), cipher):
        part = words[block]
        codes = np.zeros(part.shape, np.uint32)
        for row, ((index, bit), (home, low)) in enumerate(zip(places, homes, strict=False)):
            value = ((part[:, home] >> np.uint32(low)) & np.uint32(1)) ^ bits[:, row]
            codes[:, index] |= value << np.uint32(bit)
        for index in range(stego.shape[1]):
            each = math.isqrt(index)
            step = 2 * float(ranges[each]) / max(1, 2 ** sizes[each] - 1)
            found[block, index] = codes[:, index] * step - float(ranges[each])
    return torch.from_numpy(found)


def _codes(secret: Tensor, ranges: Tensor, sizes: Sequence[int]) -> Words32:
    """[n, K, 3] coefficients as codes of `sizes` bits by degree."""
    codes = np.empty(secret.shape, np.uint32)
    for index in range(codes.shape[1]):
        degree = math.isqrt(index)
        share = (secret[:, index].double().numpy() / float(ranges[degree]) + 1) / 2
        codes[:, index] = np.rint(share.clip(0, 1) * (2 ** sizes[degree] - 1))
    return codes


def _blocks(count: int, places: int, cipher: bytes) -> Iterator[tuple[slice, Bits]]:
    """Slices of the Gaussians and their key streams, bits [n, places, 3]."""
    for number, start in enumerate(range(0, count, _BLOCK)):
        shape = (min(_BLOCK, count - start), places, 3)
        data = np.frombuffer(stream(cipher, f"watergs/{number}", -(-math.prod(shape) // 8)), np.uint8)
        yield slice(start, start + _BLOCK), np.unpackbits(data)[: math.prod(shape)].reshape(shape)


class OpacityMapping(torch.nn.Module):
    """From the cover's opacity logits [N] to the secret's, by convolution along the list."""

    def __init__(self) -> None:
        super().__init__()
        self.layers = torch.nn.ModuleList(
            torch.nn.Conv1d(a, b, KERNEL, padding=KERNEL // 2) for a, b in pairwise(WIDTHS)
        )

    def forward(self, logits: Tensor) -> Tensor:
        values = logits[None, None]
        for index, layer in enumerate(self.layers):
            values = layer(values if index == 0 else values.relu())
        return values[0, 0]


class WaterGsTraining(PeerTraining):
    """Training of two sets of harmonics and opacities; the second opacities become mapped ones."""

    def prepare(self, start: Gaussians) -> None:
        optimizer = make_optimizers(self.parameters, self.options.fit, self.extent)["sh"]
        self.add("secret_sh", start.sh.clone(), optimizer)
        self.add("secret_opacities", start.opacity_logits.clone(), self.options.fit.opacities_rate)
        self.mapping = OpacityMapping()
        self.networks.append(self.mapping)

    @property
    def is_mapped(self) -> bool:
        """True once the autoencoder has replaced free opacities."""
        return self.iteration >= int(self.strategy.refine_stop_iter)

    def step(self) -> None:
        before = self.is_mapped
        super().step()
        if self.is_mapped and not before:
            self._sort()
            self._fit_mapping()

    def opacity_for_pruning(self) -> Tensor:
        both = self.parameters["opacities"], self.parameters["secret_opacities"]
        return torch.maximum(*both).sigmoid()

    def draw(self, scenes: Sequence[int], camera: Camera, sh_degree: int) -> list[Picture]:
        pictures = []
        for scene in scenes:
            model = to_gaussians(self.parameters)
            if scene:
                free = self.parameters["secret_opacities"]
                logits = self.mapping(model.opacity_logits) if self.is_mapped else free
                model = replace(model, opacity_logits=logits, sh=self.parameters["secret_sh"])
            pictures.append(self.render(model, scene, camera, sh_degree))
        return pictures

    @torch.no_grad()
    def _sort(self) -> None:
        """Sort the Gaussians along a Morton curve; the autoencoder depends on their order."""
        means = self.parameters["means"]
        order = torch.from_numpy(morton_order(means.detach().cpu().numpy())).to(means.device)
        for name, parameter in self.parameters.items():
            for values in (parameter, *self.optimizers[name].state[parameter].values()):
                if isinstance(values, Tensor) and values.shape == parameter.shape:
                    values.copy_(values[order])

    def _fit_mapping(self) -> None:
        """Fit by cross entropy: squared errors have vanishing gradients for opacities near 0 or 1."""
        logits = self.parameters["opacities"].detach()
        target = self.parameters["secret_opacities"].detach().sigmoid()
        adam = torch.optim.Adam(self.mapping.parameters(), lr=5 * self.options.network_rate)
        for _ in range(_FIT_STEPS):
            adam.zero_grad()
            F.binary_cross_entropy_with_logits(self.mapping(logits), target).backward()
            adam.step()
        adam.zero_grad()

    def result(self) -> tuple[Gaussians, HandedTensors]:
        """Publish all Gaussians, because the autoencoder depends on their order."""
        cover = to_gaussians(self.parameters).detach().to("cpu")
        secret_sh = self.parameters["secret_sh"].detach().cpu()
        ranges, cipher = ranges_of(secret_sh), os.urandom(_CIPHER_BYTES)
        stego = replace(cover, sh=write_bits(cover.sh, secret_sh, ranges, cipher))
        tensors = {f"mapping.{name}": value for name, value in self.mapping.state_dict().items()}
        tensors |= {"ranges": ranges, "cipher": torch.tensor(list(cipher), dtype=torch.uint8)}
        return stego, HandedTensors(tensors, self.frame, rows=len(stego))


def _open(handed: HandedTensors) -> Show:
    mapping = OpacityMapping().requires_grad_(False)
    names = [f"mapping.{name}" for name in mapping.state_dict()]
    *weights, ranges, numbers = handed.take([*names, "ranges", "cipher"], of_bytes=["cipher"])
    mapping.load_state_dict(dict(zip(mapping.state_dict(), weights, strict=True)))
    if numbers.shape != (_CIPHER_BYTES,) or ranges.dim() != 1:
        raise ValueError("no such cipher")
    cipher = bytes(numbers.tolist())

    def show(stego: Gaussians) -> Gaussians:
        if stego.sh_degree != len(ranges) - 1:
            raise InputError(f"expected SH degree {len(ranges) - 1}, got {stego.sh_degree}")
        sh = read_bits(stego.sh, ranges, cipher)
        return replace(stego, opacity_logits=mapping(stego.opacity_logits), sh=sh)

    return show


METHOD = Peer(
    options=WaterGsOptions,
    capabilities=Capabilities(hands_over=True),
    open=_open,
    training=WaterGsTraining,
)
unpack = METHOD.unpack
