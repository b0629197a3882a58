from __future__ import annotations

import contextlib
import json
import struct
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from keyss.core import InputError, WrongKeyError
from keyss.core.similarity import Similarity
from keyss.hiding.decoder import Decoder, DecoderShape
from keyss.hiding.decoder_file import (
    HiddenSecret,
    SavedDecoder,
    choose_anchors,
    load_decoder,
    save_decoder,
)
from keyss.seal import DerivedKey, KeyDerivation
from tiny_scenes import random_gaussians

DERIVATION = KeyDerivation(salt=bytes(range(16)), time_cost=1, memory_kib=8192, parallelism=1)
FRAME = Similarity(2.0, torch.eye(3, dtype=torch.float64), torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64))


def _saved(key: str = "a key") -> SavedDecoder:
    torch.manual_seed(0)
    stego = random_gaussians()
    decoder = Decoder(DecoderShape(hidden=16, branch=8))
    decoder.standardise(stego)
    anchors = choose_anchors(stego, torch.Generator().manual_seed(0))
    secret = HiddenSecret(DerivedKey(key, DERIVATION).verifier(), FRAME)
    return SavedDecoder(decoder, DERIVATION, (secret,), anchors)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    path = tmp_path / "decoder.safetensors"
    save_decoder(path, _saved())
    return path


def _with_header(path: Path, **changes: object) -> None:
    """Rewrite the JSON header, keeping the tensors."""
    data = path.read_bytes()
    (size,) = struct.unpack("<Q", data[:8])
    outer = json.loads(data[8 : 8 + size])
    inner = json.loads(outer["__metadata__"]["keyss"])
    inner.update(changes)
    outer["__metadata__"]["keyss"] = json.dumps(inner)
    header = json.dumps(outer).encode()
    header += b" " * (-len(header) % 8)
    path.write_bytes(struct.pack("<Q", len(header)) + header + data[8 + size :])


def test_round_trip_and_same_bytes(path: Path, tmp_path: Path) -> None:
    saved, loaded = _saved(), load_decoder(path)
    assert loaded.decoder.shape == saved.decoder.shape
    assert loaded.derivation == saved.derivation
    assert loaded.secrets[0].verifier == saved.secrets[0].verifier
    assert torch.equal(loaded.secrets[0].frame.translation, FRAME.translation)
    for name, value in saved.decoder.state_dict().items():
        assert torch.equal(loaded.decoder.state_dict()[name], value)
    save_decoder(tmp_path / "again", loaded)
    assert (tmp_path / "again").read_bytes() == path.read_bytes()


def test_a_key_finds_its_secret_and_a_wrong_one_none(path: Path) -> None:
    loaded = load_decoder(path)
    assert loaded.find(DerivedKey("a key", loaded.derivation)) is loaded.secrets[0]
    with pytest.raises(WrongKeyError):
        loaded.find(DerivedKey("A key", loaded.derivation))


def test_another_version_is_refused_by_number(path: Path) -> None:
    _with_header(path, version=2)
    with pytest.raises(InputError, match=r"version 2.*version 1"):
        load_decoder(path)


@pytest.mark.parametrize(
    "changes",
    [
        {"format": "other"},
        {"shape": None},
        {"shape": {"mask": "op", "hidden": 10**9, "branch": 8, "frequencies": 6, "sh_degree": 3}},
        {"shape": {"mask": "op", "hidden": 16, "branch": 8, "frequencies": 6, "sh_degree": 3}},
        {"derivation": {"salt": "00", "time_cost": 1, "memory_kib": 8192, "parallelism": 1}},
        {"derivation": {"salt": "00" * 16, "time_cost": 1, "memory_kib": 1 << 40, "parallelism": 1}},
        {"derivation": {"salt": "zz" * 16, "time_cost": 1, "memory_kib": 8192, "parallelism": 1}},
        {"secrets": []},
        {"secrets": [{"verifier": "00", "frame": {"scale": -1}}]},
        {"secrets": 3},
    ],
)
def test_hostile_headers_are_input_errors(path: Path, changes: dict[str, object]) -> None:
    _with_header(path, **changes)
    with pytest.raises(InputError):
        load_decoder(path)


def test_truncated_and_mutated_files_are_input_errors_or_decoders(path: Path) -> None:
    data = path.read_bytes()
    for size in [0, 1, 7, 8, 9, 100, len(data) // 2, len(data) - 1]:
        path.write_bytes(data[:size])
        with pytest.raises(InputError):
            load_decoder(path)
    generator = torch.Generator().manual_seed(0)
    for _ in range(150):
        broken = bytearray(data)
        where = int(torch.randint(min(len(data), 3000), (1,), generator=generator))
        broken[where] ^= 1 << int(torch.randint(8, (1,), generator=generator))
        path.write_bytes(broken)
        with contextlib.suppress(InputError):
            load_decoder(path)


def test_weights_that_are_not_finite_are_refused(tmp_path: Path) -> None:
    saved = _saved()
    saved.decoder.first.bias.data[0] = float("nan")
    save_decoder(tmp_path / "decoder", saved)
    with pytest.raises(InputError, match="finite"):
        load_decoder(tmp_path / "decoder")


def test_a_missing_decoder_is_an_input_error(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="No such file"):
        load_decoder(tmp_path / "none")


def test_belonging_survives_order_and_pruning_but_not_another_model() -> None:
    saved, stego = _saved(), random_gaussians()
    saved.check_belongs_to(stego)
    saved.check_belongs_to(stego[torch.randperm(len(stego))[: len(stego) // 2]])
    with pytest.raises(InputError, match="another model"):
        saved.check_belongs_to(random_gaussians(seed=1))
    with pytest.raises(InputError, match="another model"):
        saved.check_belongs_to(replace(stego, means=stego.means * 1.001))
