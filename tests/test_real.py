"""A small real scene in another, and public models in each other (`make test-real`)."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import keyss
from keyss import Gaussians, Secret
from keyss.cli import main
from test_api import psnr_of_pictures

pytestmark = pytest.mark.real
WIDTH = 100
MODELS = ("biker", "guitar", "inria_cuda_7000", "playbot_lod2", "playbot_lod4")


def run(*arguments: object) -> None:
    assert main([str(argument) for argument in arguments]) == 0


def test_hide_fox_in_bonsai(real_data: Path, tmp_path: Path) -> None:
    bonsai, fox = real_data / "bonsai", real_data / "fox"
    key, other, out = tmp_path / "key", tmp_path / "other", tmp_path / "run"
    for file, text in ((key, "a key for a small fox"), (other, "a key for nothing here")):
        file.write_text(text)
        file.chmod(0o600)
    run(
        *("hide", "--cover", bonsai, "--secret", fox, "--key-file", key, "-o", out),
        *("--width", WIDTH, "--max-gaussians", 4000, "--iterations", 300, "--seed", 0),
    )
    run("reveal", out / "publish" / "model.ply", "--key-file", key, "-o", tmp_path / "fox.ply")
    run("evaluate", out, "--key-file", key)
    metrics = json.loads((out / "private" / "metrics.json").read_text())
    cover = psnr_of_pictures(out / "publish" / "model.ply", bonsai, WIDTH)
    secret = psnr_of_pictures(tmp_path / "fox.ply", fox, WIDTH)
    assert cover == pytest.approx(metrics["cover"]["psnr"], abs=0.1)
    assert secret == pytest.approx(metrics["secrets"][0]["psnr"], abs=0.1)
    assert cover > 19.1  # 20.1 was measured, and 22.9 for the secret
    assert secret > 21.9
    assert psnr_of_pictures(out / "publish" / "model.ply", fox, WIDTH) < 9  # no fox without the key
    stego = out / "publish" / "model.ply"
    assert main(["reveal", str(stego), "--key-file", str(other), "-o", str(tmp_path / "no.ply")]) == 3
    assert not (tmp_path / "no.ply").exists()


@pytest.fixture(scope="module")
def models(real_data: Path) -> dict[str, Gaussians]:
    return {name: keyss.read_model(real_data / "splats" / f"{name}.ply") for name in MODELS}


@pytest.mark.filterwarnings("ignore::keyss.core.KeyssWarning")
@pytest.mark.parametrize(
    ("cover", "secret", "minimum"),
    [
        ("inria_cuda_7000", "playbot_lod4", (80, 30)),  # unnoticed, and so without its harmonics
        ("inria_cuda_7000", "inria_cuda_7000", (80, 40)),
        ("playbot_lod2", "inria_cuda_7000", (48, 50)),
        ("guitar", "playbot_lod4", (55, 45)),
        ("biker", "guitar", (55, 35)),
        ("playbot_lod4", "biker", (40, 40)),
    ],
)
def test_quality_between_public_models(
    models: dict[str, Gaussians], cover: str, secret: str, minimum: tuple[float, float]
) -> None:
    """PSNR in dB against renders of the models themselves."""
    metrics = keyss.hide(
        models[cover], [Secret(models[secret], "a key for a model")], views=keyss.ViewOptions(200)
    ).metrics
    psnrs = [each.psnr for each in metrics.against_plain]
    assert psnrs[0] > minimum[0], psnrs
    assert psnrs[1] > minimum[1], psnrs
