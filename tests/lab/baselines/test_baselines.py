"""Each baseline hides, is measured, and opens again from its files."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest
import torch

import keyss
from cli.harness import Run, assert_refused
from keyss import FitConfig, Secret
from keyss.core import DecodedGaussians, InputError, Similarity, UsageError
from keyss.fitting import State
from keyss.lab import BaselineOptions
from keyss.lab.audits import audit
from keyss.methods import KeyssTraining, PlacedScene, registry
from keyss.runs import stego_in
from keyss.runs.files import companion_names
from test_api import psnr_of_pictures
from tiny_scenes import random_gaussians, tiny_scene

FIT = FitConfig(iterations=120, max_gaussians=300, sh_degree=1, grow_every=30, evaluate_every=60, seed=0)
TRAINED = ["3dgs-sh", "3dgs-decoder", "watergs", "gs-hider"]
BASELINES = ["3dgs", *TRAINED]
KEY = "a key of many characters: 93hXmQ2"  # baselines have none


def options_of(name: str, **changes: Any) -> BaselineOptions:
    """Small enough for seconds."""
    found: Any = registry.get(name).options
    return replace(found(fit=FIT, common_poses=0.5), **changes)  # type: ignore[no-any-return]


@dataclass(frozen=True)
class Made:
    """A hiding of tiny scenes."""

    name: str
    out: Path
    result: keyss.HideResult

    @property
    def companion(self) -> Path:
        return self.out / companion_names(1)[0]


@pytest.fixture(scope="module", params=BASELINES)
def made(
    request: pytest.FixtureRequest, folders: tuple[Path, Path], tmp_path_factory: pytest.TempPathFactory
) -> Made:
    name, out = request.param, tmp_path_factory.mktemp("runs") / "run"
    secret = Secret(folders[1])
    result = keyss.hide(folders[0], [secret], method=options_of(name), min_psnr=0, out=out)
    return Made(name, out, result)


def test_files_and_metrics_of_a_hiding(made: Made) -> None:
    files = {str(path.relative_to(made.out)) for path in made.out.rglob("*") if path.is_file()}
    assert files == {
        str(stego_in(made.out).relative_to(made.out)),
        *companion_names(1),
        *(f"private/{name}" for name in ("config.json", "metrics.json", "manifest.json")),
        *(f"private/{name}.ply" for name in ("cover", "secret-1")),
        "private/look.png",
    }
    assert keyss.evaluate(made.out, []) == made.result.metrics
    assert made.result.metrics.method == made.name
    for each in made.result.metrics.against_plain:
        assert each.psnr > each.nothing + 5


def test_published_and_companion_file_reveal_the_secret(
    made: Made, folders: tuple[Path, Path], tmp_path: Path
) -> None:
    standard = registry.get(made.name).capabilities.standard
    decoded = made.name in ("3dgs-decoder", "gs-hider")  # a network renders the secret
    stego = stego_in(made.out)
    assert (stego.suffix == ".ply") == standard
    out = tmp_path / ("secret.3dgs.safetensors" if decoded else "secret.ply")
    keyss.reveal(stego, companion=made.companion, out=out)
    assert isinstance(keyss.read_model(out), DecodedGaussians) == decoded
    psnr = psnr_of_pictures(out, folders[1])
    assert psnr == pytest.approx(made.result.metrics.secrets[0].psnr, abs=0.1)
    if decoded:
        with pytest.raises(UsageError, match="network"):
            keyss.reveal(stego, companion=made.companion, out=tmp_path / "secret.ply")
    with pytest.raises(UsageError, match="no keys"):
        keyss.reveal(stego, KEY, companion=made.companion)
    with pytest.raises(UsageError, match="no keys"):
        keyss.evaluate(made.out, [KEY])


@pytest.mark.parametrize("at", [0, 31, -1])
def test_truncated_files_are_refused(made: Made, tmp_path: Path, at: int) -> None:
    path = tmp_path / "truncated.keyss"
    path.write_bytes(made.companion.read_bytes()[:at])
    with pytest.raises(InputError):
        keyss.reveal(stego_in(made.out), companion=path)


def test_command_line(keyss: Run, made: Made, tmp_path: Path) -> None:
    said = keyss("evaluate", made.out)
    assert f"{made.result.metrics.secrets[0].psnr:.2f}" in said.out
    assert made.name in keyss("info", made.out).out
    stego = stego_in(made.out)
    assert_refused(keyss("reveal", stego, "--companion", stego, "-o", tmp_path / "b.ply"), 4, "`.keyss` file")


def test_invalid_arguments(folders: tuple[Path, Path]) -> None:
    with pytest.raises(UsageError, match="no keys"):
        keyss.hide(folders[0], [Secret(folders[1], KEY)], method="3dgs-sh")
    with pytest.raises(UsageError, match="1 to 1 secrets"):
        keyss.hide(folders[0], [Secret(folders[1]), Secret(folders[0])], method="3dgs-sh")
    with pytest.raises(UsageError, match="publish"):
        options_of("gs-hider", publish="converted")
    with pytest.raises(UsageError, match="key is empty"):
        keyss.hide(folders[0], [Secret(folders[1])], method="carry")


@pytest.mark.parametrize("name", [*TRAINED[:3], pytest.param("gs-hider", marks=pytest.mark.slow)])
def test_resumed_training_is_bit_identical(name: str) -> None:
    """All state is in checkpoints: parameters that a baseline adds, networks, moments, the order of poses."""
    scenes = [tiny_scene(0), tiny_scene(1)]
    placed = [PlacedScene.of(scene, random_gaussians(50), Similarity()) for scene in scenes]
    method: Any = registry.get(name)
    whole, resumed = (method.training(placed, [], options_of(name), torch.device("cpu")) for _ in range(2))

    def run_to(run: KeyssTraining, end: int) -> State:
        torch.manual_seed(run.iteration)  # which `train` keeps
        while run.iteration < end:
            run.step()
        return {key: value.clone() for key, value in run.state().items()}

    resumed.load(run_to(whole, 70))
    resumed.iteration = 70
    ends = [run_to(run, 90) for run in (whole, resumed)]
    assert ends[0].keys() == ends[1].keys()
    for key, value in ends[0].items():
        assert torch.equal(value, ends[1][key]), key
    assert whole.evaluate() == resumed.evaluate()


def test_audit_of_methods_with_networks(made: Made) -> None:
    if made.name not in ("3dgs-decoder", "gs-hider"):  # the others are 3DGS models throughout
        return
    standard = registry.get(made.name).capabilities.standard
    if not standard:
        with pytest.raises(UsageError, match="not publish a 3DGS model"):
            audit(made.out, [], only=["images", "stealth"])
    found = audit(made.out, [], only=["images", "speed"], controls=2)
    revealed = found.sections["images"].numbers["secret, revealed"]
    assert revealed["psnr"] == pytest.approx(made.result.metrics.secrets[0].psnr, abs=0.1)
    assert "Not measured" in (made.out / "private" / "report.md").read_text()
