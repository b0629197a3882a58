"""Scores of leaks: known answers."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from keyss.fitting import psnr, quality
from keyss.measure import coarse, fit_colours, gradient_correlation, leak_scores
from tiny_scenes import random_gaussians, tiny_scene


def _noise(seed: int) -> Tensor:
    return torch.rand(120, 100, 3, generator=torch.Generator().manual_seed(seed))


def test_an_image_has_the_gradients_of_itself_and_its_negative_the_opposite() -> None:
    image = _noise(0)
    assert gradient_correlation(image, image) == pytest.approx(1)
    assert gradient_correlation(1 - image, image) == pytest.approx(-1)


def test_independent_images_have_independent_gradients() -> None:
    """Of white noise the correlation has the variance 1.25 / pixels: the sum over all shifts of the products
    of the autocorrelations of both gradients, 20, by the square of their sum at no shift, 16."""
    found = torch.tensor([gradient_correlation(_noise(2 * i), _noise(2 * i + 1)) for i in range(40)])
    expected = (1.25 / (118 * 98)) ** 0.5
    assert float(found.square().mean().sqrt()) == pytest.approx(expected, rel=0.35)
    assert gradient_correlation(torch.full((120, 100, 3), 0.3), _noise(1)) == 0


def test_gradients_are_blind_to_exposure() -> None:
    assert gradient_correlation(0.2 * _noise(0) + 0.7, _noise(0)) == pytest.approx(1, abs=1e-6)


def test_the_gradients_of_a_sum_share_their_energy() -> None:
    """Two independent images of equal energy: the sum has the correlation 1 / sqrt(2) with each."""
    assert gradient_correlation(_noise(0) + _noise(1), _noise(0)) == pytest.approx(0.5**0.5, abs=0.02)


def test_ramps_at_an_angle_correlate_by_its_cosine() -> None:
    y, x = torch.meshgrid(torch.arange(20.0), torch.arange(30.0), indexing="ij")
    straight, tilted = x[:, :, None].expand(-1, -1, 3), (x + 3**0.5 * y)[:, :, None].expand(-1, -1, 3)
    assert gradient_correlation(straight, tilted) == pytest.approx(0.5)


def test_coarse_images_are_means_over_blocks_and_keep_their_shape() -> None:
    image = torch.rand(192, 96, 3, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(coarse(image), image.reshape(64, 3, 32, 3, 3).mean(dim=(1, 3)))
    assert coarse(image[:, :70]).shape == (64, 23, 3)
    assert torch.equal(coarse(_noise(1)[:50, :64]), _noise(1)[:50, :64])


def test_what_is_out_of_place_by_a_little_is_seen_in_coarse_images_alone() -> None:
    shapes = (
        coarse(_noise(3)[:, :, :1].expand(-1, -1, 3))[:16, :12]
        .repeat_interleave(20, 0)
        .repeat_interleave(20, 1)
    )
    lines = torch.zeros(320, 240, 3)
    lines[::5] = 0.5
    image, photo = shapes + lines.roll(2, 0), shapes + lines
    assert gradient_correlation(image, photo) < 0.1
    assert gradient_correlation(coarse(image), coarse(photo)) > 0.9


def test_fitting_undoes_any_exposure_of_each_channel() -> None:
    photo = _noise(0)
    image = photo * torch.tensor([0.1, 2.0, -0.7]) + torch.tensor([0.5, -1.0, 0.2])
    torch.testing.assert_close(fit_colours(image, photo), photo, atol=1e-5, rtol=0)


def test_fitting_a_constant_gives_the_mean_colour_and_no_picture_fits_worse() -> None:
    photo = _noise(0)
    mean = photo.mean(dim=(0, 1)).expand_as(photo)
    torch.testing.assert_close(fit_colours(torch.zeros_like(photo), photo), mean)
    for image in (_noise(1), 1e-9 * _noise(2)):
        assert psnr(fit_colours(image, photo), photo) >= psnr(mean, photo) - 1e-4


def test_the_photographed_model_scores_best() -> None:
    scene, model = tiny_scene(0), random_gaussians(seed=0)
    found = leak_scores(model, scene.test, scene.background)
    assert found.psnr_fitted >= quality(model, scene.test, scene.background).psnr > 50
    assert min(found.gradient, found.gradient_coarse, found.ssim_fitted) > 0.99


def test_a_darker_copy_is_found_by_the_fitted_scores_alone() -> None:
    scene, model = tiny_scene(0), random_gaussians(seed=0)
    dark = tiny_scene(0)
    views = [type(view)(view.camera, view.image // 4) for view in dark.test]
    assert quality(model, views, scene.background).psnr < 15
    assert leak_scores(model, views, scene.background).psnr_fitted > 35
