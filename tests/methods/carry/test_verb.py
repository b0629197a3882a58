"""Carrying as a person does it: files, scenes, folders, the command line."""

from __future__ import annotations

import io
import json
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

import keyss
from channels.low_bits.trained_like import keys, trained_like
from keyss import FitConfig, HideConfig, Secret
from keyss.channels.low_bits.container import embed
from keyss.cli import main
from keyss.core import UsageError, WrongKeyError
from keyss.files.ply import read_ply, write_ply
from keyss.methods.carry.carrying import embed_derived
from keyss.methods.carry.thinning import most_visible
from keyss.methods.learned.opening import open_model
from keyss.methods.learned.payload import HiddenSecret, pack_secret
from keyss.methods.learned.revealing import decoy_secret
from tiny_scenes import random_gaussians, tiny_scene

KEY = "a key of many characters: 93hXmQ2"


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("files")
    write_ply(folder / "cover.ply", trained_like(2500))
    write_ply(folder / "secret.ply", trained_like(900, 1))
    write_ply(folder / "large.ply", trained_like(6000, 2))
    (folder / "key").write_text(KEY)
    (folder / "other").write_text(KEY + "4")
    for name in ("key", "other"):
        (folder / name).chmod(0o600)
    return folder


@pytest.fixture
def run(
    files: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> Callable[..., tuple[int, str, str]]:
    monkeypatch.setenv("COLUMNS", "120")
    monkeypatch.setattr("sys.stdin", io.StringIO())
    monkeypatch.chdir(files)

    def call(*arguments: object) -> tuple[int, str, str]:
        capsys.readouterr()
        status = main([str(argument) for argument in arguments])
        return (status, *capsys.readouterr())

    return call


def test_hide_and_reveal_files(run: Callable[..., tuple[int, str, str]], tmp_path: Path) -> None:
    hide = ("hide", "--method", "carry", "--cover", "cover.ply", "--key-file", "key")
    status, out, err = run(*hide, "--secret", "secret.ply", "-o", tmp_path / "out")
    assert (status, err) == (0, "")
    assert "900" in out
    assert "carry something" in out
    assert {path.name for path in (tmp_path / "out").iterdir()} == {
        "stego.ply", "metrics.json", "config.json"
    }  # fmt: skip
    metrics = json.loads((tmp_path / "out/metrics.json").read_text())
    assert metrics["secrets"] == [{"gaussians": 900, "carried": 900, "bits": 568}]
    stego = tmp_path / "out/stego.ply"
    assert run("reveal", stego, "--key-file", "key", "-o", tmp_path / "secret.ply")[0] == 0
    assert len(read_ply(tmp_path / "secret.ply")) == 900
    assert run("reveal", stego, "--key-file", "other", "-o", tmp_path / "none.ply")[0] == 3
    assert run("evaluate", tmp_path / "out", "--key-file", "key")[0] == 0
    assert KEY not in "".join(path.read_text() for path in (tmp_path / "out").glob("*.json"))


def test_too_large_secrets_are_refused_or_thinned(
    run: Callable[..., tuple[int, str, str]], tmp_path: Path
) -> None:
    hide = ("hide", "--method", "carry", "--cover", "cover.ply", "--key-file", "key", "--secret", "large.ply")
    status, _, err = run(*hide, "-o", tmp_path / "out")
    assert status == 2
    assert "4,414 would fit; --thin" in err
    assert not (tmp_path / "out").exists()
    assert run(*hide, "-o", tmp_path / "out", "--thin")[0] == 0
    assert json.loads((tmp_path / "out/metrics.json").read_text())["secrets"][0]["carried"] == 4414


@pytest.mark.parametrize(
    "arguments",
    [
        ("--sidecar", "--method", "carry"),
        ("--mask", "op", "--method", "carry"),
        ("--thin",),
        ("--dither",),
    ],
)
def test_options_of_the_other_method_are_refused(
    run: Callable[..., tuple[int, str, str]], tmp_path: Path, arguments: tuple[str, ...]
) -> None:
    hide = ("hide", "--cover", "cover.ply", "--secret", "secret.ply", "--key-file", "key")
    assert run(*hide, "-o", tmp_path / "out", *arguments)[0] == 2


def test_dithering_says_what_it_costs(
    run: Callable[..., tuple[int, str, str]], files: Path, tmp_path: Path
) -> None:
    write_ply(tmp_path / "coarse.ply", read_ply(files / "cover.ply").map(lambda v: (v * 64).round() / 64))
    hide = ("hide", "--method", "carry", "--cover", tmp_path / "coarse.ply", "--key-file", "key")
    status, _, err = run(*hide, "--secret", "secret.ply", "-o", tmp_path / "out")
    assert status == 4
    assert "--dither gives it new low bits" in err
    status, out, _ = run(*hide, "--secret", "secret.ply", "-o", tmp_path / "out", "--dither")
    assert status == 0
    assert "Dithering costs the cover" in out


def test_from_photos_a_model_is_fitted_first_and_photos_judge(tmp_path: Path) -> None:
    config = HideConfig(fit=FitConfig(iterations=30, max_gaussians=300, evaluate_every=0))
    result = keyss.hide(
        trained_like(1500),
        [Secret(tiny_scene(1), KEY)],
        method="carry",
        config=config,
        out=tmp_path / "run",
    )
    assert (tmp_path / "run/private/secret-1.ply").exists()
    (secret,) = result.metrics["secrets"]
    assert secret["psnr"] == pytest.approx(result.metrics["bound"]["secrets"][0]["psnr"], abs=0.05)
    revealed = keyss.reveal(tmp_path / "run/stego.ply", KEY)
    assert len(revealed) == secret["carried"]
    with pytest.raises(UsageError, match="scenes in memory"):
        keyss.evaluate(tmp_path / "run", [KEY])


def test_a_given_model_of_a_scene_is_used() -> None:
    model = random_gaussians(400)
    result = keyss.hide(trained_like(1500), [Secret(tiny_scene(1), KEY, model)], method="carry")
    assert result.metrics["secrets"][0]["carried"] == 400
    assert keyss.reveal(result.stego, "wrong", decoy=True) is not None
    with pytest.raises(WrongKeyError):
        keyss.reveal(result.stego, "wrong")


def test_thinning_keeps_what_is_visible() -> None:
    model = trained_like(1000)
    model.opacity_logits[:] = 0
    model.opacity_logits[:400] = -30
    kept = most_visible(model, 600)
    assert torch.equal(kept.means, model.means[400:])
    assert most_visible(model, 1000) is model


def test_a_model_that_carries_still_opens_the_learned_method_s_way() -> None:
    """`reveal` tries both methods under one derived key; neither stands in the other's way."""
    plain = trained_like(1500)
    secret = decoy_secret(plain, keys()[0])
    opened = open_model(embed(plain, [(KEY, pack_secret(secret))]), KEY)
    assert isinstance(opened, HiddenSecret)
    assert torch.equal(opened.embedding, secret.embedding)
    with pytest.raises(WrongKeyError):
        open_model(embed_derived(plain, [(keys(), trained_like(100))]), KEY)
    assert isinstance(open_model(plain, KEY, decoy=True), HiddenSecret)
