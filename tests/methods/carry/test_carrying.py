"""Models in low bits: round trips, damage, keys, independence of other secrets."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from channels.quiet.trained_like import keys, trained_like
from keyss.channels import (
    LOW_BITS,
    Layout,
    LowBitsCover,
    QuietReader,
    gaussian_ids,
    read_low_bits,
    salt_rows,
    usable_carriers,
)
from keyss.channels.quiet.layout import key_cipher
from keyss.core import Gaussians, UsageError, WrongKeyError
from keyss.keys import DerivedKey
from keyss.methods import embed_models, record_request
from methods.carry.carried import embed, embed_derived, extract, extract_derived

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


def rows_of(model: Gaussians) -> set[bytes]:
    """Gaussians as a set: revealing changes their order."""
    flat = [value.reshape(len(model), -1) for value in vars(model).values()]
    return {row.tobytes() for row in torch.cat(flat, 1).numpy()}


def salt_of(model: Gaussians, own: list[DerivedKey], before: Gaussians) -> DerivedKey:
    """The key under the salt that a reader of `model` tries first."""
    return own[QuietReader.of(before).salts.index(QuietReader.of(model).salts[0])]


def test_round_trip(cover: Gaussians, secret: Gaussians) -> None:
    secret = secret[:400]
    carried = extract(embed(cover, [(KEY, secret)]), KEY)
    assert carried.count == len(carried.gaussians) == len(secret)
    found = carried.gaussians
    order, other = found.means[:, 0].argsort(), secret.means[:, 0].argsort()
    assert torch.allclose(found.means[order], secret.means[other], atol=1e-4)
    assert torch.allclose(found.sh[order], secret.sh[other], atol=0.02)


@pytest.mark.parametrize("cover_degree", [1, 3])
@pytest.mark.parametrize("secret_degree", range(4))
def test_sh_degrees(cover_degree: int, secret_degree: int) -> None:
    model, hidden = trained_like(3000, sh_degree=cover_degree), trained_like(900, 1, secret_degree)
    own = keys()
    if (cover_degree, secret_degree) in ((1, 1), (1, 2), (1, 3)):
        with pytest.raises(UsageError, match="room for records of"):
            embed_derived(model, [(own, hidden)])
        return
    carried = extract_derived(QuietReader.of(embed_derived(model, [(own, hidden)])), own[0])
    assert carried.gaussians.sh_degree == secret_degree
    assert len(carried.gaussians) == 900


def test_every_usable_gaussian_is_written() -> None:
    """The holder of one key sees the same whatever else is hidden."""
    cover, own, other = trained_like(4000), keys(1), keys(2)
    hidden = [trained_like(700, 5), trained_like(800, 6)]
    before = read_low_bits(cover)
    seen = []
    for secrets in ([(own, hidden[0])], [(own, hidden[0]), (other, hidden[1])]):
        stego = embed_derived(cover, secrets)
        changed = (read_low_bits(stego) != before).any(axis=1)
        assert (changed == usable_carriers(cover)).all()
        counts = np.bincount(read_low_bits(stego).ravel(), minlength=256)
        assert ((counts - counts.mean()) ** 2).sum() / counts.mean() < 255 + 6 * (2 * 255) ** 0.5
        carriers = QuietReader.of(stego)
        carried = extract_derived(carriers, own[0])
        cells, _ = key_cipher(own[0]).decrypt(carriers.ids, carriers.low)
        seen.append((carried.count, len(carried.gaussians), int(cells.sum())))
        with pytest.raises(WrongKeyError):
            extract_derived(carriers, keys(3)[0])
    assert seen[0] == seen[1]


@pytest.mark.parametrize("seed", range(2))
def test_shuffling_and_pruning(cover: Gaussians, secret: Gaussians, seed: int) -> None:
    own = keys()
    stego = embed_derived(cover, [(own, secret)], entropy=ENTROPY)
    whole = rows_of(extract_derived(QuietReader.of(stego), own[0]).gaussians)
    order = torch.randperm(len(stego), generator=torch.Generator().manual_seed(seed))
    assert rows_of(extract_derived(QuietReader.of(stego[order]), own[0]).gaussians) == whole
    pruned = stego[order[: len(stego) * 3 // 4]]
    carried = extract_derived(QuietReader.of(pruned), salt_of(pruned, own, stego))
    assert rows_of(carried.gaussians) <= whole
    assert carried.count == len(secret)
    copies = LOW_BITS.prepare(cover).cells.plan_records([record_request(1200, 3)])[0].copies
    assert 0 < copies <= 300
    expected = 0.75 * (len(secret) - copies) + (1 - 0.25**2) * copies
    assert len(carried.gaussians) == pytest.approx(expected, abs=4 * (0.19 * 1200) ** 0.5)


def test_bit_flip_loses_one_carrier(cover: Gaussians, secret: Gaussians) -> None:
    """Any bit of any attribute, including Gaussians that hold a salt."""
    stego = embed(cover, [(KEY, secret)], entropy=ENTROPY)
    names = QuietReader.of(stego).salts
    own = [DerivedKey.of(KEY, salt) for salt in names[:3]]
    whole = rows_of(extract(stego, KEY).gaussians)
    random = np.random.default_rng(0)
    first = int(salt_rows(stego, gaussian_ids(stego), Layout.of(stego))[0])
    for trial in range(60):
        row = first if trial < 5 else int(random.integers(len(stego)))
        changed = _with_flipped_bit(stego, row, int(random.integers(59)), int(random.integers(31)))
        if changed is None:
            continue
        carriers = QuietReader.of(changed)
        found: set[bytes] = set()
        for name in carriers.salts[:2]:
            if name in names[:3]:
                found = rows_of(extract_derived(carriers, own[names.index(name)]).gaussians)
                break
        assert len(whole - found) <= 2  # secret Gaussians in one carrier
        assert found <= whole


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
    own = QuietReader.of(stego).salts
    added = trained_like(200, seed=9)
    added.sh[:, 1:] *= 20
    added = added[torch.from_numpy(salt_rows(added, gaussian_ids(added), Layout.of(added))[:3])]
    crowded = Gaussians.cat([added, stego])
    assert not set(own) & set(QuietReader.of(crowded).salts[:3])
    assert rows_of(extract(crowded, KEY).gaussians) == rows_of(extract(stego, KEY).gaussians)
    assert len(extract(crowded, KEY).gaussians) == len(secret)


def test_damaged_records_are_detected(monkeypatch: pytest.MonkeyPatch) -> None:
    embed = LowBitsCover.embed

    def broken(*arguments: Any, **options: Any) -> Gaussians:
        found = embed(*arguments, **options)
        sh = found.sh.clone()
        sh[::5, 5].view(torch.int32).bitwise_xor_(8)
        return replace(found, sh=sh)

    monkeypatch.setattr(LowBitsCover, "embed", broken)
    with pytest.raises(RuntimeError, match="do not open again"):
        embed_models(LOW_BITS.prepare(trained_like(6000, 0)), [KEY], [trained_like(2000, 1)])


def test_overwritten_cover() -> None:
    cover, keys, secrets = trained_like(3000, 0), ["7Vw3-Qp of the first"], [trained_like(900, 1)]
    before = cover.map(torch.clone)
    stego = embed_models(LOW_BITS.prepare(cover), keys, secrets, entropy=bytes(32)).gaussians
    assert cover.digest() == before.digest()
    prepared = LOW_BITS.prepare(cover)
    assert prepared.usable is LOW_BITS.prepare(cover).usable  # found once
    own = embed_models(prepared, keys, secrets, entropy=bytes(32), overwrite=True).gaussians
    assert own.digest() == stego.digest()
    assert cover.digest() == stego.digest()
    assert prepared.usable is not LOW_BITS.prepare(cover).usable  # found again: the cover is another model
