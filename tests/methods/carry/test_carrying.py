"""Models in low bits: round trips, damage, keys, independence of other secrets."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from channels.lsb.trained_like import trained_like
from keyss.channels import (
    LOW_BITS,
    Layout,
    LowBitsCover,
    LowBitsReader,
    gaussian_ids,
    read_low_bits,
    salt_rows,
    usable_carriers,
)
from keyss.core import Gaussians, KeyssError, WrongKeyError
from keyss.methods import embed_models
from methods.carry.carried import embed, extract

KEY = "the right key"
ENTROPY = bytes(32)


@pytest.fixture(scope="module")
def cover() -> Gaussians:
    return trained_like(3000)


@pytest.fixture(scope="module")
def secret() -> Gaussians:
    return trained_like(1200, seed=1)


@pytest.fixture(scope="module")
def stego(cover: Gaussians, secret: Gaussians) -> Gaussians:
    return embed(cover, [(KEY, secret)])


def test_round_trip(cover: Gaussians, secret: Gaussians) -> None:
    found = extract(embed(cover, [(KEY, secret)]), KEY).gaussians
    assert len(found) == len(secret)
    distances, nearest = torch.cdist(found.means, secret.means).min(dim=1)
    assert len(nearest.unique()) == len(secret)
    assert float(distances.max()) < 0.01
    assert torch.allclose(found.sh[:, 0], secret.sh[nearest, 0], atol=0.06)


@pytest.mark.parametrize("cover_degree", range(4))
@pytest.mark.parametrize("secret_degree", range(4))
def test_sh_degrees(cover_degree: int, secret_degree: int) -> None:
    model, hidden = trained_like(12_000, sh_degree=cover_degree), trained_like(200, 1, secret_degree)
    carried = extract(embed(model, [(KEY, hidden)]), KEY)
    assert carried.gaussians.sh_degree == secret_degree
    assert len(carried.gaussians) == 200


def test_every_usable_gaussian_is_written() -> None:
    """The holder of one key sees the same whatever else is hidden."""
    cover = trained_like(4000)
    hidden = [trained_like(300, 5), trained_like(350, 6)]
    before = read_low_bits(cover, 4)
    seen = []
    for secrets in ([(KEY, hidden[0])], [(KEY, hidden[0]), ("another key", hidden[1])]):
        stego = embed(cover, secrets)
        changed = (read_low_bits(stego, 4) != before).any(axis=1)
        assert (changed == usable_carriers(cover)).all()
        counts = np.bincount(read_low_bits(stego, 4).ravel(), minlength=256)
        assert ((counts - counts.mean()) ** 2).sum() / counts.mean() < 255 + 6 * (2 * 255) ** 0.5
        carried = extract(stego, KEY)
        seen.append((carried.payload.shards, len(carried.gaussians)))
        with pytest.raises(WrongKeyError):
            extract(stego, "a third key")
    assert seen[0] == seen[1]


@pytest.mark.parametrize("seed", range(2))
def test_shuffling_and_pruning(cover: Gaussians, secret: Gaussians, seed: int) -> None:
    """Nothing is lost with a quarter of the Gaussians."""
    stego = embed(cover, [(KEY, secret)], entropy=ENTROPY)
    whole = extract(stego, KEY)
    order = torch.randperm(len(stego), generator=torch.Generator().manual_seed(seed))
    assert extract(stego[order], KEY).gaussians.digest() == whole.gaussians.digest()
    carried = extract(stego[order[: len(stego) * 3 // 4]], KEY)
    assert carried.gaussians.digest() == whole.gaussians.digest()
    left, shards = carried.payload.shards
    assert whole.payload.shards == (shards, shards)
    assert left == pytest.approx(0.75 * shards, abs=5 * (0.19 * shards) ** 0.5)
    assert not carried.recovered(carried.gaussians).whole


@pytest.mark.filterwarnings("ignore:.*were added to the file")
def test_bit_flip_loses_one_shard(cover: Gaussians, secret: Gaussians) -> None:
    """Any bit of any attribute, including Gaussians that hold a salt."""
    stego = embed(cover, [(KEY, secret)], entropy=ENTROPY)
    whole = extract(stego, KEY)
    random = np.random.default_rng(0)
    first = int(salt_rows(stego, gaussian_ids(stego), Layout.of(stego))[0])
    for trial in range(60):
        row = first if trial < 5 else int(random.integers(len(stego)))
        changed = _with_flipped_bit(stego, row, int(random.integers(59)), int(random.integers(31)))
        if changed is None:
            continue
        found = extract(changed, KEY)
        assert found.gaussians.digest() == whole.gaussians.digest()
        assert whole.payload.shards[1] - found.payload.shards[0] <= 1


def _with_flipped_bit(model: Gaussians, row: int, column: int, bit: int) -> Gaussians | None:
    """None if the value becomes non-finite."""
    changed = model.map(torch.clone)
    for values in vars(changed).values():
        flat = values.view(len(values), -1).numpy().view(np.uint32)
        if column < flat.shape[1]:
            flat[row, column] ^= np.uint32(1 << bit)
            return changed if torch.isfinite(values[row]).all() else None
        column -= flat.shape[1]
    raise AssertionError("no such column")


@pytest.mark.filterwarnings("ignore::keyss.core.KeyssWarning")  # of added Gaussians
def test_foreign_gaussians_do_not_block_salts(stego: Gaussians, secret: Gaussians) -> None:
    """Three inserted Gaussians come first in the order of salts."""
    own = LowBitsReader.of(stego).salts
    added = trained_like(60_000, seed=9)  # three of many have smaller IDs than all others
    added = added[torch.from_numpy(salt_rows(added, gaussian_ids(added), Layout.of(added))[:3])]
    crowded = Gaussians.cat([added, stego])
    assert not set(own) & set(LowBitsReader.of(crowded).salts[:3])
    assert extract(crowded, KEY).gaussians.digest() == extract(stego, KEY).gaussians.digest()
    assert len(extract(crowded, KEY).gaussians) == len(secret)


def test_damage_while_writing_is_detected(monkeypatch: pytest.MonkeyPatch) -> None:
    embed = LowBitsCover.embed

    def broken(*arguments: Any, **options: Any) -> Gaussians:
        found = embed(*arguments, **options)
        sh = found.sh.clone()
        sh[:, 5].view(torch.int32).bitwise_xor_(8)
        return replace(found, sh=sh)

    monkeypatch.setattr(LowBitsCover, "embed", broken)
    with pytest.raises((RuntimeError, KeyssError)):
        embed_models(LOW_BITS.prepare(trained_like(6000, 0)), [KEY], [trained_like(2000, 1)])
