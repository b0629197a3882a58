"""Serialisation of secrets, damaged payloads, and rounded or pruned models."""

from __future__ import annotations

import contextlib
import json
import struct
from dataclasses import asdict, replace

import pytest
import torch
from hypothesis import given, settings, strategies as st

from channels.lsb.trained_like import trained_like
from keyss.channels import Payload
from keyss.core import InputError
from keyss.core.similarity import Similarity
from keyss.methods import Decoder, DecoderShape, KeyssSecret, choose_anchors
from methods.keyss.small import VECTORS, make_secret
from tiny_scenes import random_gaussians

FRAME = Similarity(2.0, torch.eye(3, dtype=torch.float64), torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64))


def _secret() -> KeyssSecret:
    torch.manual_seed(0)
    decoder = Decoder(DecoderShape(hidden=(16, 16), branch=8)).requires_grad_(False)
    return KeyssSecret(decoder, VECTORS[0], FRAME, choose_anchors(random_gaussians(), 0), 100)


def _unpack(data: bytes) -> KeyssSecret:
    return KeyssSecret.of(Payload("keyss", data))


PACKED = _secret().payload().data
FRAME_JSON = {
    "scale": FRAME.scale,
    "rotation": FRAME.rotation.tolist(),
    "translation": FRAME.translation.tolist(),
}
SHAPE = asdict(_secret().decoder.shape)


def _with_header(**changes: object) -> bytes:
    """Replace fields of the JSON header."""
    (size,) = struct.unpack("<Q", PACKED[:8])
    outer = json.loads(PACKED[8 : 8 + size])
    inner = json.loads(outer["__metadata__"]["keyss"])
    inner.update(changes)
    outer["__metadata__"]["keyss"] = json.dumps(inner)
    header = json.dumps(outer).encode()
    header += b" " * (-len(header) % 8)
    return struct.pack("<Q", len(header)) + header + PACKED[8 + size :]


def test_round_trip() -> None:
    secret = _secret()
    packed = secret.payload().data
    opened = _unpack(packed)
    assert opened.decoder.shape == secret.decoder.shape
    assert torch.equal(opened.key, secret.key)
    assert opened.count == 100
    assert opened.frame.scale == FRAME.scale
    assert torch.equal(opened.frame.rotation, FRAME.rotation)
    assert torch.equal(opened.frame.translation, FRAME.translation)
    assert torch.equal(opened.anchors, secret.anchors)
    for name, value in secret.decoder.state_dict().items():
        assert torch.equal(opened.decoder.state_dict()[name], value.half().float()), name
    assert opened.payload().data == packed


def test_unknown_version() -> None:
    with pytest.raises(InputError, match=r"version 2.*version 1: update keyss"):
        _unpack(_with_header(version=2))


@pytest.mark.parametrize(
    "changes",
    [
        {"format": "other"},
        {"shape": None},
        {"shape": SHAPE | {"hidden": [10**9, 16]}},
        {"shape": SHAPE | {"hidden": [16]}},
        {"shape": SHAPE | {"key_size": 63}},
        {"shape": SHAPE | {"mask": ["op"]}},  # fewer branches than weights
        {"shape": SHAPE | {"hidden": [4096, 4096], "branch": 4096}},  # half a gigabyte of weights
        {"count": -1},
        {"count": 2**40},
        {"frame": 3},
        {"frame": {"scale": 1.0}},
        *(
            {"frame": FRAME_JSON | change}
            for change in (
                {"scale": -1.0},
                {"scale": 10**400},
                {"translation": [0.0, 0.0]},
                {"rotation": [[1, 0, 0], [0, 1, 0]]},
                {"rotation": [[1, 0, 0], [0, 1, 0], [0, 0, -1]]},
                {"unknown": 1},
            )
        ),
    ],
)
def test_hostile_headers(changes: dict[str, object]) -> None:
    with pytest.raises(InputError):
        _unpack(_with_header(**changes))


@settings(max_examples=60, deadline=None)
@given(st.integers(0, len(PACKED) - 1), st.integers(0, 7), st.integers(0, len(PACKED)))
def test_damaged_bytes(at: int, bit: int, size: int) -> None:
    broken = bytearray(PACKED)
    broken[at] ^= 1 << bit
    for data in (bytes(broken), PACKED[:size], bytes(broken[:size])):
        with contextlib.suppress(InputError):
            _unpack(data)


def test_anchors() -> None:
    secret, stego = _secret(), random_gaussians()
    secret.check_unchanged(stego)
    secret.check_unchanged(stego[torch.randperm(len(stego))[: len(stego) // 2]])
    with pytest.raises(InputError, match="moved or rounded"):
        secret.check_unchanged(random_gaussians(seed=1))
    with pytest.raises(InputError, match="moved or rounded"):
        secret.check_unchanged(replace(stego, means=stego.means * 1.001))


def test_rounded_positions_are_refused() -> None:
    stego = trained_like(200)
    secret = make_secret(stego)
    assert len(secret.reveal(stego)) == 200
    with pytest.raises(InputError, match="use the file as it was published"):
        secret.reveal(replace(stego, means=(stego.means * 500).round() / 500))
