"""Public models as people have them, in each other, by the defaults."""

from __future__ import annotations

from pathlib import Path

import pytest

import keyss
from keyss import CarryOptions, Gaussians, Secret
from keyss.methods import MethodOptions

pytestmark = pytest.mark.real
NAMES = ("biker", "guitar", "inria_cuda_7000", "playbot_lod2", "playbot_lod4")


KEY = "a key of many characters: 93hXmQ2"


@pytest.fixture(scope="module")
def models(real_data: Path) -> dict[str, Gaussians]:
    return {name: keyss.read_model(real_data / "splats" / f"{name}.ply") for name in NAMES}


@pytest.mark.filterwarnings("ignore::keyss.core.KeyssWarning")
@pytest.mark.parametrize(
    ("cover", "secret", "options", "least"),
    [
        ("inria_cuda_7000", "playbot_lod4", CarryOptions(), (80, 40)),
        ("inria_cuda_7000", "inria_cuda_7000", CarryOptions(), (80, 40)),
        ("playbot_lod2", "inria_cuda_7000", CarryOptions(), (48, 50)),
        ("guitar", "playbot_lod4", CarryOptions(), (55, 45)),
        ("biker", "guitar", CarryOptions(), (55, 35)),
        ("playbot_lod4", "biker", CarryOptions(), (40, 40)),
    ],
)
def test_quality_between_public_models(
    models: dict[str, Gaussians], cover: str, secret: str, options: MethodOptions, least: tuple[float, float]
) -> None:
    """PSNR in dB against renders of the models themselves."""
    metrics = keyss.hide(models[cover], [Secret(models[secret], KEY)], method=options, width=200).metrics
    found = [each.psnr for each in metrics.against_plain]
    assert found[0] > least[0], found
    assert found[1] > least[1], found
