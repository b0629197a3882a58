"""Seeds of runs: random unless given, and recorded."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from unittest import mock

import numpy as np
import pytest

import keyss
from channels.lsb.trained_like import trained_like
from fitting.test_plain import InterruptAt
from keyss import CarryOptions, FitConfig, Gaussians, Secret
from keyss.channels import AppendedReader, LowBitsReader, is_appended
from keyss.core import Interrupted, OutputError, WrongKeyError
from keyss.keys import DerivedKey, derivation
from keyss.methods import MethodOptions
from methods.keyss.small import small
from tiny_scenes import tiny_scene

FIT = FitConfig(iterations=20, max_gaussians=300, grow_start=0.2, grow_every=5, evaluate_every=0)
KEY = "a key of many characters: 93hXmQ2"
JOINT = small("published", FIT)
# Appended Gaussians: whether so small a cover has room in low bits depends on the processor.
CARRIED = CarryOptions(fit=FIT, publish="converted")
METHODS = [replace(CARRIED, fine_tune="always"), CARRIED]


def _hide(options: MethodOptions) -> Gaussians:
    secret = Secret(tiny_scene(1), KEY)
    return keyss.hide(tiny_scene(0), [secret], method=options, min_psnr=0).stego


def _rotations(model: Gaussians) -> set[bytes]:
    """Trained rotations, without appended Gaussians and low bits."""
    bits = model[~is_appended(model)].quats.numpy().view(np.uint32) & ~np.uint32(0xFFF)
    start = np.array([1, 0, 0, 0], np.float32).view(np.uint32)
    return {row.tobytes() for row in bits if (row != start).any()}


def _interrupted_seed(run: Path, *names: str) -> int:
    found = json.loads((run / "private" / "manifest.json").read_text())["running"]["arguments"]
    for name in names:
        found = found[name]
    assert isinstance(found, int)
    return found


@pytest.mark.parametrize("options", METHODS, ids=["fine-tuned", "carried"])
def test_repeated_hidings_share_no_rotation(options: MethodOptions) -> None:
    one, two = (_rotations(_hide(options)) for _ in range(2))
    assert min(len(one), len(two)) > 100
    assert not one & two


@pytest.mark.filterwarnings("ignore:.*appended Gaussians")
@pytest.mark.parametrize("options", [CarryOptions(fit=FIT), JOINT], ids=["carry", "keyss"])
def test_salts_differ_for_equal_seeds(options: MethodOptions) -> None:
    """A table of Argon2id for one file must be useless for another with the same cover and seed.

    Readers try the salts of all channels: files may share salts under which nothing is written.
    """
    given = options.method == "carry"  # such covers have room on every processor
    salts, stegos = [], []
    for seed in (1, 2):
        secret = Secret(tiny_scene(seed), KEY, trained_like(60, seed) if given else None)
        with mock.patch.object(derivation, "hash_secret_raw", wraps=derivation.hash_secret_raw) as noted:
            hidden = keyss.hide(
                tiny_scene(0),
                [secret],
                method=options.with_fit(seed=7),
                cover_model=trained_like(800) if given else None,
                min_psnr=0,
            )
        salts.append({call.args[1] for call in noted.call_args_list})
        stegos.append(hidden.stego)
    common = salts[0] & salts[1]
    for own, stego in zip(salts, stegos, strict=True):
        readers = [each for each in (LowBitsReader.of(stego), AppendedReader.of(stego)) if each]
        assert common <= {salt for reader in readers for salt in reader.salts}
        assert not any(_opens(reader, salt) for reader in readers for salt in common)
        assert any(_opens(reader, salt) for reader in readers for salt in own)


def _opens(reader: LowBitsReader | AppendedReader, salt: bytes) -> bool:
    try:
        reader.extract(DerivedKey.of(KEY, salt))
    except WrongKeyError:
        return False
    return True


@pytest.mark.parametrize("given", [None, 7])
def test_resumed_fit_keeps_seed(tmp_path: Path, given: int | None) -> None:
    scene, run = tiny_scene(), tmp_path / "run"
    with pytest.raises(Interrupted):
        keyss.fit(scene, config=replace(FIT, seed=given), out=run, reporter=InterruptAt(10))
    seed = _interrupted_seed(run, "config", "seed")
    assert given in (None, seed)
    with pytest.raises(OutputError, match=rf"\(seed: {seed} then, 8 now"):
        keyss.fit(scene, config=replace(FIT, seed=8), out=run, resume=True)
    keyss.fit(scene, config=FIT, out=run, resume=True)
    assert json.loads((run / "private" / "config.json").read_text())["config"]["seed"] == seed
    keyss.fit(scene, config=replace(FIT, seed=seed), out=tmp_path / "whole")
    assert (run / "model.ply").read_bytes() == (tmp_path / "whole" / "model.ply").read_bytes()


@pytest.mark.filterwarnings("ignore:.*appended Gaussians")
@pytest.mark.parametrize("stage", [pytest.param("plain model", marks=pytest.mark.slow), "hide"])
def test_resumed_hiding_keeps_seed(tmp_path: Path, stage: str) -> None:
    """The files equal those of an uninterrupted run."""
    scenes, run = (tiny_scene(0), [Secret(tiny_scene(1), KEY)]), tmp_path / "run"
    with pytest.raises(Interrupted):
        keyss.hide(*scenes, method=JOINT, min_psnr=0, out=run, reporter=InterruptAt(10, stage))
    seed = _interrupted_seed(run, "options", "fit", "seed")
    keyss.hide(*scenes, method=JOINT, min_psnr=0, out=run, resume=True)
    metrics, config = (
        json.loads((run / "private" / f"{name}.json").read_text()) for name in ("metrics", "config")
    )
    assert metrics["seed"] == config["options"]["fit"]["seed"] == seed
    whole = replace(JOINT, fit=replace(JOINT.fit, seed=seed))
    keyss.hide(*scenes, method=whole, min_psnr=0, out=tmp_path / "whole")
    for name in ("publish/model.ply", "private/cover.ply", "private/secret-1.ply"):
        assert (run / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()
