"""Payloads in low bits: what they survive, who can read them, what can be seen, and copies of a file."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import gsply
import numpy as np
import plyfile
import pytest
import torch

from channels.lsb.payloads import embed, extract
from channels.lsb.trained_like import UNNATURAL, trained_like
from keyss.channels import (
    LOW_BITS,
    Layout,
    LowBitsCapacity,
    LowBitsReader,
    check_payload_fits,
    gaussian_ids,
    read_low_bits,
    salt_rows,
    usable_carriers,
    write_low_bits,
)
from keyss.channels.container import SALTS_TRIED
from keyss.channels.foreign import exact_foreign, exact_record
from keyss.channels.lsb import shards
from keyss.channels.lsb.low_bits_capacity import OVERHEAD
from keyss.core import Gaussians, InputError, KeyssWarning, UsageError, WrongKeyError
from keyss.files import read_model, write_model
from keyss.keys import ALPHABET, DerivedKey, generate_key
from keyss.rendering import render
from tiny_scenes import ring_cameras

PAYLOAD = bytes(range(256)) * 4 + os.urandom(2999) + b"."
KEY = "the right key"
GENERATED = "q7Rv2LxT9bWm4KzD"
SMALLEST = 700  # Gaussians that carry a byte


@pytest.fixture(scope="module")
def plain() -> Gaussians:
    return trained_like(1500)


@pytest.fixture(scope="module")
def stego(plain: Gaussians) -> Gaussians:
    return embed(plain, [(KEY, PAYLOAD)])


def test_a_model_of_equal_gaussians_holds_nothing(plain: Gaussians) -> None:
    with pytest.raises(WrongKeyError):
        extract(plain[torch.zeros(200, dtype=torch.int64)], KEY)


@pytest.mark.parametrize("unit", [False, True])
@pytest.mark.parametrize("degree", [0, 1, 2])
def test_round_trip_of_lower_degrees(degree: int, unit: bool) -> None:
    """Without quaternions at degree 0, rows have no tag."""
    model = trained_like(6000, sh_degree=degree)
    if unit:
        model = replace(model, quats=torch.nn.functional.normalize(model.quats))
    stego = embed(model, [(KEY, PAYLOAD[:1500])])
    assert extract(stego, KEY) == PAYLOAD[:1500]
    order = torch.randperm(6000, generator=torch.Generator().manual_seed(degree))[:4500]
    assert extract(stego[order], KEY) == PAYLOAD[:1500]


def test_other_payloads_of_the_same_entropy_give_independent_bits(plain: Gaussians) -> None:
    stego = embed(plain, [(KEY, PAYLOAD)], bytes(32))
    for other in (embed(plain, [(KEY, PAYLOAD[:-1] + b"!")], bytes(32)), embed(plain, [(KEY, PAYLOAD)])):
        same = (read_low_bits(other, 4) == read_low_bits(stego, 4))[usable_carriers(plain)].mean()
        assert same == pytest.approx(1 / 256, abs=2e-3)  # as between independent random bytes


def test_the_same_entropy_in_another_cover_repeats_nothing(plain: Gaussians) -> None:
    """Otherwise equal noise would tell the carriers of data from the others."""
    seen = []
    for cover in (plain, trained_like(1500, 77)):
        low = read_low_bits(embed(cover, [(KEY, PAYLOAD)], bytes(32)), 4)
        seen.append({row.tobytes() for row in low[usable_carriers(cover)]})
    assert not seen[0] & seen[1]


def test_only_low_bits_of_some_fields_change(plain: Gaussians, stego: Gaussians) -> None:
    assert torch.equal(plain.means, stego.means)
    assert torch.equal(plain.sh[:, 0], stego.sh[:, 0])
    for name, bits in (("log_scales", 5), ("quats", 5), ("opacity_logits", 5), ("sh", 5)):
        before, after = (getattr(model, name).contiguous().view(torch.int32) for model in (plain, stego))
        assert not torch.equal(before, after)
        assert torch.equal(before >> bits, after >> bits), name
        assert torch.equal(before & 1, after & 1), name
    assert np.array_equal(gaussian_ids(plain), gaussian_ids(stego))


@pytest.mark.parametrize("seed", range(10))
def test_survives_shuffling_and_the_loss_of_a_quarter(stego: Gaussians, seed: int) -> None:
    """Also in a file that held a secret before."""
    order = torch.randperm(len(stego), generator=torch.Generator().manual_seed(seed))
    again = embed(stego, [(KEY, PAYLOAD)])
    for model in (again, stego):
        assert extract(model[order[: len(stego) * 3 // 4]], KEY) == PAYLOAD


def test_too_much_pruning_is_said_to_the_holder_of_the_key_only() -> None:
    model = trained_like(4000)
    capacity = LOW_BITS.prepare(model).capacity.bytes
    stego = embed(model, [(KEY, os.urandom(capacity * 9 // 10))])
    order = torch.randperm(4000, generator=torch.Generator().manual_seed(0))
    first = salt_rows(stego, gaussian_ids(stego), Layout.of(stego))[:1]
    rest = stego[torch.cat([torch.from_numpy(first), order[:1500]])]
    with pytest.raises(InputError, match="too much of the model"):
        extract(rest, KEY)
    with pytest.raises(WrongKeyError):
        extract(rest, "another key")


def _resave_by_plyfile(source: Path, target: Path) -> None:
    data = plyfile.PlyData.read(source)
    plyfile.PlyData([plyfile.PlyElement.describe(data["vertex"].data.copy(), "vertex")]).write(target)


RESAVERS: dict[str, Callable[[Path, Path], object]] = {
    "keyss": lambda source, target: write_model(target, read_model(source)),
    "gsply": lambda source, target: gsply.plywrite(target, gsply.plyread(source)),
    "plyfile": _resave_by_plyfile,
}


@pytest.mark.parametrize("name", RESAVERS)
def test_survives_being_saved_again(stego: Gaussians, tmp_path: Path, name: str) -> None:
    write_model(tmp_path / "in.ply", stego)
    RESAVERS[name](tmp_path / "in.ply", tmp_path / "out.ply")
    assert extract(read_model(tmp_path / "out.ply"), KEY) == PAYLOAD


def test_survives_splat_transform(
    splat_transform: Callable[..., Path], stego: Gaussians, tmp_path: Path
) -> None:
    write_model(tmp_path / "in.ply", stego)
    copy = splat_transform(tmp_path / "in.ply", tmp_path / "out.ply")
    assert extract(read_model(copy), KEY) == PAYLOAD


def _neighbours(key: str) -> list[str]:
    """`key` with one character changed to any other of the alphabet, or its cases exchanged."""
    changed = {key[:i] + c + key[i + 1 :] for i in range(len(key)) for c in ALPHABET}
    return sorted((changed | {key.swapcase(), key.upper(), key.lower()}) - {key})


@pytest.mark.parametrize("every", [8, pytest.param(1, marks=pytest.mark.slow)])
def test_wrong_keys_open_nothing(every: int) -> None:
    """Random keys and all of one other character, or a sample of them."""
    stego = embed(trained_like(SMALLEST, seed=3), [(GENERATED, b"x")])
    assert extract(stego, GENERATED) == b"x"
    neighbours = _neighbours(GENERATED)
    assert len(neighbours) == 16 * 61 + 3
    for wrong in [*neighbours, *(generate_key() for _ in range(1000))][::every]:
        with pytest.raises(WrongKeyError):
            extract(stego, wrong)


def test_a_wrong_key_makes_the_same_work_as_a_right_one(
    stego: Gaussians, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Up to the decryption of the payload: nearly as many blocks of AES; those of its shards are few."""
    blocks = 0
    real = shards.encrypted_blocks

    def counted(key: bytes, data: np.ndarray) -> np.ndarray:
        nonlocal blocks
        blocks += data.size // 16
        return real(key, data)

    monkeypatch.setattr(shards, "encrypted_blocks", counted)
    reader = LowBitsReader.of(stego)
    assert reader.extract(DerivedKey.of(KEY, reader.salts[0])).data == PAYLOAD
    needed, blocks = blocks, 0
    with pytest.raises(WrongKeyError):
        reader.extract(DerivedKey.of("The right key", reader.salts[0]))
    assert 0.5 * needed < blocks <= needed


def test_a_wrong_key_is_tried_under_a_few_salts(stego: Gaussians, monkeypatch: pytest.MonkeyPatch) -> None:
    derived = []
    monkeypatch.setattr(DerivedKey, "of", lambda key, salt: derived.append(key) or DerivedKey(bytes(32)))
    with pytest.raises(WrongKeyError):
        extract(stego, "The right key")
    assert len(derived) == SALTS_TRIED


def test_ordinary_models_open_for_nobody_and_look_the_same(plain: Gaussians) -> None:
    with pytest.raises(WrongKeyError):
        extract(plain, KEY)
    with pytest.raises(WrongKeyError):
        extract(trained_like(50, sh_degree=0), KEY)


def test_models_too_small_are_refused_with_the_number_that_would_do() -> None:
    with pytest.raises(UsageError, match=r"too small.*Gaussians would do"):
        embed(trained_like(330), [(KEY, PAYLOAD)])
    with pytest.raises(UsageError, match="too small"):
        check_payload_fits(30_000, 10_000, 1, sh_degree=0)
    with pytest.raises(UsageError, match="for each of 2 secrets"):
        check_payload_fits(126_000, 5_000, 2, sh_degree=3)
    check_payload_fits(126_000, 10_000, 1, sh_degree=3)


def test_capacity_grows_with_the_model_and_is_kept_to() -> None:
    gaussians = (130, 700, 2000, 8000, 26_000, 260_000)
    capacities = [LowBitsCapacity.of(count, Layout(3)) for count in gaussians]
    sizes = [capacity.for_payloads().bytes for capacity in capacities]
    assert sizes == sorted(sizes)
    assert sizes[0] == 0
    assert sizes[-1] / gaussians[-1] > 24  # a model at the finest precision
    assert capacities[-1].payload_capacity(1) > 1.9 * capacities[-1].payload_capacity(2)
    for capacity, size in zip(capacities[1:], sizes[1:], strict=True):
        for secrets in (1, 2, 4) if capacity.gaussians >= 8000 else (1,):
            plan = capacity.plan([size // 8 // secrets] * secrets)
            assert plan.independent == (capacity.gaussians >= 8000)
            assert plan.depth == 4
            taken = sum(share.carriers for share in plan.shares) + secrets * capacity.header_carriers
            assert taken <= capacity.carriers
        largest = capacity.payload_capacity(1)
        assert size <= largest < 1.5 * size
        assert capacity.plan([largest]).depth == 8
        with pytest.raises(UsageError, match="too small"):
            capacity.plan([largest + 1])


def test_a_secret_gets_the_least_share_that_holds_it() -> None:
    capacity = LowBitsCapacity.of(20_000, Layout(3))
    steps = capacity.for_payloads().shares
    assert [part for part, _ in steps] == [0.25, 0.5, 1, 1, 1]
    sizes = [size for _, size in steps]
    assert sizes == sorted(sizes)
    plans = [capacity.plan([size + OVERHEAD]) for size in sizes]
    assert [plan.depth for plan in plans] == [4, 4, 4, 6, 8]
    carriers = [plan.shares[0].carriers for plan in plans]
    assert carriers[0] < carriers[1] < carriers[2] == carriers[3] == carriers[4]
    assert not capacity.plan([sizes[2] + OVERHEAD, sizes[0] + OVERHEAD]).independent


def test_more_than_the_places_of_header_and_shards_never_decides() -> None:
    """At the largest size of each share, with a quarter of the Gaussians lost at random."""
    model = trained_like(6000, 21)
    prepared = LOW_BITS.prepare(model)
    for index, (_, size) in enumerate(prepared.capacity.shares):
        data = os.urandom(size)
        stego = embed(model, [(KEY, data)])
        order = torch.randperm(6000, generator=torch.Generator().manual_seed(index))[:4500]
        assert extract(stego[order], KEY) == data


@pytest.mark.parametrize("change", UNNATURAL)
def test_models_without_random_low_bits_are_refused(
    change: Callable[[Gaussians], Gaussians], plain: Gaussians
) -> None:
    with pytest.raises(UsageError, match="low bits"):
        embed(change(plain), [(KEY, b"x")])


def test_renders_before_and_after_are_equal_beyond_what_can_be_seen() -> None:
    model = trained_like(1500, seed=9)
    log_scales = (0.7371 * model.log_scales.double()).float()
    model = replace(model, means=model.means / 4, log_scales=log_scales, sh=model.sh * 2)
    stego = embed(model, [(KEY, PAYLOAD)])
    for camera in ring_cameras(4):
        error = (render(model, camera) - render(stego, camera)).square().mean()
        assert -10 * torch.log10(error) > 70


@pytest.fixture(scope="module")
def cover() -> Gaussians:
    return trained_like(1500, 4)


def test_two_hidings_in_one_cover_have_no_salt_in_common(cover: Gaussians) -> None:
    first, second = (LowBitsReader.of(embed(cover, [(KEY, b"x")])).salts for _ in range(2))
    assert len(set(first)) == len(set(second)) == 12
    assert not set(first) & set(second)


def test_copies_count_once(cover: Gaussians) -> None:
    stego = embed(cover, [(KEY, PAYLOAD)])
    five = Gaussians.cat([stego] * 5)[torch.randperm(5 * len(stego))]
    one, other = (LowBitsReader.of(model).open(KEY) for model in (stego, five))
    assert one == other
    assert one.shards == other.shards
    assert other.foreign == 0


@pytest.mark.parametrize(("times", "degree", "unit"), [(3, 3, False), (8, 3, False), (3, 0, True)])
def test_what_a_file_hides_is_found_among_others_by_a_salt_of_its_own(
    times: int, degree: int, unit: bool
) -> None:
    """Other Gaussians displace places of the header, and false shards join the true ones."""
    model, others = (trained_like(count, 9, degree) for count in (6000, 6000 * times))
    if unit:
        model, others = (
            replace(each, quats=torch.nn.functional.normalize(each.quats)) for each in (model, others)
        )
    stego = embed(model, [(KEY, PAYLOAD[:1000])])
    key = DerivedKey.of(KEY, LowBitsReader.of(stego).salts[0])
    assert LowBitsReader.of(Gaussians.cat([others, stego])).extract(key).data == PAYLOAD[:1000]


def test_who_merges_two_files_under_one_key_is_told(cover: Gaussians) -> None:
    first, second = embed(cover, [(KEY, b"first")]), embed(trained_like(1500, 9), [(KEY, b"second")])
    with pytest.warns(KeyssWarning, match=r"about [\d,]+ Gaussians were added"):
        assert extract(Gaussians.cat([first, second]), KEY) in (b"first", b"second")


def replaced(first: Gaussians, second: Gaussians, kept: float) -> Gaussians:
    """What somebody without keys makes of two files, so that the key of both opens the first one's secret.

    The salts of the second are overwritten, and the first loses Gaussians that give no salt.
    """
    rows = salt_rows(second, gaussian_ids(second), Layout.of(second))
    low = np.random.default_rng(0).integers(0, 256, (len(rows), 53), np.uint8)
    second = write_low_bits(second, Layout.of(second), [(8, rows, low)])
    salts = salt_rows(first, gaussian_ids(first), Layout.of(first))
    rest = np.setdiff1d(np.arange(len(first)), salts)[: int(kept * len(first))]
    return Gaussians.cat([second, first[torch.from_numpy(np.concatenate([salts, rest]))]])


@pytest.mark.parametrize("kept", [1.0, 0.8, 0.5])
def test_who_puts_one_file_into_another_does_not_go_unnoticed(cover: Gaussians, kept: float) -> None:
    first, second = embed(cover, [(KEY, b"first")]), embed(trained_like(1500, 9), [(KEY, b"second")])
    with pytest.warns(KeyssWarning, match="Gaussians were added to the file"):
        assert extract(replaced(first, second, kept), KEY) == b"first"


@pytest.mark.parametrize("kept", [slice(None), slice(300, None), slice(None, None, -2)])
def test_who_removes_gaussians_is_not_warned(cover: Gaussians, kept: slice) -> None:
    stego = embed(cover, [(KEY, b"first")])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert extract(stego[torch.arange(len(stego)).numpy()[kept].copy()], KEY) == b"first"


@pytest.mark.parametrize("left", [1.0, 0.7])
def test_fewer_foreign_gaussians_than_a_quarter_are_noticed(cover: Gaussians, left: float) -> None:
    """A Bloom filter of 256 bits misses so many with probability e^(-256 / 6 e) = 2e-7."""
    stego = embed(cover, [(KEY, b"first")])
    more = Gaussians.cat([stego[: int(left * len(stego))], trained_like(len(stego) // 6, 14)])
    with pytest.warns(KeyssWarning, match=r"about [\d,]+ Gaussians were added"):
        assert extract(more, KEY) == b"first"


def test_bloom_filter_counts_foreign_gaussians() -> None:
    ids, key = np.random.default_rng(0).integers(0, 256, (40_000, 16), np.uint8), bytes(16)
    for count in (1, 100, 20_000):
        record = exact_record(key, ids[:count])
        assert exact_foreign(record, key, ids[:count]) == 0
    assert 14_000 < exact_foreign(record, key, ids) < 26_000
    assert exact_foreign(record, b"another data key", ids[:20_000]) > 16_000


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
        embed(planted(pairs), [(KEY, b"secret")])


def test_a_table_made_before_hiding_opens_nothing() -> None:
    cover = planted(150)
    before, fresh = set(salts_of(cover)), []
    for _ in range(2):
        reader = LowBitsReader.of(embed(cover, [(KEY, b"secret")]))
        assert 0 < len(before & set(reader.salts)) < 4
        for salt in reader.salts:
            key = DerivedKey.of(KEY, salt)
            if salt in before:
                with pytest.raises(WrongKeyError):
                    reader.extract(key)
            else:
                assert reader.extract(key).data == b"secret"
        fresh.append(set(reader.salts) - before)
    assert not fresh[0] & fresh[1]


def test_a_cover_with_stale_salts_opens_from_what_pruning_leaves() -> None:
    cover = planted(150)
    stego = embed(cover, [(KEY, b"secret")])
    assert extract(stego, KEY) == b"secret"
    order = torch.randperm(len(stego), generator=torch.Generator().manual_seed(1))
    assert extract(stego[order[: len(stego) * 3 // 4]], KEY) == b"secret"


def test_salts_of_ordinary_models_are_fresh() -> None:
    cover = trained_like(3000)
    rows = salt_rows(cover, gaussian_ids(cover), Layout.of(cover))
    assert usable_carriers(cover)[rows].all()
    stego = embed(cover, [(KEY, b"secret")])
    assert np.array_equal(salt_rows(stego, gaussian_ids(stego), Layout.of(stego)), rows)
    assert not set(salts_of(cover)) & set(salts_of(stego))
