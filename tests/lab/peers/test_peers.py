"""The peers: each hides, is measured, and opens again from the published files; bits of Splats in Splats."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import keyss
from cli.harness import Run, assert_refused, write_key
from keyss import FitConfig, Secret
from keyss.cli import main
from keyss.core import DecodedGaussians, InputError, Similarity, UsageError, WrongKeyError
from keyss.fitting import State
from keyss.lab import PeerOptions
from keyss.lab.audits import audit
from keyss.lab.peers.watergs import COVER_BITS, graded_bits, ranges_of, read_bits, write_bits
from keyss.methods import KeyssTraining, PlacedScene, registry
from keyss.runs import stego_in
from keyss.runs.files import handed_names
from test_api import psnr_of_pictures
from tiny_scenes import random_gaussians, tiny_scene

FIT = FitConfig(iterations=120, max_gaussians=300, sh_degree=1, grow_every=30, evaluate_every=60, seed=0)
PEERS = [name for name, where in registry.METHODS.items() if ".peers." in where.hiding]
TRAINED = [name for name in PEERS if name != "3dgs"]
KEY = "a key of many characters: 93hXmQ2"


def options_of(name: str, **changes: Any) -> PeerOptions:
    """Small enough for seconds."""
    found: Any = registry.get(name).options
    return replace(found(fit=FIT, common_poses=0.5), **changes)  # type: ignore[no-any-return]


def key_of(name: str) -> str:
    return KEY if registry.get(name).capabilities.keys else ""


@dataclass(frozen=True)
class Made:
    """A hiding of tiny scenes."""

    name: str
    out: Path
    result: keyss.HideResult

    @property
    def keys(self) -> list[str]:
        return [KEY] if key_of(self.name) else []

    @property
    def handed(self) -> Path:
        return self.out / handed_names(1)[0]


@pytest.fixture(scope="module", params=PEERS)
def made(
    request: pytest.FixtureRequest, folders: tuple[Path, Path], tmp_path_factory: pytest.TempPathFactory
) -> Made:
    name, out = request.param, tmp_path_factory.mktemp("runs") / "run"
    secret = Secret(folders[1], key_of(name))
    result = keyss.hide(folders[0], [secret], method=options_of(name), min_psnr=0, out=out)
    return Made(name, out, result)


def test_what_is_written_is_what_was_measured(made: Made) -> None:
    files = {str(path.relative_to(made.out)) for path in made.out.rglob("*") if path.is_file()}
    assert files == {
        str(stego_in(made.out).relative_to(made.out)),
        *handed_names(1),
        *(f"private/{name}" for name in ("config.json", "metrics.json", "manifest.json")),
        *(f"private/{name}.ply" for name in ("cover", "secret-1")),
    }
    assert keyss.evaluate(made.out, made.keys) == made.result.metrics
    assert made.result.metrics.method == made.name
    for each in made.result.metrics.against_plain:
        assert each.psnr > each.nothing + 5


def test_both_files_show_the_secret(made: Made, folders: tuple[Path, Path], tmp_path: Path) -> None:
    capabilities = registry.get(made.name).capabilities
    stego = stego_in(made.out)
    assert (stego.suffix == ".ply") == capabilities.standard
    out = tmp_path / ("secret.ply" if capabilities.models else "secret.3dgs.safetensors")
    key = KEY if capabilities.keys else None
    keyss.reveal(stego, key, handed=made.handed, out=out)
    assert isinstance(keyss.read_model(out), DecodedGaussians) != capabilities.models
    psnr = psnr_of_pictures(out, folders[1])
    assert psnr == pytest.approx(made.result.metrics.secrets[0].psnr, abs=0.1)
    if not capabilities.models:
        with pytest.raises(UsageError, match="network"):
            keyss.reveal(stego, key, handed=made.handed, out=tmp_path / "secret.ply")
    if capabilities.keys:
        with pytest.raises(WrongKeyError):
            keyss.reveal(stego, "wrong", handed=made.handed)
    else:
        with pytest.raises(UsageError, match="no keys"):
            keyss.reveal(stego, KEY, handed=made.handed)
        with pytest.raises(UsageError, match="no keys"):
            keyss.evaluate(made.out, [KEY])


@pytest.mark.parametrize("at", [0, 31, -1])
def test_damage_is_told(made: Made, tmp_path: Path, at: int) -> None:
    data = bytearray(made.handed.read_bytes())
    key = KEY if key_of(made.name) else None
    path = tmp_path / "damaged.keyss"
    path.write_bytes(data[:at])
    with pytest.raises((InputError, WrongKeyError)):
        keyss.reveal(stego_in(made.out), key, handed=path)
    data[at] ^= 0x55
    path.write_bytes(data)
    try:
        keyss.reveal(stego_in(made.out), key, handed=path)
    except (InputError, UsageError, WrongKeyError):
        return
    assert key is None  # a changed number is another number, where nothing is sealed


def test_the_command_line(keyss: Run, made: Made, tmp_path: Path) -> None:
    given = ["--key-file", write_key(tmp_path / "key.txt", KEY)] if made.keys else []
    said = keyss("evaluate", made.out, *given)
    assert said.status == 0
    assert f"{made.result.metrics.secrets[0].psnr:.2f}" in said.out
    models = registry.get(made.name).capabilities.models
    out = tmp_path / ("a.ply" if models else "a.3dgs.safetensors")
    stego = stego_in(made.out)
    assert keyss("reveal", stego, "--handed", made.handed, *given, "-o", out).status == 0
    assert keyss("info", out).status == 0
    said = keyss("info", made.out)
    assert said.status == 0
    assert made.name in said.out
    assert_refused(keyss("reveal", stego, "--handed", stego, "-o", tmp_path / "b.ply"), 4, "handed over")


def test_a_key_for_what_has_none_and_what_it_cannot_do_are_refused(folders: tuple[Path, Path]) -> None:
    with pytest.raises(UsageError, match="no keys"):
        keyss.hide(folders[0], [Secret(folders[1], KEY)], method="3dgs-sh")
    with pytest.raises(UsageError, match="1 to 1 secrets"):
        keyss.hide(folders[0], [Secret(folders[1]), Secret(folders[0])], method="3dgs-sh")
    with pytest.raises(UsageError, match="publish"):
        options_of("gs-hider", publish="any")
    with pytest.raises(UsageError, match="key is empty"):
        keyss.hide(folders[0], [Secret(folders[1])], method="carry")


@pytest.mark.parametrize("name", TRAINED)
def test_an_interrupted_training_goes_on_bit_for_bit(name: str) -> None:
    """All state is in checkpoints: parameters that a peer adds, networks, moments, the order of poses."""
    scenes = [tiny_scene(0), tiny_scene(1)]
    placed = [PlacedScene.of(scene, random_gaussians(50), Similarity()) for scene in scenes]
    method: Any = registry.get(name)
    whole, resumed = (method.training(placed, options_of(name), torch.device("cpu")) for _ in range(2))

    def run_to(run: KeyssTraining, end: int) -> State:
        torch.manual_seed(run.iteration)  # which `train` keeps
        while run.iteration < end:
            run.step()
        tensors, _ = run.state()
        return {key: value.clone() for key, value in tensors.items()}

    resumed.load(run_to(whole, 70), whole.state()[1])
    ends = [run_to(run, 90) for run in (whole, resumed)]
    assert ends[0].keys() == ends[1].keys()
    for key, value in ends[0].items():
        assert torch.equal(value, ends[1][key]), key
    assert whole.evaluate() == resumed.evaluate()


def test_audits_measure_what_there_is(made: Made) -> None:
    if made.name not in ("3dgs-decoder", "gs-hider"):  # the others are 3DGS models throughout
        return
    standard = registry.get(made.name).capabilities.standard
    if not standard:
        with pytest.raises(UsageError, match="not publish a 3DGS model"):
            audit(made.out, [], only=["images", "stealth"])
    found = audit(made.out, [], only=["images", "speed"], controls=2)
    assert found.run.standard == standard
    assert found.images is not None
    assert found.images.models[1].images.mean.psnr == pytest.approx(
        made.result.metrics.secrets[0].psnr, abs=0.1
    )
    assert found.speed is not None
    assert main(["audit", str(made.out), "--report-only"]) == 0
    assert ("not publish a 3DGS model" in (made.out / "private" / "report.html").read_text()) != standard


CIPHER = bytes(range(32))


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_harmonics_come_back_rounded_by_half_a_step(degree: int) -> None:
    cover, secret = (random_gaussians(500, seed, degree).sh for seed in (0, 1))
    ranges = ranges_of(secret)
    sizes = graded_bits(degree)
    found = read_bits(write_bits(cover, secret, ranges, CIPHER), ranges, CIPHER)
    for index in range(cover.shape[1]):
        each = int(index**0.5)
        most = float(ranges[each])
        error = (found[:, index] - secret[:, index].clamp(-most, most)).abs().max()
        assert float(error) <= 1.01 * most / (2 ** sizes[each] - 1)
    # Importance: constant coefficients are the finest.
    assert list(sizes) == sorted(sizes, reverse=True)
    assert sum((2 * d + 1) * (COVER_BITS[d] - sizes[d]) for d in range(degree + 1)) >= 0


def test_the_cover_keeps_its_high_bits_and_the_low_ones_say_nothing() -> None:
    cover, secret = (random_gaussians(3000, seed, 3).sh for seed in (0, 1))
    stego = write_bits(cover, secret, ranges_of(secret), CIPHER)
    for index in range(16):
        bits = COVER_BITS[int(index**0.5)]
        high = [values[:, index].contiguous().numpy().view(np.uint32) >> bits for values in (cover, stego)]
        assert (high[0] == high[1]).all()
        low = stego[:, index].contiguous().numpy().view(np.uint32) & ((1 << bits) - 1)
        for bit in range(bits):
            assert abs(((low >> bit) & 1).mean() - 0.5) < 0.03  # 5 standard deviations
    change = ((stego - cover).abs() / cover.abs().clamp_min(1e-12)).flatten(1).amax()
    assert float(change) < 2.0 ** (max(COVER_BITS) - 23)
