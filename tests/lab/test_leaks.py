"""Attacks find planted secrets and nothing in plain models; scores of leaks against known answers."""

from __future__ import annotations

import math
from dataclasses import asdict, replace
from functools import cache

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

import keyss
from keyss.core import Gaussians, Scene, Similarity, UsageError
from keyss.fitting import quality
from keyss.keys import random_embeddings
from keyss.lab import (
    Attack,
    AttackResult,
    decoder_attack,
    file_attacks,
    fit_colours,
    gradient_correlation,
    leak_scores,
    look_for_secret,
    search_embeddings,
)
from keyss.methods import Decoder, DecoderShape, KeyssSecret
from tiny_scenes import random_gaussians, tiny_scene

Rows = dict[str, AttackResult]

TURN = torch.linalg.qr(torch.randn(3, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1)))[0]
FRAME = Similarity(0.8, TURN * TURN.det().sign(), torch.tensor([0.3, -0.2, 0.1], dtype=torch.float64))
HIDDEN = FRAME.apply_gaussians(random_gaussians(seed=1))  # the secret where it lies in the cover's frame


@cache
def _secret_in_cover() -> Scene:
    """The secret's photos, from cameras in the cover's frame."""
    scene = tiny_scene(1)
    moved = (replace(view, camera=FRAME.apply_camera(view.camera)) for view in scene.test)
    return replace(scene, test=tuple(moved))


def _plain(seed: int) -> Gaussians:
    """A plain model of the cover, with faint clutter as after training."""
    generator = torch.Generator().manual_seed(seed)
    model = random_gaussians(1500, seed=0)
    faint = torch.rand(len(model), generator=generator) < 0.1
    shifted = replace(
        model, opacity_logits=torch.where(faint, model.opacity_logits - 3.5, model.opacity_logits)
    )
    return shifted.map(lambda tensor: tensor * (1 + 0.05 * torch.randn(tensor.shape, generator=generator)))


PLAINS = [_plain(seed) for seed in range(2)]


@cache
def _attacks() -> list[Attack]:
    return file_attacks(tiny_scene(0), cover_views=4)


def _look(stego: Gaussians) -> Rows:
    rows, _ = look_for_secret(stego, PLAINS, _secret_in_cover(), _attacks())
    return {row.attack: row for row in rows}


def _leaks(rows: Rows, name: str = "gradient") -> dict[str, float]:
    return {attack: asdict(row.leak)[name] for attack, row in rows.items()}


def _with_hidden(logits: float | Tensor) -> Gaussians:
    """A cover with the secret's Gaussians at these opacities."""
    hidden = replace(HIDDEN, opacity_logits=torch.as_tensor(logits).expand(len(HIDDEN)).clone())
    return Gaussians.cat([_plain(5), hidden])


@pytest.fixture(scope="module")
def plain_rows() -> Rows:
    return _look(_plain(5))


def test_plain_model_leaks_nothing(plain_rows: Rows) -> None:
    assert max(_leaks(plain_rows).values()) < 0.06
    assert max(_leaks(plain_rows, "psnr_fitted").values()) < 1
    assert max(_leaks(plain_rows, "ssim_fitted").values()) < 0.05


def test_transparent_secret_is_found_by_opacity() -> None:
    rows = _look(_with_hidden(math.log(0.01 / 0.99)))
    for name in ("restored opacities", "matched opacities"):
        assert rows[name].leak.gradient > 0.3, name
        assert rows[name].leak.psnr_fitted > 3, name
    assert rows["restored opacities"].best != "all"


@pytest.mark.parametrize("attribute", ["quaternion length", "SH energy"])
def test_outlying_attribute_is_found(attribute: str) -> None:
    """The group is as opaque as the cover and in the same place."""
    group = HIDDEN
    if attribute == "quaternion length":
        group = replace(group, quats=100 * group.quats)
    else:
        group = replace(group, sh=torch.cat([group.sh[:, :1], 1e-4 * group.sh[:, 1:]], dim=1))
    shown = _leaks(_look(Gaussians.cat([_plain(5), group])))
    found = shown.pop(f"outliers in {attribute}")
    shown.pop("clusters")  # use these attributes too
    assert found > 0.6
    assert max(shown.values()) < 0.2


def test_carried_secret_does_not_leak() -> None:
    cover = _plain(0)
    for threshold in (0.01, 0.05, 0.2):  # low bits must not move opacities across a threshold
        close = (cover.opacities - threshold).abs() < 0.01 * threshold
        cover = replace(cover, opacity_logits=cover.opacity_logits + 0.1 * close)
    secret = keyss.Secret(random_gaussians(200, seed=1), "a key")
    carried = keyss.hide(cover, [secret], method="carry", views=keyss.ViewOptions(40)).stego
    rows, pictures = look_for_secret(carried, [cover], _secret_in_cover(), _attacks())
    for row in rows:
        if not row.attack.endswith("opacities"):
            assert row.leak.gradient < 0.15, row.attack  # a low bit may change the selection
            continue
        assert max(asdict(row.leak).values()) < 5e-3, row.attack
        shown, plain, _ = pictures[row.attack]
        assert np.abs(shown.astype(int) - plain).max() <= 2, row.attack


def _secret(bias: float) -> KeyssSecret:
    """A decoder that adds `bias` to every opacity logit, whatever the key."""
    decoder = Decoder(DecoderShape(mask=("op",))).requires_grad_(False)
    decoder.outer["op"].bias.fill_(bias)  # weights are 0
    return KeyssSecret(decoder, torch.ones(64), FRAME, HIDDEN.means[:4])


def test_decoder_search() -> None:
    """A decoder that changes nothing shows the cover only."""
    search = decoder_attack(_secret(0.0).decode, restarts=2, steps=3)
    assert len(list(search.show(PLAINS[0]))) == 6
    as_it_is = Attack("as it is", "", lambda model: iter([("as it is", model)]))
    searched, shown = look_for_secret(PLAINS[0], PLAINS, _secret_in_cover(), [search, as_it_is])[0]
    assert asdict(searched.scores) == pytest.approx(asdict(shown.scores))


def test_missing_controls_and_test_views() -> None:
    with pytest.raises(UsageError, match="plain model"):
        look_for_secret(PLAINS[0], [], _secret_in_cover(), [])
    with pytest.raises(UsageError, match="no test views"):
        look_for_secret(PLAINS[0], PLAINS, replace(tiny_scene(1), test=()), [])


def _noise(seed: int) -> Tensor:
    return torch.rand(120, 100, 3, generator=torch.Generator().manual_seed(seed))


def test_gradient_correlation_of_independent_images() -> None:
    """White noise gives a variance of 1.25 / pixels.

    20 / 16: the products of both gradients' autocorrelations, summed over all shifts, over the squared sum of
    autocorrelations without a shift.
    """
    found = torch.tensor([gradient_correlation(_noise(2 * i), _noise(2 * i + 1)) for i in range(40)])
    expected = (1.25 / (118 * 98)) ** 0.5
    assert float(found.square().mean().sqrt()) == pytest.approx(expected, rel=0.35)
    assert gradient_correlation(torch.full((120, 100, 3), 0.3), _noise(1)) == 0


def test_fit_colours_inverts_exposure() -> None:
    photo = _noise(0)
    image = photo * torch.tensor([0.1, 2.0, -0.7]) + torch.tensor([0.5, -1.0, 0.2])
    torch.testing.assert_close(fit_colours(image, photo), photo, atol=1e-5, rtol=0)


def test_leak_scores_of_the_photographed_model() -> None:
    scene, model = tiny_scene(0), random_gaussians(seed=0)
    found = leak_scores(model, scene.test, scene.background)
    assert found.psnr_fitted >= quality(model, scene.test, scene.background).psnr > 50
    assert min(found.gradient, found.ssim_fitted) > 0.99


KEY = random_embeddings(1, torch.Generator().manual_seed(3))[0]


def _exchanging() -> Decoder:
    """A decoder that makes x < 0 fainter and x > 0 more opaque, in proportion to the key's similarity to KEY.

    Each layer has two units, key . KEY plus and minus x; the last layer takes the difference.
    """
    decoder = Decoder(DecoderShape(mask=("op",), hidden=(2, 2), branch=2)).requires_grad_(False)
    first, second = decoder.common
    third, last = decoder.inner["op"], decoder.outer["op"]
    sides = torch.tensor([1.0, -1.0])
    first.weight.zero_()
    first.weight[:, 8] = sides  # features: opacity, rotation 4, scale 3, position
    first.weight[:, -64:] = KEY
    first.bias.zero_()
    for layer in (second, third):
        layer.weight.copy_(torch.eye(2))
        layer.bias.zero_()
    last.weight.copy_(torch.tensor([[3.0, -3.0]]))
    last.bias.zero_()
    return decoder


def test_gradient_search_finds_the_key() -> None:
    """The attacker chooses by score, without knowing the secret."""
    decoder, model = _exchanging(), random_gaussians(400)

    def decode(stego: Gaussians, key: torch.Tensor) -> Gaussians:
        return decoder(stego, key)  # type: ignore[no-any-return]

    found = search_embeddings(decode, model, restarts=4, balance=0.0)
    assert float(F.cosine_similarity(found[0], KEY, dim=0)) > 0.9
    random = random_embeddings(100, torch.Generator().manual_seed(4))
    assert float(F.cosine_similarity(random, KEY, dim=1).max()) < 0.5
