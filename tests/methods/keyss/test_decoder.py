from __future__ import annotations

from itertools import combinations
from typing import Any

import pytest
import torch

from keyss.core import Gaussians, UsageError
from keyss.keys import random_embeddings
from keyss.methods import ATTRIBUTES, Decoder, DecoderShape, parse_mask
from tiny_scenes import random_gaussians

FIELD_OF = {"op": "opacity_logits", "ro": "quats", "sc": "log_scales", "xyz": "means", "sh": "sh"}
KEY, OTHER = random_embeddings(2, torch.Generator().manual_seed(0))


def _decoder(mask: str = "op,ro,sc,xyz,sh", **shape: Any) -> Decoder:
    """With random weights; the last layers of a new decoder are 0."""
    torch.manual_seed(0)
    decoder = Decoder(DecoderShape(mask=parse_mask(mask), **shape)).requires_grad_(False)
    for weights in decoder.parameters():
        torch.nn.init.normal_(weights, std=0.3)
    return decoder


def _distance(a: Gaussians, b: Gaussians, name: str) -> float:
    return (getattr(a, name) - getattr(b, name)).abs().max().item()


@pytest.mark.parametrize("released", [False, True])
def test_equations_6_and_8(released: bool) -> None:
    """In float64 from the weights."""
    model, decoder = random_gaussians(40), _decoder(released=released, hidden=(5, 7), branch=3)
    decoded = decoder(model, 3 * KEY)
    weights = {name: value.double() for name, value in decoder.state_dict().items()}

    def layer(name: str, values: torch.Tensor) -> torch.Tensor:
        return weights[f"{name}.weight"] @ values + weights[f"{name}.bias"]

    def unit(values: torch.Tensor) -> torch.Tensor:
        return values.double() / values.double().norm()

    for i in (0, 17):
        row = {name: getattr(model, field)[i].flatten() for name, field in FIELD_OF.items()}
        logit = row["op"].double()
        alpha = logit / model.opacity_logits.double().norm() if released else logit.sigmoid()
        others = [unit(row[name]) for name in ("ro", "sc", "xyz", "sh")]
        f = torch.cat([alpha, *others, KEY.double()])
        h = layer("common.1", layer("common.0", f).relu()).relu()
        for name, field in FIELD_OF.items():
            residual = layer(f"outer.{name}", layer(f"inner.{name}", h).relu())
            if released and name != "op":
                residual = residual.relu()
            expected = row[name].double() + residual
            torch.testing.assert_close(
                getattr(decoded, field)[i].flatten().double(), expected, rtol=1e-4, atol=1e-4
            )


@pytest.mark.parametrize(
    "mask", [mask for size in range(1, 6) for mask in combinations(ATTRIBUTES, size)], ids=",".join
)
def test_mask(mask: tuple[str, ...]) -> None:
    gaussians = random_gaussians(40)
    decoded = _decoder(",".join(mask))(gaussians, KEY)
    for name, field in FIELD_OF.items():
        assert (_distance(decoded, gaussians, field) > 0) == (name in mask), name


def test_gaussians_are_decoded_independently() -> None:
    """Except in the authors' program, which normalises over all Gaussians."""
    gaussians = random_gaussians()
    chosen = torch.randperm(len(gaussians))[:50]
    for released in (False, True):
        decoder = _decoder(released=released)
        decoded = decoder(gaussians, KEY)
        part = decoder(gaussians[chosen], KEY, gaussians)
        for field in FIELD_OF.values():
            expected = getattr(decoded, field)[chosen]
            torch.testing.assert_close(getattr(part, field), expected, rtol=0, atol=1e-4)
        alone = decoder(gaussians[chosen], KEY)
        moved = _distance(alone, decoded[chosen], "means")
        assert moved > 1e-3 if released else moved < 1e-4


def test_sharded_decoding(monkeypatch: pytest.MonkeyPatch) -> None:
    """Shards bound the memory that a hostile file can request."""
    decoder, stego = _decoder(released=True), random_gaussians()
    whole = decoder(stego, KEY)
    monkeypatch.setattr("keyss.methods.keyss.decoder.ROWS", 70)
    in_parts = decoder(stego, KEY)
    for name, values in vars(whole).items():
        torch.testing.assert_close(getattr(in_parts, name), values)


def test_gradients(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of weights, Gaussians and the key, against differences, where some rows have no gradient."""
    monkeypatch.setattr("keyss.methods.keyss.decoder.ROWS", 3)
    decoder = _decoder(hidden=(5, 4), branch=3, sh_degree=0, key_size=6).double().requires_grad_()
    model = random_gaussians(8, sh_degree=0).map(lambda values: values.double().requires_grad_())
    key, seen = torch.randn(6).double().requires_grad_(), torch.rand(8, generator=torch.Generator()) < 0.6

    def decoded(*_: torch.Tensor) -> list[torch.Tensor]:
        return [values[seen] for values in vars(decoder(model, key)).values()]

    assert 0 < int(seen.sum()) < 8
    leaves = (*vars(model).values(), key, *decoder.parameters())
    assert torch.autograd.gradcheck(decoded, leaves)


def test_new_decoder_changes_nothing() -> None:
    """All scenes start as the points show them; the authors' program starts with random residuals."""
    model = random_gaussians(40)
    assert Decoder(DecoderShape())(model, KEY).digest() == model.digest()
    assert Decoder(DecoderShape(released=True))(model, KEY).digest() != model.digest()


def test_parse_mask() -> None:
    assert parse_mask("xyz, op") == ("op", "xyz")
    with pytest.raises(UsageError, match="colour"):
        parse_mask("op,colour")
    with pytest.raises(UsageError, match="none"):
        parse_mask(" , ")
