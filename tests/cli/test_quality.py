"""--min-psnr: bad results are not published, and resuming skips training."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from channels.lsb.trained_like import trained_like
from cli.harness import SMALL, Run, assert_refused, scene_arguments, write_key
from keyss.files import read_model, write_model


def test_min_psnr(keyss: Run, workspace: Path, tmp_path: Path) -> None:
    hide = ["hide", *scene_arguments(workspace), "--publish", "converted", "-o", tmp_path / "run", *SMALL]
    result = keyss(*hide, "--min-psnr", 90)
    assert result.status == 7
    assert "below 90 dB: nothing was published; a lower --min-psnr" in result.err
    assert "--resume skips finished training" in result.err
    assert {path.name for path in (tmp_path / "run").iterdir()} == {"private"}
    result = keyss(*hide, "--min-psnr", 0, "--resume")
    assert result.status == 0
    assert "plain model of the secret (b): 20 steps, continuing at 20" in result.err
    assert (tmp_path / "run" / "publish" / "model.ply").exists()


def test_joint_training_names_its_own_cure(keyss: Run, workspace: Path, tmp_path: Path) -> None:
    """Its secrets are not pruned, and --publish converted is not for it."""
    hide = ["hide", "--method", "keyss", *scene_arguments(workspace), "-o", tmp_path / "run", *SMALL]
    result = keyss(*hide, "--min-psnr", 90)
    assert result.status == 7
    assert "more training steps (--iterations) bring it nearer" in result.err
    assert "--publish converted" not in result.err


@pytest.fixture
def models(tmp_path: Path) -> Path:
    write_model(tmp_path / "cover.ply", trained_like(3000))
    write_model(tmp_path / "secret.ply", trained_like(1500, 1))
    write_key(tmp_path / "key.txt")
    return tmp_path


def _carry(folder: Path, *more: object) -> list[object]:
    files = [
        "--cover",
        folder / "cover.ply",
        "--secret",
        folder / "secret.ply",
        "--key-file",
        folder / "key.txt",
    ]
    return ["hide", "--method", "carry", *files, "--width", 48, "-o", folder / "run", *more]


@pytest.mark.parametrize("dry_run", [(), ("--dry-run",)])
def test_training_options_without_effect(keyss: Run, models: Path, dry_run: tuple[str, ...]) -> None:
    result = keyss(*_carry(models, "--preset", "quick", "--iterations", 7, "--seed", 1, *dry_run))
    assert result.status == 0
    assert "warning: --preset and --iterations: no effect, as nothing is trained" in result.err
    assert "no effect" not in keyss(*_carry(models, "--seed", 1, "--overwrite", *dry_run)).err


def test_empty_secret_is_not_published(keyss: Run, models: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Even if empty renders would exceed --min-psnr."""
    from keyss.methods import CarriedSecret

    reveal = CarriedSecret.reveal

    def empty(self: CarriedSecret, *arguments: object, **options: object) -> object:
        found = reveal(self, *arguments, **options)  # type: ignore[arg-type]
        return replace(found, opacity_logits=torch.full_like(found.opacity_logits, -20))

    monkeypatch.setattr(CarriedSecret, "reveal", empty)
    for limit in (1, 60):  # below and above its PSNR
        refused = keyss(*_carry(models, "--min-psnr", limit))
        assert_refused(refused, 7, "empty renders")
        assert "--min-psnr 0 publishes it anyway" in refused.err
    assert_refused(keyss(*_carry(models, "--min-psnr", "nan")), 2, "--min-psnr: expected a number of dB")
    assert not (models / "run").exists()


@pytest.mark.parametrize(("which", "who"), [("cover.ply", "the cover"), ("secret.ply", "the secret")])
def test_invisible_models(keyss: Run, models: Path, which: str, who: str) -> None:
    model = read_model(models / which)
    write_model(models / which, replace(model, opacity_logits=torch.full_like(model.opacity_logits, -9)))
    assert_refused(keyss(*_carry(models)), 2, f"{who}'s model is invisible")
