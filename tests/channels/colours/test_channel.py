"""Bytes in a model and out again, after what becomes of published models, and for no other key."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings, strategies as st

from channels.colours.made import PACKED, cover, embed, extract
from keyss.channels import COLOURS, ColoursCover, container
from keyss.channels.colours import colours_channel as channel, header
from keyss.channels.colours.carriers import Carriers, find_salts
from keyss.channels.colours.header import FILE_KEY_BYTES, Header, Secrets, places
from keyss.channels.colours.planner import STRENGTH
from keyss.core import Gaussians, InputError, KeyssError, KeyssWarning, Similarity, UsageError, WrongKeyError
from keyss.lab import converters, cropping, half_floats, noise, opacity_pruning, random_pruning
from keyss.rendering import psnr_between
from lab.lifelike import turned
from lab.stealth.careless import shuffled

ENTROPY = bytes(range(32))


@pytest.fixture(scope="module")
def prepared() -> ColoursCover:
    return COLOURS.prepare(cover(6000))


@pytest.fixture(scope="module")
def payload(prepared: ColoursCover) -> bytes:
    return np.random.default_rng(0).bytes(prepared.planner.bytes - PACKED)


@pytest.fixture(scope="module")
def stego(prepared: ColoursCover, payload: bytes) -> Gaussians:
    return embed(prepared, [("a", payload)], entropy=ENTROPY)


@settings(max_examples=8, deadline=None)
@given(share=st.floats(0, 1), seed=st.integers(0, 2**32))
def test_every_size_up_to_capacity_comes_back(prepared: ColoursCover, share: float, seed: int) -> None:
    data = np.random.default_rng(seed).bytes(int(share * (prepared.planner.bytes - PACKED)))
    stego = embed(prepared, [("a", data)], entropy=seed.to_bytes(32, "little"))
    assert extract(stego, "a") == data


def test_a_header_made_up_by_chance_hides_no_other(
    payload: bytes, stego: Gaussians, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One attempt of 2^16 gives bits whose tag is right, and there are four for each key."""
    read, made_up = Header.read, iter([Header(bytes(FILE_KEY_BYTES), 40, 0, 63, 20, 0, 0)])
    monkeypatch.setattr(Header, "read", lambda *args: next(made_up, None) or read(*args))
    assert extract(turned(1.37)(stego), "a") == payload


def test_what_does_not_fit_is_refused_with_what_would(prepared: ColoursCover, payload: bytes) -> None:
    with pytest.raises(UsageError, match=f"{prepared.planner.bytes:,} bytes of one secret"):
        embed(prepared, [("a", payload + b"x")])


def test_only_green_and_blue_of_some_gaussians_change(prepared: ColoursCover, stego: Gaussians) -> None:
    model = prepared.cover
    for name in ("means", "quats", "log_scales", "opacity_logits"):
        assert torch.equal(getattr(model, name), getattr(stego, name))
    assert torch.equal(model.sh[:, 0, 0], stego.sh[:, 0, 0])
    assert torch.equal(model.sh[:, 1:], stego.sh[:, 1:])
    assert (model.sh != stego.sh).any(dim=2).any(dim=1).float().mean() > 0.5


def test_it_costs_no_more_than_was_asked_for(prepared: ColoursCover, stego: Gaussians) -> None:
    assert psnr_between(prepared.cover, stego) > STRENGTH


def test_a_small_payload_changes_far_less_than_a_large_one(prepared: ColoursCover, stego: Gaussians) -> None:
    small = embed(prepared, [("a", bytes(20))], entropy=ENTROPY)
    full, little = ((each.sh[:, 0] - prepared.cover.sh[:, 0]).square().sum() for each in (stego, small))
    assert little < full / 30
    assert float((small.sh != prepared.cover.sh).any(dim=2).any(dim=1).float().mean()) < 0.6
    assert float((small.sh - prepared.cover.sh).abs().quantile(0.99)) < 0.0277
    others = [embed(prepared, [("a", bytes(20))], entropy=bytes([seed] * 32)) for seed in range(4)]
    psnr = np.mean([psnr_between(prepared.cover, other) for other in others])  # depends on where salts are
    assert psnr > psnr_between(prepared.cover, stego) + 3


def _spz(model: Gaussians) -> Gaussians:
    return next(
        converter for converter in converters() if (converter.format, converter.tool) == (".spz", "gsply")
    )(model)


CHANGES: dict[str, Callable[[Gaussians], Gaussians]] = {
    "nothing": lambda model: model,
    "spz": _spz,
    "spz, order and a quarter": lambda model: random_pruning(0.25, 3)(shuffled(_spz(model))),
    "rotation and translation": turned(1.0),
    "scaling": turned(1.37),
    "half floats": half_floats(),
    "noise on colour": noise("colour", 0.005),
    "noise on log scales": noise("log scale", 0.005),
}


@pytest.mark.filterwarnings("error::keyss.core.KeyssWarning")
@pytest.mark.parametrize("name", CHANGES)
def test_a_full_model_opens_after(name: str, stego: Gaussians, payload: bytes) -> None:
    if "spz" in name:
        pytest.importorskip("gsply")
    assert extract(CHANGES[name](stego), "a") == payload


HARDER: dict[str, Callable[[Gaussians], Gaussians]] = {
    "one half": cropping(1),
    "another half": cropping(2),
    "a random half": random_pruning(0.5),
    "without the faintest": opacity_pruning(0.25),
    "scaling before spz": lambda model: _spz(turned(0.4)(model)),
    "another scene beside it": lambda model: Gaussians.cat([cover(2000, seed=5), model]),
}


@pytest.mark.parametrize("name", HARDER)
def test_a_fifth_of_the_capacity_opens_after(prepared: ColoursCover, name: str) -> None:
    if "spz" in name:
        pytest.importorskip("gsply")
    data = np.random.default_rng(1).bytes((prepared.planner.bytes - PACKED) // 5)
    stego = embed(prepared, [("a", data)], entropy=ENTROPY)
    assert extract(HARDER[name](stego), "a") == data


SLOW = pytest.param(4, marks=pytest.mark.slow)  # .sog by splat-transform


@pytest.mark.parametrize("index", [*range(4), SLOW, 5])
def test_formats_of_other_programs(index: int, stego: Gaussians, payload: bytes) -> None:
    converter = converters()[index]
    try:
        back = converter(stego)
    except KeyssError as error:
        pytest.skip(str(error))
    assert extract(back, "a") == payload


@pytest.mark.filterwarnings("ignore:.*other secrets")
@pytest.mark.parametrize("sizes", [(20, 10, 10), (10, 10, 10, 10), (100, 60)])
def test_several_secrets_survive_losses(prepared: ColoursCover, sizes: tuple[int, ...]) -> None:
    """Headers of the others take places that a reader does not know."""
    data = {str(index): np.random.default_rng(index).bytes(size) for index, size in enumerate(sizes)}
    stego = random_pruning(0.1, 0)(embed(prepared, list(data.items()), entropy=ENTROPY))
    assert all(extract(stego, key) == each for key, each in data.items())


def test_who_could_notice_other_secrets_is_said(prepared: ColoursCover, payload: bytes) -> None:
    large, small = payload[: len(payload) // 4], payload[: len(payload) // 8]
    with pytest.warns(KeyssWarning, match="notice that there are other secrets"):
        stego = embed(prepared, [("a", large), ("b", small)], entropy=ENTROPY)
    assert extract(stego, "a") == large


@pytest.mark.parametrize("size", [20, 400])
def test_gaussians_that_everybody_finds_are_not_written(prepared: ColoursCover, size: int) -> None:
    """Whoever computes the salts would see noise in exactly these colours."""
    rows = find_salts(prepared.planner.carriers)[0]
    rows = torch.from_numpy(prepared.planner.carriers.rows[rows])
    for seed in range(3):
        stego = embed(prepared, [("a", bytes(size))], entropy=bytes([seed]) * 32)
        assert torch.equal(stego.sh[rows], prepared.cover.sh[rows])
        assert find_salts(Carriers.of(stego))[1] == find_salts(prepared.planner.carriers)[1]


def test_files_of_one_cover_and_one_secret_differ_in_their_payloads(prepared: ColoursCover) -> None:
    """Their headers are in the same Gaussians, partly with equal values, which docs/channels.md tells."""
    first, second = (embed(prepared, [("a", b"same")], entropy=bytes([index]) * 32) for index in range(2))
    secrets = Secrets.of("a", find_salts(prepared.planner.carriers)[1])
    carriers = prepared.planner.carriers
    header = np.unique(np.concatenate([places(each, carriers)[0] for each in secrets.salted]))
    rows = np.delete(carriers.rows, header)
    written = [(each.sh[rows, 0] - prepared.cover.sh[rows, 0])[:, 1:].flatten() for each in (first, second)]
    both = (written[0] != 0) & (written[1] != 0)
    assert abs(np.corrcoef(written[0][both], written[1][both])[0, 1]) < 0.1
    assert float((written[0] == written[1])[both].float().mean()) < 0.01


def enlarged(model: Gaussians, by: float) -> Gaussians:
    return Similarity(by).apply_gaussians(model)


@pytest.mark.parametrize("copies", [1, 2])
def test_a_note_put_into_another_model_is_told(stego: Gaussians, payload: bytes, copies: int) -> None:
    """As specks, which nobody sees."""
    specks = [enlarged(stego, 1e-3)] * copies
    with pytest.warns(KeyssWarning, match="Gaussians were added"):
        assert extract(Gaussians.cat([cover(3000, seed=9), *specks]), "a") == payload


@pytest.mark.parametrize("count", [0, 1, 30, 200])
def test_small_models_are_refused_or_carry(count: int) -> None:
    model = cover(max(count, 1))[:count]
    with pytest.raises(UsageError):
        embed(model, [("a", bytes(100))])
    assert COLOURS.prepare(model).capacity.bytes < 100
    with pytest.raises(WrongKeyError):
        extract(model, "a")


def test_hostile_numbers_end_in_a_typed_error(stego: Gaussians) -> None:
    values = torch.tensor([math.nan, math.inf, -math.inf, 3e38, -3e38, 1e-45, 0.0])
    generator = torch.Generator().manual_seed(0)

    def garbled(tensor: torch.Tensor) -> torch.Tensor:
        hit = torch.rand(tensor.shape, generator=generator) < 0.6
        return torch.where(hit, values[torch.randint(7, tensor.shape, generator=generator)], tensor)

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for _ in range(3):
            with pytest.raises((WrongKeyError, InputError)):
                extract(stego[:800].map(garbled), "a")


def test_equal_gaussians_cost_nothing_but_themselves(stego: Gaussians, payload: bytes) -> None:
    """Each a second time, as where a model is put together with itself."""
    assert extract(Gaussians.cat([stego, stego]), "a") == payload


def test_repeated_and_equal_colours_are_left_alone() -> None:
    model = cover(6000)
    sh = model.sh.clone()
    sh[:100, 0, 1] = sh[200:300, 0, 1]  # as of clones that were never optimised again
    sh[400:500, 0, 2] = sh[400:500, 0, 1]  # grey
    sh[600:700, 0, 1] = 0.25
    model = replace(model, sh=sh)
    stego = embed(model, [("a", bytes(100))], entropy=ENTROPY)
    kept = (stego.sh[:, 0] == sh[:, 0]).all(dim=1)
    for rows in (slice(0, 100), slice(200, 300), slice(400, 500), slice(600, 700)):
        assert float(kept[rows].float().mean()) > 0.98  # salts may lie there
    low = [each.sh[:, 0].numpy().view(np.uint32) & 1023 for each in (model, stego)]
    assert (low[0] == low[1]).mean() > 0.99
    assert extract(stego, "a") == bytes(100)


def test_a_rounded_model_gets_values_that_it_has() -> None:
    model = cover(6000)
    model = replace(model, sh=(model.sh * 60).round() / 60)
    stego = embed(model, [("a", bytes(100))], entropy=ENTROPY)
    assert np.isin(stego.sh[:, 0].numpy(), model.sh[:, 0].numpy()).mean() > 0.99
    assert extract(stego, "a") == bytes(100)


def test_a_wrong_key_does_the_work_of_a_right_one(stego: Gaussians, monkeypatch: pytest.MonkeyPatch) -> None:
    """Counted in searches for places, one for each salt of each header and payload that is looked for."""
    searches = []
    monkeypatch.setattr(header, "places", lambda *args: searches.append(0) or places(*args))
    monkeypatch.setattr(channel, "places", header.places)
    extract(stego, "a")
    right = len(searches)
    with pytest.raises(WrongKeyError):
        extract(stego, "b")
    assert len(searches) == 2 * right


def test_false_acceptance_is_rarer_than_two_to_the_minus_64(monkeypatch: pytest.MonkeyPatch) -> None:
    """By the bound of RFC 8439's Poly1305, 8 blocks / 2^106 for each forgery that is tried, for the largest
    payload there can be, and as often as a reader tries to decrypt.
    """
    stego = embed(cover(6000), [("a", b"x")], entropy=bytes(32))
    sizes, unseal = [], container.unseal

    def counted(data_key: bytes, sealed: bytes) -> bytes:
        sizes.append(len(sealed))
        unseal(data_key, sealed) if len(sizes) == 1 else None
        raise InputError("so that all is tried that ever is")

    monkeypatch.setattr(container, "unseal", counted)
    for name in "ab":
        with pytest.raises(Exception, match="the key is right" if name == "a" else "opens nothing"):
            extract(stego, name)
    assert 1 <= len(sizes) <= 8
    largest = max(header.bucket_bytes(bucket) for bucket in range(256))
    assert math.log2(len(sizes) * 8 * (largest / 16) / 2**106) < -64
