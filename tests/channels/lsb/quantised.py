"""Codes of models as trained, in every format that can carry, and files of them."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import torch

from channels.lsb.trained_like import trained_like
from keyss.channels import Payload, QuantisedCover, QuantisedReader, in_counted_order, last_bits
from keyss.core import Gaussians, WrongKeyError
from keyss.core.arrays import Bits
from keyss.files.formats.common import in_morton_order
from keyss.files.formats.compressed_ply import CompressedPlyCodes
from keyss.files.formats.sog import SogCodes
from keyss.files.formats.spz import SpzCodes

FORMATS = {".spz": SpzCodes, ".sog": SogCodes, ".compressed.ply": CompressedPlyCodes}


@cache
def model_of(count: int = 6000, seed: int = 0, sh_degree: int = 1) -> Gaussians:
    """In the order of the formats that sort."""
    model = trained_like(count, seed, sh_degree)
    generator = torch.Generator().manual_seed(seed)
    # As in trained models: few of nearly no opacity, and colours that reach to black and white.
    opacity_logits = model.opacity_logits.clamp_min(-4.0) + 0.1 * torch.rand(count, generator=generator)
    sh = torch.cat([8 * model.sh[:, :1], model.sh[:, 1:]], dim=1)
    return in_morton_order(replace(model, opacity_logits=opacity_logits, sh=sh))


def codes_of(suffix: str, count: int = 6000, seed: int = 0, sh_degree: int = 1) -> Any:
    model = model_of(count, seed, sh_degree)
    if suffix == ".spz":  # in no order, as after training
        model = model[torch.randperm(count, generator=torch.Generator().manual_seed(seed))]
    return FORMATS[suffix].quantise(model)


def written(cover: QuantisedCover, *payloads: bytes, entropy: bytes = bytes(range(32))) -> Any:
    """The codes with payloads under the keys "0", "1" and so on."""
    secrets = [(str(index), Payload("carry", data)) for index, data in enumerate(payloads)]
    return cover.embed(secrets, entropy=entropy).codes


def opened(codes: Any, key: str = "0") -> bytes:
    """What a key opens in codes. Raises WrongKeyError and InputError."""
    reader = QuantisedReader.of(codes)
    if reader is None:
        raise WrongKeyError("no room")
    return reader.open(key).data


def bits_of(codes: Any) -> Bits:
    """The last bits of all levels, in the order in which they are counted."""
    return last_bits(in_counted_order(codes)[2])


def there_and_back(suffix: str, codes: Any) -> Any:
    """Codes as they come out of a file."""
    return FORMATS[suffix].parse(codes.serialise())
