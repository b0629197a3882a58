"""Arguments of the command line reach `keyss.hide`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

import keyss as library
from cli.harness import METRICS, Run, assert_refused
from keyss.fitting import PRESETS
from tiny_scenes import random_gaussians


@pytest.fixture
def hide_calls(keyss: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Arguments of each call of `keyss.hide`."""
    monkeypatch.chdir(tmp_path)
    for name in ("A", "B", "C"):
        Path(name).mkdir()
    for name in ("a.ply", "b.ply", "m.ply", "mb", "mc", "x", "y"):
        Path(name).touch()
    calls: list[tuple[tuple[Any, ...], dict[str, Any]]] = []

    def hide(*args: Any, **kwargs: Any) -> library.HideResult:
        calls.append((args, kwargs))
        return library.HideResult(random_gaussians(1), METRICS)

    monkeypatch.setattr(library, "hide", hide)
    monkeypatch.setenv("KEYSS_KEY", "k")
    return calls


def test_secrets_are_paired_with_keys(keyss: Run, hide_calls: list[Any], tmp_path: Path) -> None:
    for name in "bc":
        (tmp_path / f"{name}.txt").write_text(f"key of {name}")
    result = keyss(
        *("hide", "--cover", "A", "-o", "out", "--secret", "B", "--key-file", tmp_path / "b.txt"),
        *("--secret", "C", "--key-file", tmp_path / "c.txt"),
        *("--secret-model", "mb", "--secret-model", "mc"),
    )
    assert result.status == 0, result.err
    (cover, secrets), _ = hide_calls[0]
    assert cover == Path("A")
    assert secrets == [
        library.Secret(Path("B"), "key of b", Path("mb")),
        library.Secret(Path("C"), "key of c", Path("mc")),
    ]


def test_options_override_preset(keyss: Run, hide_calls: list[Any]) -> None:
    result = keyss(
        "hide --cover A --secret B -o out --preset quick --iterations 7 --max-gaussians 80 --seed 9 "
        "--method keyss --design released --mask xyz,sc --width 20 --background 1 0.5 0 --cover-model m.ply "
        "--resume --device cpu"
    )
    assert result.status == 0, result.err
    _, options = hide_calls[0]
    config = options.pop("method")
    assert (config.fit.iterations, config.fit.max_gaussians, config.fit.seed) == (7, 80, 9)
    assert (config.configuration.name, config.configuration.decoder.mask) == ("released", ("sc", "xyz"))
    assert config.fit.evaluate_every == PRESETS["quick"].evaluate_every
    assert options.pop("reporter") is not None
    assert options == {
        "views": library.ViewOptions(20, (1.0, 0.5, 0.0)),
        "cover_model": Path("m.ply"),
        "bound": False,
        "min_psnr": None,
        "device": "cpu",
        "out": Path("out"),
        "overwrite": False,
        "resume": True,
        "dry_run": False,
    }


def test_method_options(keyss: Run, hide_calls: list[Any]) -> None:
    scenes = ("hide", "--cover", "A", "--secret", "B", "-o", "out")
    clip = ("--key-encoder", "clip", "--clip-model", "C")
    assert keyss(*scenes, "--method", "keyss", "--design", "published", *clip).status == 0
    joint = hide_calls[0][1]["method"]
    assert (joint.design, joint.key_encoder, joint.clip_model) == ("published", "clip", "C")
    assert keyss(*scenes, "--fine-tune", "never", "--seed", 5).status == 0
    carry = hide_calls[1][1]["method"]
    assert (carry.fine_tune, carry.fit.seed) == ("never", 5)


@pytest.mark.parametrize(
    ("extra", "words"),
    [
        (("--iterations", 0), "--iterations: expected"),
        (("--max-gaussians", -5), "--max-gaussians: expected"),
        (("--seed", -1), "--seed"),
        (("--seed", 10**30), "--seed"),
        (("--method", "keyss", "--mask", "op,colour"), "colour"),
        (("--secret-model", "x", "--secret-model", "y"), "--secret-model"),
        (("--secret", "C"), "KEYSS_KEY holds one key"),
    ],
)
def test_invalid_values(keyss: Run, hide_calls: list[Any], extra: tuple[object, ...], words: str) -> None:
    assert_refused(keyss("hide", "--cover", "A", "--secret", "B", "-o", "out", *extra), 2, words)
    assert hide_calls == []
