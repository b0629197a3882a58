"""Published files do not identify a secret; all others are private."""

from __future__ import annotations

import hashlib
import json
import stat
from dataclasses import replace
from pathlib import Path

import pytest

import keyss
from channels.lsb.trained_like import trained_like
from fitting.test_plain import InterruptAt
from keyss import CarryOptions, FitConfig, Gaussians, Secret
from keyss.core import Interrupted
from keyss.methods import MethodOptions
from methods.keyss.small import small

pytestmark = pytest.mark.usefixtures("umask")

KEY = "a key of many characters: 93hXmQ2"
FIT = FitConfig(iterations=4, max_gaussians=1600, evaluate_every=0)
METHODS = {
    "fine-tuned": CarryOptions(fit=FIT, iterations=4, fine_tune="always"),
    "carried for any format": CarryOptions(fit=FIT, publish="converted"),
    "keyss": small("published", replace(FIT, iterations=16, seed=2_718_281_828)),
    "carry": CarryOptions(fit=FIT),
}


def _hide(folder: Path, options: MethodOptions, **how: object) -> Path:
    """Hide models with telling file names."""
    names = {"of-a-meadow.ply": trained_like(1500, 0), "of-the-treasure.ply": trained_like(100, 1)}
    for name, model in names.items():
        keyss.write_model(folder / name, model)
    cover, secret = (folder / name for name in names)
    out = folder / "run"
    keyss.hide(
        cover,
        [Secret(secret, KEY)],
        method=options,
        views=keyss.ViewOptions(24),
        min_psnr=0,
        out=out,
        **how,  # type: ignore[arg-type]
    )
    return out


def _modes(folder: Path) -> dict[str, int]:
    paths = [folder, *folder.rglob("*")]
    return {str(path.relative_to(folder.parent)): stat.S_IMODE(path.stat().st_mode) for path in paths}


def _identifying_bytes(run: Path, folder: Path) -> list[bytes]:
    """Names, the seed, hashes and numbers that would confirm a guess."""
    config = json.loads((run / "private" / "config.json").read_text())
    models: list[Gaussians] = [keyss.read_model(folder / "of-the-treasure.ply")]
    models += [keyss.read_model(path) for path in (run / "private").glob("*.ply")]
    raw = [getattr(model, name).numpy() for model in models for name in ("means", "quats", "sh")]
    digests = [hashlib.new(kind, each.tobytes()) for kind in ("sha256", "blake2b") for each in raw]
    digests += [hashlib.sha256(path.read_bytes()) for path in folder.glob("*.ply")]
    texts = [KEY, "treasure", "meadow", str(folder), str(config["options"]["fit"]["seed"])]
    texts += [*config["payloads"], *(digest.hexdigest()[:16] for digest in digests)]
    return [text.encode() for text in texts] + [digest.digest()[:8] for digest in digests]


@pytest.mark.parametrize("method", METHODS)
def test_published_file_does_not_identify_secret(tmp_path: Path, method: str) -> None:
    run = _hide(tmp_path, METHODS[method])
    assert {path.name for path in (run / "publish").iterdir()} == {"model.ply"}
    assert {path.name for path in run.iterdir()} == {"publish", "private"}
    data = (run / "publish" / "model.ply").read_bytes()
    assert [text for text in _identifying_bytes(run, tmp_path) if text in data] == []
    assert data[: 1 << 12].count(b"comment") == 0
    assert set(_modes(run / "private").values()) == {0o700, 0o600}


def test_checkpoints_are_private(tmp_path: Path) -> None:
    with pytest.raises(Interrupted):
        _hide(tmp_path, METHODS["fine-tuned"], reporter=InterruptAt(2))
    run = tmp_path / "run"
    modes = _modes(run / "private")
    assert any("checkpoint" in name and name.endswith(".safetensors") for name in modes)
    assert set(modes.values()) == {0o700, 0o600}
    assert {path.name for path in run.iterdir()} == {"private"}
