"""Models with secrets that survive conversion, for `make_vectors.py`."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from unittest import mock

import torch
from scipy.spatial.transform import Rotation

from channels.lsb.trained_like import trained_like
from keyss.channels import APPENDED, COLOURS, Payload
from keyss.channels.colours import planner
from keyss.core import Gaussians, KeyssWarning, Similarity
from keyss.files import write_model
from keyss.methods import HiddenFile
from keyss.methods.codec.model_bytes import encode
from lab.lifelike import lifelike

NAMES = ("appended.ply", "appended-moved.spz", "colours.spz", "colours-moved.splat")
NOTE = HiddenFile("a note.txt", b"Written at noon, read at night.\n")


def write_surviving(folder: Path, keys: tuple[str, str]) -> None:
    """Models and files in appended Gaussians and in colours."""
    ply, spz, one, moved = (folder / name for name in NAMES)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", KeyssWarning)  # of more secrets than one
        write_model(ply, with_appended(keys))
    model = with_appended(keys[:1])
    rows = torch.randperm(len(model), generator=torch.Generator().manual_seed(21))
    write_model(spz, elsewhere(model[rows[: 9 * len(rows) // 10]]))
    cover = lifelike(4000, 22).with_sh_degree(0)
    notes = [(keys[0], NOTE.payload()), (keys[1], Payload("file", b"\0" + b"?" * 9))]
    write_model(one, COLOURS.prepare(cover).embed(notes, entropy=bytes(32)))
    secret = Payload("carry", encode(trained_like(12, 25, 0)))
    with mock.patch.object(planner, "STRENGTH", 40.0):
        small = COLOURS.prepare(cover[:2300]).embed([(keys[0], secret)], entropy=bytes(32))
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
