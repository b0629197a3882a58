"""Tensors with a JSON header as bytes: a safetensors file with the header as its only metadata entry."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TypeVar

import msgspec
import safetensors
import safetensors.torch
import torch
from torch import Tensor

from keyss.core.errors import InputError, UsageError, of_other_version
from keyss.files.formats.decoded_models import load_tensors

_ENTRY = "keyss"
# Errors from damaged headers and tensors.
_LIBRARY_ERRORS = (safetensors.SafetensorError, msgspec.MsgspecError)
_DAMAGE = (*_LIBRARY_ERRORS, KeyError, TypeError, ValueError, OverflowError, RuntimeError, UsageError)


@dataclass(frozen=True)
class Header:
    """The fields that all headers share."""

    format: str
    version: int


HeaderT = TypeVar("HeaderT", bound=Header)


def pack_tensors(tensors: Mapping[str, Tensor], header: Header) -> bytes:
    """Serialise tensors and a header deterministically."""
    kept = {name: value.detach().cpu().contiguous() for name, value in tensors.items()}
    return safetensors.torch.save(kept, {_ENTRY: _encode_header(header).decode()})


def unpack_tensors(
    data: bytes, kind: type[HeaderT], format: str, version: int
) -> tuple[HeaderT, dict[str, Tensor]]:
    """Invert `pack_tensors`; requires finite tensors. Call it within `refuse_damage`.

    `kind`: the header's class, with types and bounds. Raises InputError for another version.
    """
    tensors = load_tensors(data)
    size = int.from_bytes(data[:8], "little")
    outer = msgspec.json.decode(data[8 : 8 + size], type=dict[str, msgspec.Raw])
    text = msgspec.json.decode(outer["__metadata__"], type=dict[str, str])[_ENTRY].encode()
    declared = msgspec.json.decode(text, type=Header)
    if declared.format != format:
        raise ValueError(f"format {declared.format[:40]!r}")
    if declared.version != version:
        raise InputError(of_other_version(declared.version, version))
    # msgspec needs the hook for the tensors of a `Similarity`.
    header = msgspec.json.decode(
        text, type=kind, dec_hook=lambda _, numbers: torch.tensor(numbers, dtype=torch.float64)
    )
    if _encode_header(header) != text:
        raise ValueError("its header has unexpected fields")
    if not all(value.isfinite().all() for value in tensors.values()):
        raise ValueError("expected finite numbers")
    return header, tensors


def _encode_header(header: Header) -> bytes:
    return msgspec.json.encode(header, enc_hook=Tensor.tolist)


@contextmanager
def refuse_damage(what: str) -> Iterator[None]:
    """Turn errors from reading damaged bytes into an InputError that begins with `what`."""
    try:
        yield
    except _DAMAGE as error:
        reason = (str(error) or type(error).__name__).splitlines()[0][:200]
        raise InputError(f"{what}: {reason}") from error
