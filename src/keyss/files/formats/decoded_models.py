"""Models with a decoder network, as safetensors: our own format, without executable content.

Tensors of single precision: `means` [N, 3], `quats` [N, 4], `log_scales` [N, 3], `opacity_logits` [N],
`sh` [N, K, 3]; `features` [N, C] if they replace the harmonics; `background` [C]; and of each layer I from 0:
`layer.I.weight` [out, in, 3, 3] and `layer.I.bias` [out].
"""

from __future__ import annotations

from dataclasses import fields

import safetensors
import safetensors.torch
import torch
from torch import Tensor

from keyss.core.errors import InputError, OutputError
from keyss.core.gaussians import Gaussians
from keyss.core.picture_network import DecodedGaussians, PictureNetwork
from keyss.files.formats.common import reason

FORMAT = "keyss-decoded/1"
_MAX_HEADER_BYTES = 1 << 17  # an empty tensor takes 20 times its header entry in memory

_NAMES = tuple(field.name for field in fields(Gaussians))


def write(model: DecodedGaussians) -> bytes:
    """The bytes of a file. Raises OutputError for a model that is empty or not finite."""
    tensors = {name: getattr(model, name) for name in _NAMES} | model.network.tensors()
    if model.features is not None:
        tensors["features"] = model.features
    kept = {name: tensor.detach().cpu().float().contiguous() for name, tensor in tensors.items()}
    if wrong := [name for name, tensor in kept.items() if not bool(tensor.isfinite().all())]:
        raise OutputError(f"NaN or infinite values in {', '.join(wrong)}")
    if not len(model):
        raise OutputError("it holds no Gaussians")
    return safetensors.torch.save(kept, {"format": FORMAT})


def read(data: bytes) -> Gaussians:
    """The model of `write`. Raises InputError."""
    try:
        return _of_tensors(load_tensors(data))
    except (safetensors.SafetensorError, ValueError, KeyError, IndexError, RuntimeError) as error:
        raise InputError(f"expected a model that a network decodes: {reason(error)}") from error


def load_tensors(data: bytes) -> dict[str, Tensor]:
    """The tensors of a safetensors file with a short header. Raises ValueError, and as the library does."""
    size = int.from_bytes(data[:8], "little")
    if size > _MAX_HEADER_BYTES:
        raise ValueError(f"a header of {size:,} bytes, more than the {_MAX_HEADER_BYTES:,} expected")
    return safetensors.torch.load(data)


def _of_tensors(tensors: dict[str, Tensor]) -> DecodedGaussians:
    for name, tensor in tensors.items():
        if tensor.dtype != torch.float32 or not tensor.isfinite().all():
            raise ValueError(f"{name}: expected finite numbers of single precision")
    model = Gaussians(*(tensors.pop(name) for name in _NAMES))
    features = tensors.pop("features", None)
    if len(model) == 0:
        raise ValueError("it holds no Gaussians")
    return DecodedGaussians.of(model, PictureNetwork.of(tensors), features)
