"""Regenerate the known answers in this folder after an intended change of format.

    python tests/vectors/make_vectors.py

`revealed.json` holds what keys open in the models of this folder; the reader in `web/` is tested against it.
"""

from __future__ import annotations

import hashlib
import json
import math
import sys
import unicodedata
import warnings
from collections.abc import Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any
from unittest import mock

FOLDER = Path(__file__).parent
STRIDE = 49
TWO_KEYS = ("first key of two", "zweiter Schlüssel")
sys.path.insert(0, str(FOLDER.parent))

import numpy as np  # noqa: E402
import torch  # noqa: E402
from argon2.low_level import Type, hash_secret_raw  # noqa: E402
from cryptography.hazmat.primitives.hashes import SHA256  # noqa: E402
from cryptography.hazmat.primitives.kdf.hkdf import HKDFExpand  # noqa: E402
from scipy.spatial.transform import Rotation  # noqa: E402

from channels.lsb import quantised  # noqa: E402
from channels.lsb.trained_like import trained_like  # noqa: E402
from files.formats.examples import model_of, random_compressed, random_sog, random_spz  # noqa: E402
from keyss.channels import (  # noqa: E402
    APPENDED,
    COLOURS,
    LOW_BITS,
    SUFFIXES,
    Payload,
    channel_for,
    in_counted_order,
    last_bits,
    open_payload,
)
from keyss.channels.colours import planner  # noqa: E402
from keyss.channels.lsb.decoded import Decoded  # noqa: E402
from keyss.channels.lsb.fields import _log2  # noqa: E402
from keyss.core import Gaussians, KeyssWarning, Similarity  # noqa: E402
from keyss.files import read_model, write_model  # noqa: E402
from keyss.files.formats import splat  # noqa: E402
from keyss.files.formats.common import CodedGaussians  # noqa: E402
from keyss.files.formats.compressed_ply import CompressedPlyCodes  # noqa: E402
from keyss.files.formats.sog import SogCodes  # noqa: E402
from keyss.files.formats.spz import SpzCodes  # noqa: E402
from keyss.keys import random_embeddings  # noqa: E402
from keyss.methods import CarriedSecret, Decoder, DecoderShape, HiddenFile, KeyssSecret, choose_anchors  # noqa: E402
from keyss.methods.codec.model_bytes import BLOCK, decode, encode  # noqa: E402
from lab.lifelike import lifelike  # noqa: E402
from methods.carry.carried import embed  # noqa: E402
from methods.keyss.small import make_secret  # noqa: E402

SURVIVING = ("appended.ply", "appended-moved.spz", "colours.spz", "colours-moved.splat")
NOTE = HiddenFile("a note.txt", b"Written at noon, read at night.\n")


def derivation() -> dict[str, object]:
    """Key derivation by argon2-cffi and `cryptography`."""
    vectors = json.loads((FOLDER / "derivation.json").read_text())
    for vector in vectors["valid"]:
        vector.pop("lsb/key", None)
        key, salt = unicodedata.normalize("NFKC", vector["key"]).encode(), bytes.fromhex(vector["salt"])
        master = hash_secret_raw(key, salt, 3, 64 * 1024, 4, 32, Type.ID)
        for label in ("writer", "channel/key"):
            expand = HKDFExpand(SHA256(), 32, f"keyss/v1/{label}".encode())
            vector[label] = expand.derive(master).hex()
    return vectors


def open_file(name: str, key: str) -> dict[str, Any]:
    """What `key` opens in a file of this folder: SHA-256 of float32 columns, or of a payload."""
    stego = read_model(FOLDER / name)
    payload = open_payload(stego, key)
    found: dict[str, Any] = {"file": name, "key": key, "method": payload.method}
    if payload.method != "carry":
        return found | {"payload": hashlib.sha256(payload.data).hexdigest()}
    model = CarriedSecret.of(payload).reveal(stego)
    shards = payload.shards and list(payload.shards)
    return found | {"count": len(model), "shards": shards, "sha256": digests(model)}


def pruned_model() -> Gaussians:
    """Two secrets that share carriers: unit quaternions, pruned, shuffled, with duplicates."""
    cover = trained_like(1700, 3, sh_degree=2)
    cover = replace(cover, quats=torch.nn.functional.normalize(cover.quats))
    secrets = [
        (TWO_KEYS[0], trained_like(120, 4, sh_degree=1)),
        (TWO_KEYS[1], trained_like(30, 5, sh_degree=2)),
    ]
    stego = embed(cover, secrets, entropy=bytes(32))
    rows = torch.randperm(len(stego), generator=torch.Generator().manual_seed(6))[:1500]
    return stego[torch.cat([rows, rows[:5]])]


def bare_model() -> Gaussians:
    """A file in a model of SH degree 0 with unit quaternions, in rows without tags; a sixth is lost."""
    cover = trained_like(3000, 17, sh_degree=0)
    cover = replace(cover, quats=torch.nn.functional.normalize(cover.quats))
    payload = HiddenFile("a note.txt", b"Written in four bytes, read in two.\n").payload()
    stego = LOW_BITS.prepare(cover).embed([(TWO_KEYS[0], payload)], entropy=bytes(32))
    return stego[torch.randperm(len(stego), generator=torch.Generator().manual_seed(18))[:2500]]


def main() -> None:
    (FOLDER / "derivation.json").write_text(json.dumps(derivation(), indent=1) + "\n")
    key = json.loads((FOLDER / "carried.json").read_text())["key"]
    secret = trained_like(8, 1, 1)
    secret.means[0, 0] = 1e6  # an outlier
    stego = embed(trained_like(400), [(key, secret)], entropy=bytes(32))
    write_model(FOLDER / "carried.ply", stego)
    carried = {"key": key, "count": len(secret), "payload": encode(secret).hex()}
    (FOLDER / "carried.json").write_text(json.dumps(carried, indent=1) + "\n")
    cover = trained_like(1600)
    joint = make_secret(cover).payload()
    stego = LOW_BITS.prepare(cover).embed([(key, joint)], entropy=bytes(32))
    write_model(FOLDER / "keyss.ply", stego)
    write_revealed(key)
    write_published()
    write_extremes()
    write_counted()
    write_encoded()
    write_keyss()


def write_published() -> None:
    """A model in every published format, and what Python reads of each."""
    model = model_of(300, 2, seed=7)
    files = {
        "published.spz": SpzCodes.write(model),
        "published-2.spz": random_spz(np.random.default_rng(1), 2, 40, 15).serialise(),
        "published-4.spz": replace(SpzCodes.quantise(model), version=4).serialise(),
        "published.compressed.ply": CompressedPlyCodes.write(model),
        "published.sog": SogCodes.write(model),
        "published.splat": splat.write(model),
    }
    read = {}
    for name, data in files.items():
        (FOLDER / name).write_bytes(data)
        read[name] = digests(read_model(FOLDER / name))
    (FOLDER / "published.json").write_text(json.dumps(read, indent=1) + "\n")


def write_coded(suffix: str) -> None:
    """A model whose quantised values hold two secrets: two models, or a model and a file."""
    cover = quantised.model_of(2300, 11, 0)
    other = {
        ".spz": Payload("carry", encode(trained_like(25, 12, 2))),
        ".sog": Payload("carry", encode(trained_like(60, 13, 0))),
        ".compressed.ply": HiddenFile("a note.txt", b"Written at noon, read at night.\n").payload(),
    }[suffix]
    secrets = [(TWO_KEYS[0], Payload("carry", encode(trained_like(40, 14, 1)))), (TWO_KEYS[1], other)]
    name = next(each for each, end in SUFFIXES.items() if end == suffix)
    model = channel_for("unchanged", format=name).prepare(cover).embed(secrets, entropy=bytes(32))
    write_model(FOLDER / f"coded{suffix}", model)


def write_decoded(suffix: str) -> None:
    """A .ply decoded from codes, with a secret; some quaternions have another sign, some are not exact."""
    codes = quantised.FORMATS[suffix].of(quantised.model_of(1500, 21, 0))
    model = codes.dequantise()
    model.quats[::10] *= -1
    model.quats[5::20] += 0.1
    payload = HiddenFile("a note.txt", b"Written at night, read at noon.\n").payload()
    stego = (
        channel_for("unchanged", cover=model)
        .prepare(model)
        .embed([(TWO_KEYS[0], payload)], entropy=bytes(32))
    )
    write_model(FOLDER / f"decoded-{suffix.split('.')[1]}.ply", stego)


def write_extremes() -> None:
    """Extreme values in formats where they determine how many bits carry."""
    random = np.random.default_rng(15)
    codes = random_sog(random, 60, 0)
    same = {
        name: getattr(codes, name).copy() for name in ("scales", "colors", "alphas", "largest", "positions")
    }
    for each in same.values():
        each[40:] = each[:20]  # equal except for written codes
    codes = replace(codes, **same, mins=np.array([-40.0, 1, 5e-310]), maxs=np.array([60.0, 1, 0]))
    codes = replace(codes, scale_codebook=(16 * codes.scale_codebook).astype(np.float32))
    (FOLDER / "extreme.sog").write_bytes(codes.serialise())
    chunks = random_compressed(random, 700, 0)
    chunks.bounds[0, 6:12] = [0, 1, -3e38, 0, -1, 3e38]
    chunks.bounds[1, 6:12] = [0, 0, -1e-3, 1e-44, 1e-6, 1e-3]
    (FOLDER / "extreme.compressed.ply").write_bytes(chunks.serialise())


def write_counted() -> None:
    """The bits of slots in the quantised values of this folder's files."""
    bits = {}
    for start in ("coded", "decoded", "extreme", "published"):
        for path in sorted(FOLDER.glob(f"{start}*")):
            model = None if path.suffix == ".json" else read_model(path)
            if isinstance(model, CodedGaussians) or (model and Decoded.of(model)):
                bits[path.name] = carrier_bits(model)
    numbers = [0.0, 1.0, -3.0, 0.75, 1e-5, 6.5e4, 5e-324, -1e-310, 2.0**-1022, 1.7e308, 2.0**-14 * 1.0001]
    logs = {repr(number): float(_log2(np.array([number]))[0]) for number in numbers}
    (FOLDER / "counted.json").write_text(json.dumps({"bits": bits, "log2": logs}, indent=1) + "\n")


def carrier_bits(model: Gaussians) -> dict[str, Any]:
    """Number and SHA-256 of the last bits of all levels of a file, or of the one it was decoded from."""
    decoded = Decoded.of(model)
    codes, exact = (decoded.codes, decoded.exact) if decoded else (model.codes, None)  # type: ignore[attr-defined]
    bits = last_bits(in_counted_order(codes, exact)[2])
    return {"count": len(bits), "sha256": hashlib.sha256(bits.tobytes()).hexdigest()}


def write_encoded() -> None:
    """Encoded models."""
    far = trained_like(40, 8, 0)
    far.means[3, 1] = -1e5  # an outlier
    seen = trained_like(40, 9, 3)
    seen.log_scales[2] += 8  # the finest harmonics; the next has the coarsest
    seen.opacity_logits[3] = -14
    two_blocks = trained_like(20, 11, 0)[torch.arange(BLOCK + 100) % 20]  # equal Gaussians take few bytes
    models = [seen, far, trained_like(10, 10, 1)[:1], two_blocks]
    encoded = [encode(model) for model in models]
    found = [{"data": data.hex(), "sha256": digests(decode(data))} for data in encoded]
    (FOLDER / "encoded.json").write_text(json.dumps(found, indent=1) + "\n")


def write_keyss() -> None:
    """Rows decoded by decoders of both designs, partly from pruned secrets."""
    shapes = [
        DecoderShape(hidden=(6, 5), branch=4, sh_degree=1),
        DecoderShape(mask=("op", "sh"), hidden=(4, 4), branch=3, key_size=7, released=True),
    ]
    stego = read_model(FOLDER / "carried.ply")
    payloads = [("carried.ply", decoder_of(shape, stego).payload().data) for shape in shapes]
    key = json.loads((FOLDER / "carried.json").read_text())["key"]
    payloads.append(("keyss.ply", open_payload(read_model(FOLDER / "keyss.ply"), key).data))
    found = [
        {"file": name, "payload": payload.hex()} | decode_rows(payload, read_model(FOLDER / name))
        for name, payload in payloads
    ]
    (FOLDER / "keyss.json").write_text(json.dumps(found, indent=1) + "\n")


def decoder_of(shape: DecoderShape, stego: Gaussians) -> KeyssSecret:
    """A pruned secret in another frame, whose decoder changes much."""
    generator = torch.Generator().manual_seed(16)
    decoder = Decoder(shape).requires_grad_(False)
    for weights in decoder.parameters():
        torch.nn.init.normal_(weights, std=0.3, generator=generator)
    key = random_embeddings(1, generator, shape.key_size)[0]
    return KeyssSecret(decoder, key, some_frame(), choose_anchors(stego, 16), 600)


def some_frame() -> Similarity:
    turn = torch.from_numpy(Rotation.from_rotvec([0.4, -1.1, 2.0]).as_matrix())
    return Similarity(0.8, turn, torch.tensor([1.0, -2.0, 0.5], dtype=torch.float64))


def decode_rows(payload: bytes, stego: Gaussians) -> dict[str, Any]:
    """Number of Gaussians that a payload reveals, and every 49th of them."""
    model = KeyssSecret.of(Payload("keyss", payload)).reveal(stego)
    rows = {
        field.name: getattr(model[::STRIDE], field.name).flatten().tolist() for field in fields(Gaussians)
    }
    return {"count": len(model), "rows": {name: [round(v, 7) for v in each] for name, each in rows.items()}}


def digests(model: Gaussians) -> dict[str, str]:
    """SHA-256 of the float32 columns."""
    columns = {field.name: getattr(model, field.name).numpy() for field in fields(Gaussians)}
    return {each: hashlib.sha256(np.ascontiguousarray(v)).hexdigest() for each, v in columns.items()}


def write_surviving() -> None:
    """Models and files in appended Gaussians and in colours, which survive conversion."""
    ply, spz, one, moved = (FOLDER / name for name in SURVIVING)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", KeyssWarning)  # of more secrets than one
        write_model(ply, with_appended(TWO_KEYS))
    model = with_appended(TWO_KEYS[:1])
    rows = torch.randperm(len(model), generator=torch.Generator().manual_seed(21))
    write_model(spz, elsewhere(model[rows[: 9 * len(rows) // 10]]))
    cover = lifelike(4000, 22).with_sh_degree(0)
    notes = [(TWO_KEYS[0], NOTE.payload()), (TWO_KEYS[1], Payload("file", b"\0" + b"?" * 9))]
    write_model(one, COLOURS.prepare(cover).embed(notes, entropy=bytes(32)))
    secret = Payload("carry", encode(trained_like(12, 25, 0)))
    with mock.patch.object(planner, "STRENGTH", 40.0):
        small = COLOURS.prepare(cover[:2300]).embed([(TWO_KEYS[0], secret)], entropy=bytes(32))
    write_model(moved, elsewhere(small))


def with_appended(keys: Sequence[str]) -> Gaussians:
    """A cover in which half of the Gaussians are faint."""
    cover = trained_like(120, 23, 0)
    cover = replace(cover, opacity_logits=torch.where(torch.arange(120) % 2 == 0, -5.5, 2.0))
    payloads = [Payload("carry", encode(trained_like(40, 24, 1))), NOTE.payload()]
    return APPENDED.prepare(cover).embed(list(zip(keys, payloads, strict=False)), entropy=bytes(32))


def elsewhere(model: Gaussians) -> Gaussians:
    """Apply a similarity transform."""
    rotation = torch.from_numpy(Rotation.from_euler("xyz", [1.0, 2.0, 3.0]).as_matrix())
    return Similarity(math.pi / 2, rotation, torch.tensor([3.0, -2.0, 1.0])).apply_gaussians(model)


def write_revealed(key: str) -> None:
    write_model(FOLDER / "pruned.ply", pruned_model())
    opened = [open_file(name, key) for name in ("carried.ply", "keyss.ply")]
    opened += [open_file("pruned.ply", key) for key in TWO_KEYS]
    write_model(FOLDER / "bare.ply", bare_model())
    opened.append(open_file("bare.ply", TWO_KEYS[0]))
    for suffix in quantised.FORMATS:
        write_coded(suffix)
        opened += [open_file(f"coded{suffix}", key) for key in TWO_KEYS]
        write_decoded(suffix)
        opened.append(open_file(f"decoded-{suffix.split('.')[1]}.ply", TWO_KEYS[0]))
    write_surviving()
    opened += [open_file(name, TWO_KEYS[0]) for name in SURVIVING]
    opened += [open_file(name, TWO_KEYS[1]) for name in SURVIVING[:3:2]]
    (FOLDER / "revealed.json").write_text(json.dumps(opened, indent=1) + "\n")


if __name__ == "__main__":
    main()
