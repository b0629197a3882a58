"""A method that only the registry knows works in Python and on the command line."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, ClassVar

import numpy as np
import pytest
import torch

import keyss
from channels.lsb.trained_like import trained_like
from cli.harness import Run, assert_refused
from keyss import Gaussians, Secret
from keyss.channels import LOW_BITS, Payload
from keyss.core import InputError, UsageError, WrongKeyError
from keyss.methods import (
    Capabilities,
    CommandLineOption,
    Context,
    Frame,
    HiddenScene,
    MethodOptions,
    Plan,
    Prepared,
    Source,
    Stego,
    registry,
)
from tiny_scenes import random_gaussians

KEY = "a key of many characters: 93hXmQ2"


@dataclass(frozen=True, kw_only=True)
class WholeOptions(MethodOptions):
    method: ClassVar[str] = "whole"

    most: Annotated[int, CommandLineOption("Gaussians of a secret at most.", metavar="N")] = 100


@dataclass(frozen=True)
class OpenedWhole(HiddenScene):
    model: Gaussians
    frame = None

    def reveal(self, stego: Gaussians, *, frame: Frame = "secret") -> Gaussians:
        return self.model

    def fingerprint(self) -> str:
        return f"{len(self.model):016x}"


class WholeMethod:
    """Embeds the secret's floats as they are."""

    name = "whole"
    max_secrets = 1
    capabilities = Capabilities()
    options = WholeOptions

    def prepare(
        self, sources: Sequence[Source], options: WholeOptions, earlier: Prepared | None = None
    ) -> Prepared:
        model = sources[1].given
        if model is not None and len(model) > options.most:
            raise UsageError(f"expected at most {options.most} Gaussians, got {len(model)}")
        plan = Plan(gaussians=2500, sh_degree=3, secret_gaussians=options.most, capacity=options.most)
        return Prepared.of(options, len(sources), plan)

    def hide(self, sources: Sequence[Source], prepared: Prepared, context: Context) -> Stego:
        cover, secret = sources
        model = secret.model
        columns = [getattr(model, field.name) for field in fields(Gaussians)]
        rows = torch.cat([column.reshape(len(model), -1) for column in columns], dim=1)
        payload = Payload("whole", rows.numpy().tobytes())
        stego = LOW_BITS.prepare(cover.model).embed([(secret.key, payload)])
        return Stego(stego, (unpack(payload),), details={"floats": rows.numel()})


def unpack(payload: Payload) -> OpenedWhole:
    rows = torch.from_numpy(np.frombuffer(payload.data, np.float32).reshape(-1, 14).copy())
    means, quats, scales, logits, sh = rows.split((3, 4, 3, 1, 3), dim=1)
    return OpenedWhole(Gaussians(means, quats, scales, logits[:, 0], sh[:, None]))


METHOD = WholeMethod()


@pytest.fixture(autouse=True)
def register(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(
        registry.METHODS,
        "whole",
        registry.Modules(
            "embed the floats themselves",
            *(f"{__name__}:{name}" for name in ("WholeOptions", "METHOD", "unpack")),
        ),
    )


@pytest.fixture
def models(tmp_path: Path) -> tuple[Path, Path]:
    cover, secret = tmp_path / "cover.ply", tmp_path / "secret.ply"
    keyss.write_model(cover, trained_like(2500))
    keyss.write_model(secret, random_gaussians(60, sh_degree=0))
    return cover, secret


def test_api(models: tuple[Path, Path], tmp_path: Path) -> None:
    cover, secret = models
    result = keyss.hide(
        cover, [Secret(secret, KEY)], method="whole", views=keyss.ViewOptions(24), out=tmp_path / "run"
    )
    assert result.metrics.method == "whole"
    (secret_quality,), (plain,) = result.metrics.secrets, result.metrics.baseline.secrets
    assert plain is not None
    assert secret_quality.psnr == pytest.approx(plain.psnr, abs=1e-3)
    assert result.metrics.details == {"floats": 60 * 14}
    assert keyss.evaluate(tmp_path / "run", [KEY]) == result.metrics
    revealed = keyss.reveal(tmp_path / "run" / "publish" / "model.ply", KEY).gaussians
    assert torch.equal(revealed.means, random_gaussians(60, sh_degree=0).means)
    with pytest.raises(WrongKeyError):
        keyss.reveal(result.stego, "wrong")
    with pytest.raises(UsageError, match="at most 10"):
        keyss.hide(cover, [Secret(secret, KEY)], method=WholeOptions(most=10))
    with pytest.raises(UsageError, match="1 to 1 secrets"):
        keyss.hide(cover, [Secret(secret, KEY), Secret(secret, "other")], method="whole")


def test_command_line(
    keyss: Run, models: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("KEYSS_KEY", KEY)
    result = keyss("hide", "--method", "whole", "--help").out
    assert "--most N" in result
    assert "whole: embed the floats themselves" in " ".join(result.split())
    run = tmp_path / "run"
    scenes = ("--cover", models[0], "--secret", models[1])
    hide = ("hide", "--method", "whole", *scenes, "--width", 24, "-o", run)
    assert_refused(keyss(*hide, "--most", 59), 2, "expected at most 59")
    result = keyss(*hide, "--most", 60)
    assert result.status == 0
    assert json.loads((run / "private" / "metrics.json").read_text())["details"]["floats"] == 840
    config = json.loads((run / "private" / "config.json").read_text())
    assert (config["method"], config["options"]["most"]) == ("whole", 60)
    assert keyss("evaluate", run).status == 0
    assert keyss("reveal", run / "publish" / "model.ply", "-o", tmp_path / "revealed.ply").status == 0
    result = keyss("info", run)
    assert result.status == 0
    assert "whole" in result.out


def test_unknown_method(models: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cover, secret = models
    stego = keyss.hide(
        cover, [Secret(secret, KEY)], method="whole", views=keyss.ViewOptions(24), out=tmp_path / "run"
    ).stego
    monkeypatch.delitem(registry.METHODS, "whole")
    with pytest.raises(InputError, match="'whole'"):
        keyss.reveal(stego, KEY)
    with pytest.raises(InputError, match="'whole'"):
        keyss.evaluate(tmp_path / "run", [KEY])
    with pytest.raises(UsageError, match="carry or keyss"):
        keyss.hide(cover, [Secret(secret, KEY)], method="whole")
    with pytest.raises(UsageError, match="WholeOptions"):
        keyss.hide(cover, [Secret(secret, KEY)], method=WholeOptions())
