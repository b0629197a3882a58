"""Secrets in appended Gaussians and out again, after what becomes of published models."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
import torch
from hypothesis import given, settings, strategies as st

from keyss.channels import APPENDED, AppendedReader, Payload, appended_count
from keyss.channels.appended import pilots
from keyss.channels.appended.words import WORD_BITS, to_gaussians
from keyss.channels.container import METHOD_BYTES
from keyss.core import (
    DRAWN_OPACITY,
    Gaussians,
    InputError,
    KeyssError,
    KeyssWarning,
    Similarity,
    WrongKeyError,
)
from keyss.files import read_model, write_model
from keyss.files.formats.common import SMALL_COUNT
from keyss.keys import derivation
from keyss.lab import cropping, fewer_harmonics, half_floats, random_pruning
from keyss.rendering import psnr_between
from lab.lifelike import lifelike, turned
from lab.stealth.careless import shuffled

KEY, ENTROPY = "Rosebud, 1941", bytes(range(32))
DATA = np.random.default_rng(0).bytes(9000)
Change = Callable[[Gaussians], Gaussians]


@pytest.fixture(scope="module")
def cover() -> Gaussians:
    return lifelike(3000, 0)


@pytest.fixture(scope="module")
def stego(cover: Gaussians) -> Gaussians:
    return embedded(cover, [(KEY, Payload("file", DATA))], entropy=ENTROPY)


def embedded(
    cover: Gaussians, secrets: Sequence[tuple[str, Payload]], entropy: bytes | None = None
) -> Gaussians:
    return APPENDED.prepare(cover).embed(secrets, entropy=entropy)


def opened(model: Gaussians, key: str = KEY) -> bytes:
    reader = AppendedReader.of(model)
    if reader is None:
        raise WrongKeyError("nothing is appended")
    return reader.open(key).data


def opened_with_a_warning(model: Gaussians, key: str = KEY) -> bytes:
    with pytest.warns(KeyssWarning, match="Gaussians were added"):
        return opened(model, key)


def unharmed(model: Gaussians, key: str = KEY) -> bytes:
    """`opened`, without a warning."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return opened(model, key)


@settings(max_examples=12, deadline=None)
@given(size=st.integers(0, 4000), seed=st.integers(0, 2**32))
def test_every_size_comes_back(cover: Gaussians, size: int, seed: int) -> None:
    data = np.random.default_rng(seed).bytes(size)
    stego = embedded(cover, [(KEY, Payload("carry", data))], entropy=seed.to_bytes(32, "little"))
    reader = AppendedReader.of(stego)
    assert reader.open(KEY) == Payload("carry", data)
    shorter = METHOD_BYTES - len("carry")  # the count is that of the longest name
    assert len(stego) - len(cover) == appended_count([len(data) - shorter])


def test_how_many_are_appended_tells_neither_a_size_nor_how_many_secrets_there_are() -> None:
    sizes = range(200, 100_000, 211)
    alone = {appended_count([size]) for size in sizes}
    assert len({appended_count([size]) for size in range(40_000, 80_000, 211)}) <= 9
    assert {appended_count([size, 300]) for size in sizes if size < 60_000} <= alone
    assert {appended_count([size, size // 2, 900]) for size in sizes if size < 40_000} <= alone


def test_the_cover_stays_and_looks_the_same(cover: Gaussians, stego: Gaussians) -> None:
    assert stego[: len(cover)].digest() == cover.digest()
    appended = stego[len(cover) :]
    assert bool((torch.round(appended.opacities * 255) == 1).all())
    assert bool((appended.sh[:, 1:] == 0).all())
    assert psnr_between(cover, stego) > 60


def test_a_model_without_anything_opens_nothing(cover: Gaussians) -> None:
    assert AppendedReader.of(cover) is None


@pytest.mark.parametrize("scale", [1.0, 1.37])
def test_a_note_among_many_faint_gaussians_of_the_cover(scale: float) -> None:
    """Few appended ones, whose lattices have to be found among as many others."""
    cover = lifelike(6000, 3)
    faint = torch.arange(len(cover)) % 4 == 0
    cover = replace(cover, opacity_logits=torch.where(faint, -5.5, cover.opacity_logits))
    for seed in range(4):
        stego = embedded(cover, [(KEY, Payload("file", b"a note"))], entropy=bytes([seed] * 32))
        assert opened(turned(scale)(stego)) == b"a note"


@pytest.mark.parametrize("moved", [False, True], ids=["random", "pilots"])
def test_many_faint_gaussians_that_do_not_agree_cost_little(moved: bool) -> None:
    random = np.random.default_rng(0)
    words = random.integers(0, 2, (100_000, WORD_BITS)).astype(np.uint8)
    if moved:
        words = pilots.write(bytes(16), 100_000, random)
    faint = to_gaussians(words, Similarity(translation=torch.full((3,), -0.5)), 0)
    faint = replace(faint, means=torch.rand(len(faint), 3))
    began = time.process_time()
    assert AppendedReader.of(faint) is None
    assert time.process_time() - began < 8


def test_a_wrong_key_takes_as_many_derivations_as_a_right_one(stego: Gaussians) -> None:
    """They are nearly all of the time."""
    derivation._argon2id.cache_clear()  # the writer has derived the right one
    with mock.patch.object(derivation, "hash_secret_raw", wraps=derivation.hash_secret_raw) as derived:
        assert opened(stego) == DATA
        with pytest.raises(WrongKeyError):
            opened(stego, "Rosebud, 1942")
    assert derived.call_count == 2


def test_no_two_files_share_anything(cover: Gaussians) -> None:
    """From equal entropy too: what is hidden is mixed in."""
    two = [embedded(cover, [(KEY, Payload("file", data))], entropy=ENTROPY) for data in (b"a", b"b")]
    readers = [AppendedReader.of(each[len(cover) :]) for each in two]
    assert readers[0].salts != readers[1].salts
    assert not {*map(bytes, readers[0].words)} & {*map(bytes, readers[1].words)}


def test_words_look_random(stego: Gaussians, cover: Gaussians) -> None:
    """Every bit of what is appended is as often set as not, whatever lies there; no two bits go together."""
    reader = AppendedReader.of(stego[len(cover) :])
    bits = reader.words.astype(np.float64) * 2 - 1
    deviation = 1 / len(bits) ** 0.5
    assert np.abs(bits.mean(axis=0)).max() < 4.5 * deviation
    together = bits.T @ bits / len(bits) - np.eye(bits.shape[1])
    assert np.abs(together).max() < 6 * deviation


def _half_turns(model: Gaussians) -> Gaussians:
    """Half a turn of each ellipsoid about one of its own axes, which leaves it as it is."""
    w, x, y, z = model.quats.unbind(1)
    about_x, about_z = torch.stack([-x, w, z, -y], 1), torch.stack([-z, y, -x, w], 1)
    third = (torch.arange(len(w)) % 3)[:, None]
    return replace(
        model, quats=torch.where(third == 0, about_x, torch.where(third == 1, about_z, -model.quats))
    )


CHANGES: dict[str, Change] = {
    "reordered": shuffled,
    "rotated and moved": turned(1.0),
    "scaled": turned(0.37),
    "scaled up": turned(41.0),
    "half turns": _half_turns,
    "without harmonics": fewer_harmonics(0),
    "half floats": half_floats(),
    "a quarter removed": random_pruning(0.25, 3),
    "all of it together": lambda model: random_pruning(0.2, 3)(shuffled(turned(2.2)(_half_turns(model)))),
}


@pytest.mark.parametrize("name", CHANGES)
def test_it_opens_after(name: str, stego: Gaussians) -> None:
    assert unharmed(CHANGES[name](stego)) == DATA


@pytest.mark.parametrize("suffix", [".spz", ".sog", ".compressed.ply", ".splat", ".glb"])
def test_it_opens_from_every_format(suffix: str, stego: Gaussians, tmp_path: Path) -> None:
    write_model(tmp_path / f"a{suffix}", turned(1.3)(stego))
    assert unharmed(read_model(tmp_path / f"a{suffix}")) == DATA


@pytest.mark.parametrize("suffix", [".spz", pytest.param(".sog", marks=pytest.mark.slow), ".compressed.ply"])
def test_it_opens_from_what_splat_transform_writes(
    splat_transform: Callable[..., Path], suffix: str, stego: Gaussians, tmp_path: Path
) -> None:
    write_model(tmp_path / "a.ply", stego)
    options = ["-i", "1"] if suffix == ".sog" else []
    converted = splat_transform(tmp_path / "a.ply", tmp_path / f"b{suffix}", *options)
    assert unharmed(read_model(converted)) == DATA


def test_it_opens_from_what_gsply_writes(stego: Gaussians, tmp_path: Path) -> None:
    gsply = pytest.importorskip("gsply")
    write_model(tmp_path / "a.ply", stego)
    gsply.write_spz(tmp_path / "b.spz", gsply.plyread(tmp_path / "a.ply"), version=3)
    assert unharmed(read_model(tmp_path / "b.spz")) == DATA
    gsply.plywrite(tmp_path / "c.ply", gsply.plyread(tmp_path / "a.ply"), compressed=True)
    compressed = next(path for path in tmp_path.glob("c*") if path.suffix == ".ply")
    assert unharmed(read_model(compressed)) == DATA


@pytest.mark.parametrize("name", ["a.spz", "a.sog"])
def test_large_payloads_survive(name: str, cover: Gaussians, tmp_path: Path) -> None:
    """Appended Gaussians take fewer bytes than others: readers of untrusted files must not refuse them."""
    data = np.random.default_rng(1).bytes(800_000)
    stego = embedded(cover.with_sh_degree(3), [(KEY, Payload("file", data))], entropy=ENTROPY)
    assert len(stego) > 1.05 * SMALL_COUNT
    write_model(tmp_path / name, stego)
    assert len(read_model(tmp_path / name)) == len(stego)


@pytest.mark.parametrize("seed", range(4))
def test_copies_of_one_faint_gaussian_do_not_hide_the_frame(seed: int, stego: Gaussians) -> None:
    faint = replace(lifelike(1, seed), opacity_logits=torch.tensor(1.5 / 255).logit()[None])
    assert opened_with_a_warning(Gaussians.cat([stego, faint[torch.zeros(8000, dtype=torch.int64)]])) == DATA


def test_too_great_a_loss_is_told_from_a_wrong_key(stego: Gaussians) -> None:
    with pytest.raises(InputError, match=r"the key is right, but too much .* shards are left"):
        opened(cropping(1)(stego))
    with pytest.raises(WrongKeyError):
        opened(stego[stego.opacities > 2 * DRAWN_OPACITY])


@pytest.mark.parametrize("seed", range(3))
def test_any_faint_gaussians_end_in_an_error(seed: int, stego: Gaussians) -> None:
    generator = torch.Generator().manual_seed(seed)
    junk = Gaussians(
        means=torch.randn(2000, 3, generator=generator) * 10.0 ** (20 * seed),
        quats=torch.randn(2000, 4, generator=generator) * (seed < 2),
        log_scales=torch.randn(2000, 3, generator=generator) * 10.0 ** (3 * seed),
        opacity_logits=torch.full((2000,), -5.5),
        sh=torch.randn(2000, 1, 3, generator=generator) * 10.0 ** (5 * seed),
    )
    with pytest.raises(KeyssError):
        opened(junk)
    assert opened_with_a_warning(Gaussians.cat([stego.with_sh_degree(0), junk])) == DATA


def test_changed_packets_are_not_read_as_they_are_not(stego: Gaussians, cover: Gaussians) -> None:
    """One in ten appended Gaussians gets the colour of another: they count as lost."""
    swapped = stego.sh.clone()
    rows = torch.arange(len(cover), len(stego), 10)
    swapped[rows] = swapped[rows.roll(1)]
    assert opened(replace(stego, sh=swapped)) == DATA


@pytest.fixture(scope="module")
def other() -> Gaussians:
    """A file that its writer gives to the same key."""
    return embedded(lifelike(3000, 5), [(KEY, Payload("file", b"another secret"))], entropy=ENTROPY)


def _copies(model: Gaussians, count: int) -> Gaussians:
    """`count` jittered specks of the first clearly visible Gaussian: small and faint."""
    row = int(torch.nonzero(model.opacities > 0.1)[0])
    one = model[torch.full((count,), row)]
    jitter = torch.randn(one.means.shape, generator=torch.Generator().manual_seed(0))
    return replace(
        one,
        means=one.means + jitter,
        log_scales=one.log_scales - 6,
        opacity_logits=one.opacity_logits.clip(max=-4),
    )


def _scaled(model: Gaussians, scale: float, shift: float = 0.0) -> Gaussians:
    return Similarity(scale, translation=torch.full((3,), shift)).apply_gaussians(model)


# What is made of a cover and of what is appended to it, to be put into another file.
ADDED: dict[str, Callable[[Gaussians, Gaussians], Gaussians]] = {
    "nothing else": lambda cover, appended: appended,
    "all of it": lambda cover, appended: Gaussians.cat([cover, appended]),
    "specks of one Gaussian": lambda cover, appended: Gaussians.cat([_copies(cover, 30_000), appended]),
    "shrunken covers": lambda cover, appended: Gaussians.cat([*[_scaled(cover, 1e-3)] * 2, appended]),
    "all of it, shrunken": lambda cover, appended: _scaled(Gaussians.cat([cover, appended]), 1e-3),
    "covers far away": lambda cover, appended: Gaussians.cat([*[_scaled(cover, 1, 300)] * 20, appended]),
    "all of it, enlarged": lambda cover, appended: _scaled(Gaussians.cat([cover, appended]), 30),
}


@pytest.mark.parametrize("name", ADDED)
@pytest.mark.parametrize("salts", ["kept", "removed"])
def test_a_secret_put_into_another_file_is_told(
    name: str, salts: str, stego: Gaussians, other: Gaussians
) -> None:
    """The key opens it there, so its holder must hear that the file is another one's."""
    host = other[:3100] if salts == "kept" else other[:3000]  # few are left
    cover, appended = stego[:3000], stego[3000:]
    assert opened_with_a_warning(Gaussians.cat([host, ADDED[name](cover, appended)])) == DATA


@pytest.mark.parametrize(
    ("host", "own"),
    [
        (Similarity(), Similarity(1e6, translation=torch.full((3,), 1e9))),
        (Similarity(translation=torch.full((3,), 3e5)), Similarity(1e-36)),
    ],
    ids=["far larger, far away", "a point beside numbers beyond float32"],
)
def test_out_of_range_file_warns(host: Similarity, own: Similarity) -> None:
    """From the cover of the secret it looks like few Gaussians, or like none."""
    large = embedded(lifelike(60_000, 6), [(KEY, Payload("file", DATA))], entropy=ENTROPY)
    visible = lifelike(60_000, 5)
    visible = replace(visible[visible.opacities > 4 / 255], sh=visible.sh[visible.opacities > 4 / 255] / 20)
    both = Gaussians.cat([host.apply_gaussians(visible), own.apply_gaussians(large)])
    assert opened_with_a_warning(both) == DATA


def test_gaussians_with_equal_numbers_are_tested_under_every_key(cover: Gaussians) -> None:
    """A border next to their opacity or thickness would leave out all of them."""
    equal = lifelike(3000, 5)
    equal = replace(equal, opacity_logits=torch.full((3000,), 2.0), log_scales=equal.log_scales * 0 - 4)
    for seed in range(20):
        key = f"{KEY} {seed}"
        stego = embedded(cover, [(key, Payload("file", b"a"))], entropy=ENTROPY)
        assert opened_with_a_warning(Gaussians.cat([equal, stego]), key) == b"a"


def test_stacks_of_faint_gaussians_are_told(stego: Gaussians) -> None:
    """A hundred of them in one place are as visible as one that is not faint."""
    stacks = lifelike(3000, 5)[torch.arange(60).repeat_interleave(50)]
    stacks = replace(stacks, opacity_logits=torch.full((len(stacks),), 3 / 255).logit())
    assert opened_with_a_warning(Gaussians.cat([stacks, stego[3000:]])) == DATA


def test_a_small_file_with_the_secret_of_a_far_larger_one_is_told(stego: Gaussians) -> None:
    """Hardly any of its Gaussians are in the sample of the larger one's Bloom filter."""
    large = embedded(lifelike(60_000, 6), [(KEY, Payload("file", DATA))], entropy=ENTROPY)
    small = Gaussians.cat([lifelike(300, 5), large[60_000:]])
    assert opened_with_a_warning(small) == DATA


@pytest.mark.parametrize("kept", [0.0, 0.1, 0.6, 1.0])
def test_losses_of_the_cover_are_no_foreign_gaussians(kept: float, stego: Gaussians) -> None:
    rows = torch.arange(round(kept * 3000))
    assert unharmed(Gaussians.cat([stego[rows], stego[3000:]])) == DATA


def test_equal_rotations_are_in_random_order(cover: Gaussians) -> None:
    """Who sees where public pilots lie in runs of equal rotations learns nothing of the others' places."""
    below = []
    for seed in range(6):
        stego = embedded(cover, [(KEY, Payload("file", DATA * 5))], entropy=bytes([seed] * 32))
        appended = stego[len(cover) :]
        reader = AppendedReader.of(appended)
        words = reader.words
        rotations = words[:, -15:] @ (1 << np.arange(15))
        invariants = (words[:, :39] @ (1 << np.arange(39)[::-1])).astype(np.uint64)
        pilot = pilots._is_pilot(invariants)
        for run in np.split(np.arange(len(words)), np.flatnonzero(np.diff(rotations)) + 1):
            if 0 < (count := int(pilot[run].sum())) < len(run):
                ranks = np.flatnonzero(pilot[run]) / (len(run) - 1)
                below.append((ranks.mean() - 0.5) * count)
    mean, spread = np.mean(below), np.std(below) / len(below) ** 0.5
    assert abs(mean) < 5 * spread


def test_equal_numbers_next_to_the_border_of_a_bin_are_no_loss() -> None:
    """A reader tests none of them, and one key in ten has such borders."""
    cover = lifelike(300, 4)
    cover = replace(cover, opacity_logits=torch.full((300,), 2.0))
    for seed in range(30):
        key = f"{KEY} {seed}"
        stego = embedded(cover, [(key, Payload("file", b"a"))], entropy=ENTROPY)
        assert unharmed(stego, key) == b"a"
