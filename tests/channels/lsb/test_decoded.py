"""Models that were decoded from a .spz, .sog or compressed .ply carry in its quantised values."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from channels.lsb.quantised import FORMATS, model_of
from channels.lsb.trained_like import trained_like
from keyss.channels import LOW_BITS, Payload, channel_for, open_payload
from keyss.channels.lsb.decoded import Decoded
from keyss.core import Gaussians, UsageError
from keyss.files import read_model, write_model

EVERY = pytest.mark.parametrize("suffix", FORMATS)
DATA = bytes(range(256))


def decoded_model(suffix: str, count: int = 6000, seed: int = 0) -> Gaussians:
    return FORMATS[suffix].of(model_of(count, seed)).dequantise()  # type: ignore[no-any-return]


def hidden_in(model: Gaussians, entropy: bytes = bytes(32)) -> Gaussians:
    channel = channel_for("unchanged", cover=model)
    return channel.prepare(model).embed([("a key", Payload("carry", DATA))], entropy=entropy)


def opened(model: Gaussians) -> bytes:
    return open_payload(model, "a key").data


@EVERY
def test_a_ply_of_decoded_codes_opens(suffix: str, tmp_path: Path) -> None:
    write_model(tmp_path / "cover.ply", decoded_model(suffix))
    write_model(tmp_path / "stego.ply", hidden_in(read_model(tmp_path / "cover.ply")))
    assert opened(read_model(tmp_path / "stego.ply")) == DATA


@EVERY
def test_the_published_model_is_one_that_was_decoded(suffix: str) -> None:
    """Each of its numbers is exactly what some codes decode to, as often as in the cover; low bits tell."""
    cover = decoded_model(suffix)
    stego = hidden_in(cover)
    before, after = Decoded.of(cover), Decoded.of(stego)
    assert type(after.codes) is type(before.codes)
    assert after.exact.sum() == before.exact.sum()
    again = after.codes.dequantise()
    exact = torch.from_numpy(after.exact)
    for name in ("means", "log_scales"):
        assert torch.equal(getattr(stego, name)[exact], getattr(again, name)[exact])
    signs = (stego.quats * again.quats).sum(1, keepdim=True).sign()
    assert torch.equal(stego.quats[exact], (signs * again.quats)[exact])
    with pytest.raises(UsageError):
        LOW_BITS.prepare(cover)


@EVERY
def test_what_carries_nothing_stays_to_the_bit(suffix: str) -> None:
    """Harmonics, opacities and extra turns of quaternions are the cover's, row by row."""
    cover = decoded_model(suffix)
    flipped = torch.arange(len(cover)) % 3 == 0
    cover = replace(cover, quats=torch.where(flipped[:, None], -cover.quats, cover.quats))
    stego = hidden_in(cover)
    kept = [torch.cat([each.opacity_logits[:, None], each.sh.flatten(1)], dim=1) for each in (stego, cover)]
    assert torch.equal(*(each.unique(dim=0, return_counts=True)[0] for each in kept))
    assert torch.equal(*(each.unique(dim=0, return_counts=True)[1] for each in kept))
    largest = [each.quats.gather(1, each.quats.abs().argmax(1, keepdim=True)) < 0 for each in (stego, cover)]
    assert largest[0].sum() == largest[1].sum()


def test_shuffled_gaussians_of_a_sog_open() -> None:
    stego = hidden_in(decoded_model(".sog"))
    assert opened(stego[torch.randperm(len(stego), generator=torch.Generator().manual_seed(0))]) == DATA


def test_an_order_of_its_own_stays() -> None:
    cover = decoded_model(".sog")
    cover = cover[torch.randperm(len(cover), generator=torch.Generator().manual_seed(0))]
    stego = hidden_in(cover)
    assert torch.equal(stego.opacity_logits, cover.opacity_logits)
    assert torch.equal(stego.log_scales, cover.log_scales)


@pytest.mark.parametrize("count", [1, 7, 300, 4000])
def test_trained_models_are_not_taken_for_decoded_ones(count: int) -> None:
    model = trained_like(count)
    assert Decoded.of(model) is None
    levels = (255 * model.opacity_logits.sigmoid()).round().clamp(1, 254) / 255
    assert Decoded.of(replace(model, opacity_logits=levels.logit())) is None  # rounded in another way


def test_a_part_of_a_compressed_ply_has_no_chunks_any_more() -> None:
    assert Decoded.of(decoded_model(".compressed.ply")[::2]) is None


@pytest.mark.parametrize("suffix", [".spz", ".compressed.ply"])
def test_what_splat_transform_decodes_opens(
    suffix: str, splat_transform: Callable[..., Path], tmp_path: Path
) -> None:
    write_model(tmp_path / "trained.ply", model_of(3000))
    coded = splat_transform(tmp_path / "trained.ply", tmp_path / f"coded{suffix}")
    cover = read_model(splat_transform(coded, tmp_path / "cover.ply"))
    found = Decoded.of(cover)
    assert type(found.codes) is FORMATS[suffix]
    write_model(tmp_path / "stego.ply", hidden_in(cover))
    assert opened(read_model(tmp_path / "stego.ply")) == DATA
