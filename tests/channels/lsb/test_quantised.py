"""What is written into the codes of a file comes out of it with its key alone, and what must stay stays."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings, strategies as st

from channels.lsb.quantised import FORMATS, bits_of, codes_of, model_of, opened, there_and_back, written
from keyss.channels import (
    Field,
    Payload,
    QuantisedCover,
    QuantisedReader,
    in_counted_order,
    last_bits,
    sealed_size,
)
from keyss.channels.lsb.fields import ROTATIONS, sog_distances
from keyss.channels.lsb.wet_paper import read_blocks
from keyss.channels.lsb.writable_levels import fixed_axes, writable_levels
from keyss.core import InputError, UsageError, WrongKeyError
from keyss.files.formats import sog
from keyss.files.formats.common import in_morton_order, morton_order
from keyss.files.formats.compressed_ply import CompressedPlyCodes
from keyss.files.formats.sog import SogCodes
from keyss.files.formats.spz import SpzCodes

ENTROPY = bytes(range(32))
EVERY = pytest.mark.parametrize("suffix", FORMATS)


def blocks(data: bytes, width: int) -> int:
    """That a payload takes, with that of its parameters."""
    return 1 + -(-sealed_size(Payload("carry", data)) // width)


@EVERY
@settings(max_examples=6, deadline=None)
@given(data=st.data())
def test_any_payloads_of_any_sizes(suffix: str, data: st.DataObject) -> None:
    cover = QuantisedCover.of(codes_of(suffix, 3000))
    some = st.integers(0, cover.capacity.bytes // 4)
    sizes = data.draw(st.lists(some, min_size=1, max_size=8))
    rng = np.random.default_rng(data.draw(st.integers(0, 99)))
    payloads = [rng.bytes(size) for size in sizes]
    if sum(blocks(payload, cover.width) for payload in payloads) >= len(cover.ids):
        with pytest.raises(UsageError, match="room for"):
            written(cover, *payloads)
        return
    file = there_and_back(suffix, written(cover, *payloads, entropy=rng.bytes(32)))
    assert [opened(file, str(i)) for i in range(len(payloads))] == payloads
    with pytest.raises(WrongKeyError):
        opened(file, "200")


@EVERY
def test_capacity_is_exact(suffix: str) -> None:
    cover = QuantisedCover.of(codes_of(suffix))
    left = len(cover.ids) - 1  # one gives the salt
    full = np.random.default_rng(1).bytes((left - 1) * cover.width)
    while blocks(full, cover.width) > left:
        full = full[:-1]
    assert cover.capacity.bytes <= len(full) < (left - 1) * cover.width
    assert opened(there_and_back(suffix, written(cover, full))) == full
    with pytest.raises(UsageError, match="room for"):
        written(cover, full + b"\x55")


@EVERY
def test_what_carries_is_known_from_what_stays(suffix: str) -> None:
    """Writing over what was written leaves the places where they are."""
    codes = codes_of(suffix)
    bits = [each.bits for each in in_counted_order(codes)[2]]
    assert sum(int(bit.sum()) for bit in bits) > 10 * len(codes)
    for round_ in range(3):
        codes = written(QuantisedCover.of(codes), b"data", entropy=bytes([round_]) * 32)
        assert all(map(np.array_equal, bits, (each.bits for each in in_counted_order(codes)[2])))


@EVERY
def test_levels_move_by_as_little_as_can_be(suffix: str) -> None:
    cover = QuantisedCover.of(codes_of(suffix))
    after = in_counted_order(written(cover, bytes(1000)))[2]
    for old, new, free in zip(cover.fields, after, cover.free, strict=True):
        moved = np.abs(new.levels - old.levels)
        assert not moved[~free].any()
        assert (moved <= (1 << old.bits) // 2).all()
        # Of uniform residues half lie as far away as a quarter of their range; rounding takes a little of it.
        large = free & (old.bits >= 3)
        if large.any():
            assert 0.3 < (moved[large] > (1 << old.bits[large]) // 4).mean() < 0.55


@EVERY
def test_nothing_else_changes(suffix: str) -> None:
    before = codes_of(suffix)
    after = written(QuantisedCover.of(before), b"data")
    ordered = [in_counted_order(each)[1] for each in (before, after)]
    carrying = {each.name for each in in_counted_order(before)[2]}
    for name in set(vars(before)) - carrying:
        old, new = (np.asarray(getattr(each, name)) for each in ordered)
        assert np.array_equal(old, new), name
    assert all(getattr(before, n).dtype == getattr(after, n).dtype for n in carrying)


@EVERY
def test_every_bit_that_may_change_is_written(suffix: str) -> None:
    """Each of them is 0 in half of the files and 1 in the others, however short the payload is."""
    cover, files = QuantisedCover.of(codes_of(suffix, 300)), 40
    reads = np.stack([bits_of(written(cover, b"data", entropy=bytes([i]) * 32)) for i in range(files)])
    dry = cover.dry.astype(bool)
    assert 0.8 < dry.mean() < 1
    kept = last_bits(cover.fields)[~dry]
    assert (reads[:, ~dry] == kept).all()
    ones = reads[:, dry].mean(axis=0)
    assert not ((ones == 0) | (ones == 1)).any()  # none is left alone: by chance 2^-39 of them
    assert abs(float(ones.mean()) - 0.5) < 6 * 0.5 / (files * dry.sum()) ** 0.5
    pairs = (reads[1:, dry] == reads[:-1, dry]).mean()
    assert abs(float(pairs) - 0.5) < 6 * 0.5 / ((files - 1) * dry.sum()) ** 0.5


@EVERY
def test_other_inputs_give_other_salts(suffix: str) -> None:
    cover = QuantisedCover.of(codes_of(suffix))
    others = [written(cover, b"b"), written(cover, b"a", entropy=bytes(32)), written(cover, b"a", b"b")]
    salts = {QuantisedReader.of(each).salts[0] for each in [written(cover, b"a"), *others]}
    assert len(salts) == 4


@EVERY
def test_damage_is_told_from_a_wrong_key(suffix: str) -> None:
    """Except in the few blocks that hold the salt and the header, or nothing."""
    cover = QuantisedCover.of(codes_of(suffix))
    data = np.random.default_rng(0).bytes(cover.capacity.bytes * 9 // 10)
    file = written(cover, data)
    damaged = 0
    for row in range(0, 6000, 400):
        rotations = file.rotations.copy()
        rotations[row, 0] ^= 1
        try:
            assert opened(replace(file, rotations=rotations)) == data
        except WrongKeyError:
            continue
        except InputError as error:
            damaged += "damaged" in str(error)
    assert damaged > 10


def test_too_many_secrets() -> None:
    cover = QuantisedCover.of(codes_of(".spz"))
    with pytest.raises(UsageError, match="room for"):
        cover.embed([(str(i), Payload("carry", b"")) for i in range(len(cover.ids) // 2 + 1)])


@EVERY
def test_small_models_have_no_room(suffix: str) -> None:
    with pytest.raises(UsageError, match="no room"):
        QuantisedCover.of(codes_of(suffix, 100))
    with pytest.raises(WrongKeyError):
        opened(codes_of(suffix, 100))


def test_columns_on_a_lattice_stay_and_the_rest_carries() -> None:
    codes = codes_of(".spz")
    positions = codes.positions.copy()
    positions[:, 0] = positions[:, 0] // 64 * 64 + 7
    positions[:, 1] = 1000
    cover = QuantisedCover.of(replace(codes, positions=positions))
    file = written(cover, b"data" * 99)
    assert np.array_equal(file.positions[:, :2], positions[:, :2])
    assert (file.positions[:, 2] != positions[:, 2]).mean() > 0.5
    assert opened(file) == b"data" * 99


def test_twins_stay_twins() -> None:
    codes = codes_of(".spz")
    names = ("positions", "alphas", "colors", "scales", "largest", "rotations", "sh")
    for name in names:
        getattr(codes, name)[100:200] = getattr(codes, name)[:100]
    file = written(QuantisedCover.of(codes), b"data")
    assert all(np.array_equal(getattr(file, n)[100:200], getattr(file, n)[:100]) for n in names)
    assert opened(file) == b"data"


def test_rotations_keep_both_zeros() -> None:
    """SPZ has a sign and a magnitude; a number that came from below 0 does not become +0."""
    codes = codes_of(".spz")
    file = written(QuantisedCover.of(codes), b"data")
    far = (codes.rotations & 511) > 3
    assert np.array_equal((file.rotations & 512)[far], (codes.rotations & 512)[far])
    zeros = file.rotations[file.rotations & 511 == 0]
    assert 0.2 < (zeros == 512).mean() < 0.8


@EVERY
def test_the_largest_part_of_a_quaternion_stays_the_largest(suffix: str) -> None:
    """But for those that rounding alone makes, which stay, too."""
    cover = QuantisedCover.of(codes_of(suffix, 20_000))
    after = in_counted_order(written(cover, b"data"))[2]
    least, largest = ROTATIONS[type(cover.codes)]

    def wrong(fields: list[Field]) -> Any:
        levels = np.stack([field.levels for field in fields if field.name == "rotations"], axis=1)
        parts = np.abs(levels - (least + largest) / 2) * 2**0.5 / (largest - least)
        rest = 1 - np.square(parts).sum(axis=1)
        return np.square(parts.max(axis=1)) > rest

    assert wrong(cover.fields).sum() > 5
    assert np.array_equal(wrong(after), wrong(cover.fields))


def test_rotations_of_an_old_spz_stay() -> None:
    codes = codes_of(".spz")
    old = replace(
        codes,
        version=2,
        largest=np.full(len(codes), 3, np.uint8),
        rotations=np.random.default_rng(0).integers(1, 255, (len(codes), 3)).astype(np.uint16),
    )
    file = SpzCodes.parse(written(QuantisedCover.of(old), b"data").serialise())
    assert np.array_equal(file.rotations, old.rotations)
    assert opened(file) == b"data"


def test_sog_stays_in_the_order_of_its_positions() -> None:
    """As much as that of an untouched file, which was sorted before it was rounded."""

    def out_of_order(codes: sog.SogCodes) -> int:
        return int((np.diff(morton_order(codes.dequantise().means.numpy())) < 0).sum())

    plain = SogCodes.quantise(model_of(20_000))
    expected = out_of_order(plain)
    found = out_of_order(written(QuantisedCover.of(plain), bytes(5000)))
    assert expected > 0
    assert abs(found - expected) < 6 * expected**0.5


def test_an_spz_in_the_order_of_space_stays_in_order() -> None:
    codes = SpzCodes.quantise(in_morton_order(model_of(20_000)))
    file = written(QuantisedCover.of(codes), bytes(5000))
    places = [np.empty(20_000, int) for _ in range(2)]
    for each, own in zip((codes, file), places, strict=True):
        own[morton_order(each.dequantise().means.numpy())] = np.arange(20_000)
    before, after = (np.diff(own) < 0 for own in places)
    assert not (after & ~before).any()
    assert (file.positions != codes.positions).any(axis=1).mean() > 0.3
    assert opened(file) == bytes(5000)


@pytest.mark.parametrize("other", [SpzCodes, SogCodes])
def test_positions_of_another_format_stay(other: type[SpzCodes | SogCodes]) -> None:
    """Those decoded from a compressed .ply are on the lattices of its chunks."""
    model = CompressedPlyCodes.quantise(model_of(20_000)).dequantise()
    codes = other.quantise(model)
    assert fixed_axes(codes).all()
    assert not fixed_axes(other.quantise(model[torch.randperm(20_000)])).any()
    free = writable_levels(*in_counted_order(codes)[1:], fixed_axes(codes), SECRET)
    assert [each.any() for each in free] == [False] * 3 + [True] * 3


SECRET, NO_AXIS = bytes(32), np.zeros(3, np.bool_)


def test_gaussians_nearer_to_each_other_than_by_chance_stay() -> None:
    codes = codes_of(".spz")
    fields = in_counted_order(codes)[2]
    positions = codes.positions.copy()
    positions[1000:1200] = positions[:200] + np.array([1, 0, 0])
    near = replace(codes, positions=positions)
    free = np.stack(writable_levels(near, in_counted_order(near)[2], NO_AXIS, SECRET)[:3])
    assert free[:, :200].mean() < 0.1 > free[:, 1000:1200].mean()
    apart = np.stack(writable_levels(codes, fields, NO_AXIS, SECRET)[:3])
    assert apart[:, :200].mean() > 0.8 < free[:, 2000:].mean()


@pytest.mark.parametrize("suffix", FORMATS)
def test_neighbours_with_equal_rotations_keep_them(suffix: str) -> None:
    codes = in_counted_order(codes_of(suffix))[1]
    means = codes.dequantise().means.numpy()
    for row in (10, 2000, 4000):
        nearest = int(np.linalg.norm(means - means[row], axis=1).argsort()[1])
        rotations = codes.rotations.copy()
        rotations[nearest] = rotations[row]
        changed = in_counted_order(replace(codes, rotations=rotations))[1:]
        free = np.stack(writable_levels(*changed, NO_AXIS, SECRET))
        assert not free[:, [row, nearest]].any()
        assert free.any(axis=0).mean() > 0.8


@pytest.mark.parametrize("suffix", FORMATS)
def test_fewer_change_the_nearer_a_limit_is(suffix: str) -> None:
    cover = QuantisedCover.of(codes_of(suffix, 30_000))
    for field, free in zip(cover.fields, cover.free, strict=True):
        if field.name != "rotations":
            continue
        most = {".spz": 511, ".sog": 255, ".compressed.ply": 1023}[suffix]
        ends = np.minimum(np.abs(field.levels - (-511 if suffix == ".spz" else 0)), most - field.levels)
        assert not free[ends < 2].any()
        assert free[ends > 100].mean() > 0.8


def test_steps_of_a_sog_stay_as_large_as_they_are() -> None:
    codes = codes_of(".sog", 30_000)
    cover = QuantisedCover.of(codes)
    distances = [
        sog_distances(each, each.positions)
        for each in (cover.codes, in_counted_order(written(cover, b"data"))[1])
    ]
    assert len(np.unique(distances[0])) > 1
    assert np.array_equal(*distances)


@EVERY
def test_the_blocks_of_one_file_are_of_no_use_in_another(suffix: str) -> None:
    """Everybody can read blocks, and write them. But salts depend on colours and opacities."""
    covers = [QuantisedCover.of(codes_of(suffix, seed=seed)) for seed in (0, 1)]
    one, host = sorted(covers, key=lambda each: each.width)
    first = written(one, b"first")
    assert opened(first) == b"first"
    table = read_blocks(bits_of(first))[:, : host.width]
    table = np.resize(table, (len(host.ids), host.width))
    bits = host._solve(table, SECRET)
    copied = host._model_to_publish(host._with_bits(bits, SECRET), SECRET).codes
    assert np.array_equal(read_blocks(bits_of(copied))[:40, : host.width], table[:40])
    with pytest.raises(WrongKeyError):
        opened(copied)
