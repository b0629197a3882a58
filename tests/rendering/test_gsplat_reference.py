"""The CUDA backend without a GPU: gsplat with its reference implementation in place of its kernels.

`make test-cuda` tests the kernels themselves.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from channels.lsb.trained_like import trained_like
from fitting.small_trainings import FIT, training
from keyss import CarryOptions, Secret, hide, reveal
from keyss.methods import DESIGNS, registry
from keyss.runs import stego_in
from methods.keyss.small import small
from rendering.fake_cuda import GpuTensor, fake_cuda
from rendering.gsplat_reference import COMPILED, NERFACC
from rendering.scenes import SCENES, random_scene
from rendering.test_cuda import IMAGE_ERROR, check_backends_agree, results_on
from tiny_scenes import tiny_scene

KEY = "a key of the tests: 3kV-9q"
STEPS = replace(FIT, iterations=4, max_gaussians=300, sh_degree=3, grow_stop=0.8, grow_every=2)
BASELINES = [
    name for name, where in registry.METHODS.items() if ".baselines." in where.hiding and name != "3dgs"
]
OTHERS = [name for name in (*DESIGNS, *BASELINES) if name != "published"]


@pytest.fixture
def gpu(monkeypatch: pytest.MonkeyPatch) -> Iterator[torch.device]:
    monkeypatch.setitem(sys.modules, "gsplat.cuda._backend", SimpleNamespace(_C=COMPILED))
    monkeypatch.setitem(sys.modules, "nerfacc", NERFACC)
    monkeypatch.setattr("keyss.rendering.rasterize._require_gsplat", lambda: None)
    with fake_cuda() as device:
        yield device


@pytest.mark.parametrize("name", SCENES)
def test_backends_agree(name: str, gpu: torch.device) -> None:
    check_backends_agree(SCENES[name](), gpu)


def test_double_precision(gpu: torch.device) -> None:
    scene = random_scene()
    leaves = {
        name: leaf.detach().to(gpu).requires_grad_() for name, leaf in scene.leaves(torch.float64).items()
    }
    found, expected = scene.results(leaves), scene.results(scene.leaves(torch.float64))
    assert found["image"].dtype == torch.float32
    assert found["gradient of means"].dtype == torch.float64
    assert (found["image"].cpu() - expected["image"]).abs().max() <= IMAGE_ERROR


def test_no_visible_gaussians(gpu: torch.device) -> None:
    scene = random_scene()
    scene.means[:, 2] -= 100
    results = results_on(gpu, scene)
    assert not results["radii"].any()
    assert torch.equal(results["image"], scene.background.float().expand(40, 48, 3))


@pytest.mark.parametrize(
    "name", ["plain", "published", *(pytest.param(name, marks=pytest.mark.slow) for name in OTHERS)]
)
def test_training_gradients_match_cpu(name: str, gpu: torch.device) -> None:
    here, there = (training(name, STEPS, device) for device in (torch.device("cpu"), gpu))
    for run in (here, there):
        torch.manual_seed(0)
        with torch.no_grad():
            for (
                parameter
            ) in run.parameters.values():  # scales of equal length leave rotations without gradients
                parameter += 0.05 * torch.randn(parameter.shape).to(parameter.device)
        run.step()
    assert abs(float(there.loss) - float(here.loss)) < 1e-5
    assert here.optimizers.keys() == there.optimizers.keys()
    for part, optimizer in here.optimizers.items():
        (expected,) = optimizer.state.values()  # moments are linear in the gradients
        (found,) = there.optimizers[part].state.values()
        assert isinstance(found["exp_avg"], GpuTensor)
        error = (found["exp_avg"].cpu() - expected["exp_avg"]).norm()
        assert error <= 1e-3 * expected["exp_avg"].norm(), part
    while there.iteration < there.iterations:  # density control and the end of training
        there.step()
    assert all(parameter.isfinite().all() for parameter in there.parameters.values())


@pytest.mark.filterwarnings("ignore:.*the secrets lie in appended Gaussians")
@pytest.mark.parametrize("method", ["carry", pytest.param("published", marks=pytest.mark.slow)])
def test_hide_and_reveal(
    method: str, gpu: torch.device, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("keyss.measure.hide_quality.WRONG_KEYS", 1)
    models, scenes = [trained_like(800, seed=seed) for seed in (1, 2)], [tiny_scene(0), tiny_scene(1)]
    options = CarryOptions() if method == "carry" else small(method, STEPS)
    hide(
        scenes[0], [Secret(scenes[1], KEY, models[1])], method=options, cover_model=models[0],
        device="cuda", out=tmp_path / "run", min_psnr=0,
    )  # fmt: skip
    revealed = reveal(stego_in(tmp_path / "run"), KEY, device="cuda").gaussians
    assert not isinstance(revealed.means, GpuTensor)
    here = reveal(stego_in(tmp_path / "run"), KEY, device="cpu").gaussians
    assert (revealed.means - here.means).abs().max() < 1e-6
