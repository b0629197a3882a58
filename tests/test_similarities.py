"""Fits and hiding are invariant to similarity transforms, or refuse with a reason."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from scipy.spatial.transform import Rotation

import keyss
from keyss import FitConfig, Secret
from keyss.core import KeyssWarning, Scene, Similarity, UsageError
from keyss.files import load_scene
from keyss.fitting import mean_psnr
from test_api import write_nerfstudio
from tiny_scenes import random_gaussians, tiny_scene

TURN = Rotation.from_rotvec([0.3, -0.8, 1.9]).as_matrix()
WORLDS = {
    "UTM": ((456_789.0, 5_412_345.0, 120.0), 1.0),
    "tiny": ((0.0, 0.0, 0.0), 1e-4),
    "small and far": ((1e7, 0.0, 0.0), 0.01),
}
KEY = "a key of many characters: 93hXmQ2"


def load_moved(folder: Path, shift: tuple[float, ...] = (0.0, 0.0, 0.0), scale: float = 1.0) -> Scene:
    written = write_nerfstudio(folder, tiny_scene(), shift=shift, scale=scale, rotation=TURN, points=True)
    return load_scene(written)


def psnr_of_fit(scene: Scene) -> float:
    config = FitConfig(iterations=150, max_gaussians=300, seed=0)
    return mean_psnr(keyss.fit(scene, config=config).gaussians, scene.test, scene.background)


@pytest.fixture(scope="module")
def reference_psnr(tmp_path_factory: pytest.TempPathFactory) -> float:
    return psnr_of_fit(load_moved(tmp_path_factory.mktemp("worlds") / "usual"))


@pytest.mark.filterwarnings("ignore::keyss.core.KeyssWarning")
@pytest.mark.parametrize("world", WORLDS)
def test_fit_is_invariant_to_similarities(world: str, reference_psnr: float, tmp_path: Path) -> None:
    moved = load_moved(tmp_path / "moved", *WORLDS[world])
    assert abs(psnr_of_fit(moved) - reference_psnr) < 0.3


def test_distant_scene_is_recentred(tmp_path: Path) -> None:
    shift, scale = WORLDS["UTM"]
    with pytest.warns(KeyssWarning, match=r"moved by minus \(45678\d, 541234\d, "):
        scene = load_moved(tmp_path / "scene", shift, scale)
    assert (scene.origin - torch.tensor(shift, dtype=torch.float64)).norm() < 10
    local = random_gaussians()
    far = Similarity(1.0, translation=scene.origin).apply_gaussians(local)
    for model in (local, far):
        assert (scene.to_scene_frame(model).means - local.means).abs().max() < 1  # single precision far out


@pytest.mark.parametrize(("publish", "scale"), [("unchanged", 1e-4), ("unchanged", 1e6), ("converted", 1e6)])
def test_hide_at_any_scale(publish: str, scale: float) -> None:
    cover = Similarity(scale).apply_gaussians(random_gaussians(2500, seed=1))
    noise = torch.Generator().manual_seed(0)
    cover = cover.map(lambda v: (v * (1 + 1e-6 * torch.randn(v.shape, generator=noise))).float())
    secret = random_gaussians(100, seed=2)
    hidden = keyss.hide(cover, [Secret(secret, KEY)], publish=publish, views=keyss.ViewOptions(64))  # type: ignore[arg-type]
    assert hidden.metrics.against_plain[0].psnr > 60
    assert hidden.metrics.cover.ssim > 0.99
    assert len(keyss.reveal(hidden.stego, KEY).gaussians) == 100


def test_distant_model_is_refused() -> None:
    cover = Similarity(1.0, translation=torch.tensor([456_789.0, 5_412_345.0, 0.0])).apply_gaussians(
        random_gaussians(500)
    )
    with pytest.raises(UsageError, match=r"splat-transform .* -t 45678"):
        keyss.hide(
            cover, [Secret(random_gaussians(20), KEY)], publish="converted", views=keyss.ViewOptions(24)
        )
