"""Salts that the author of a cover could know in advance hold no keys."""

from __future__ import annotations

import os
from dataclasses import replace

import numpy as np
import pytest
import torch

from channels.lsb.payloads import embed, extract
from channels.lsb.trained_like import trained_like
from keyss.channels import Layout, LowBitsReader, gaussian_ids, salt_rows, usable_carriers
from keyss.core import Gaussians, UsageError, WrongKeyError
from keyss.keys import DerivedKey


def planted(pairs: int, seed: int = 3) -> Gaussians:
    """A cover of 2,000 Gaussians with pairs that share scales, and cannot be written."""
    model = trained_like(2000, seed)
    scales = model.log_scales.clone()
    scales[: 2 * pairs : 2] = scales[1 : 2 * pairs : 2]
    return replace(model, log_scales=scales)


def salts_of(model: Gaussians) -> list[bytes]:
    return list(LowBitsReader.of(model).salts)


@pytest.mark.parametrize("pairs", [800, 900])
def test_covers_with_many_predictable_salts_are_refused(pairs: int) -> None:
    with pytest.raises(UsageError, match="salts of this cover cannot be renewed, and whoever made it"):
        embed(planted(pairs), [("a key", b"secret")])


def test_a_table_made_before_hiding_opens_nothing() -> None:
    cover = planted(150)
    before, fresh = set(salts_of(cover)), []
    for _ in range(2):
        reader = LowBitsReader.of(embed(cover, [("a key", b"secret")]))
        assert 0 < len(before & set(reader.salts)) < 4
        for salt in reader.salts:
            key = DerivedKey.of("a key", salt)
            if salt in before:
                with pytest.raises(WrongKeyError):
                    reader.extract(key)
            else:
                assert reader.extract(key).data == b"secret"
        fresh.append(set(reader.salts) - before)
    assert not fresh[0] & fresh[1]


def test_a_cover_with_stale_salts_opens_from_what_pruning_leaves() -> None:
    cover = planted(150)
    stego = embed(cover, [("a key", b"secret")], os.urandom(32))
    assert extract(stego, "a key") == b"secret"
    order = torch.randperm(len(stego), generator=torch.Generator().manual_seed(1))
    assert extract(stego[order[: len(stego) * 3 // 4]], "a key") == b"secret"


def test_salts_of_ordinary_models_are_fresh() -> None:
    cover = trained_like(3000)
    rows = salt_rows(cover, gaussian_ids(cover), Layout.of(cover))
    assert usable_carriers(cover)[rows].all()
    stego = embed(cover, [("a key", b"secret")])
    assert np.array_equal(salt_rows(stego, gaussian_ids(stego), Layout.of(stego)), rows)
    assert not set(salts_of(cover)) & set(salts_of(stego))
