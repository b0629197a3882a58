from __future__ import annotations

from dataclasses import fields
from itertools import combinations
from typing import Any

import pytest
import torch

from keyss.core import Gaussians, UsageError
from keyss.keys import random_embeddings
from keyss.methods import ATTRIBUTES, Decoder, DecoderShape, parse_mask
from tiny_scenes import random_gaussians

FIELD_OF = {"op": "opacity_logits", "ro": "quats", "sc": "log_scales", "xyz": "means", "sh": "sh"}


def _embedding(seed: int = 0) -> torch.Tensor:
    return random_embeddings(1, torch.Generator().manual_seed(seed))[0]


def _trained(mask: str = "op,ro,sc,xyz,sh", **shape: Any) -> Decoder:
    """A network whose last layers are not zero any more, for the embedding of seed 0."""
    torch.manual_seed(0)
    decoder = Decoder(DecoderShape(mask=parse_mask(mask), **shape))
    decoder.prepare(random_gaussians(), _embedding())
    for branch in decoder.network.branches.values():
        torch.nn.init.normal_(branch[-1].weight)
    return decoder.requires_grad_(False)


def _distance(a: Gaussians, b: Gaussians, name: str) -> float:
    return (getattr(a, name) - getattr(b, name)).abs().max().item()


@pytest.mark.parametrize("conditioning", ["gate", "bias"])
def test_a_new_decoder_changes_nothing_for_any_key(conditioning: Any) -> None:
    gaussians = random_gaussians()
    decoder = Decoder(DecoderShape(mask=ATTRIBUTES, conditioning=conditioning))
    decoder.prepare(gaussians, _embedding())
    for seed in range(3):
        decoded = decoder(gaussians, _embedding(seed))
        assert all(_distance(decoded, gaussians, f.name) == 0 for f in fields(Gaussians))


@pytest.mark.parametrize(
    "mask", [mask for size in range(1, 6) for mask in combinations(ATTRIBUTES, size)], ids=",".join
)
def test_a_mask_updates_its_attributes_and_no_others(mask: tuple[str, ...]) -> None:
    gaussians = random_gaussians(40)
    decoded = _trained(",".join(mask))(gaussians, _embedding())
    for name, field in FIELD_OF.items():
        assert (_distance(decoded, gaussians, field) > 0) == (name in mask), name


@pytest.mark.parametrize("residuals", ["signed", "one-sided"])
def test_residuals_have_either_sign_unless_they_are_as_published(residuals: Any) -> None:
    gaussians = random_gaussians()
    decoded = _trained(residuals=residuals)(gaussians, _embedding())
    for name, field in FIELD_OF.items():
        residual = getattr(decoded, field) - getattr(gaussians, field)
        assert residual.max() > 0, field
        assert (residual.min() < 0) == (residuals == "signed" or name == "op"), field


def test_the_gate_lets_one_key_through_and_no_other() -> None:
    gaussians, decoder = random_gaussians(), _trained("op")
    own = _embedding()
    assert _distance(decoder(gaussians, own), gaussians, "opacity_logits") > 1
    # Half precision of the key is near enough; wrong keys are nowhere near.
    assert _distance(decoder(gaussians, own.half().float()), decoder(gaussians, own), "opacity_logits") == 0
    for wrong in random_embeddings(1000, torch.Generator().manual_seed(1)):
        assert _distance(decoder(gaussians, wrong), gaussians, "opacity_logits") == 0


def test_the_published_network_sees_lengths_of_one_over_the_whole_model() -> None:
    """Opacities are normalised over all Gaussians, everything else of each by itself."""
    gaussians = random_gaussians()
    network = _trained(inputs="normalised", frequencies=0).network
    whole = network.describe(gaussians, gaussians)
    torch.testing.assert_close(whole[:, :3].norm(dim=1), torch.ones(len(gaussians)))
    torch.testing.assert_close(whole[:, 3].norm(), torch.ones(()))
    assert torch.equal(network.describe(gaussians[:10], gaussians), whole[:10])


def test_every_gaussian_is_decoded_alone() -> None:
    """Re-ordering and pruning change nothing for those that stay."""
    gaussians, decoder, key = random_gaussians(), _trained(), _embedding()
    decoded = decoder(gaussians, key)
    chosen = torch.randperm(len(gaussians))[:50]
    again = decoder(gaussians[chosen], key)
    for field in FIELD_OF.values():
        torch.testing.assert_close(getattr(again, field), getattr(decoded, field)[chosen], rtol=0, atol=1e-5)


def test_keys_and_positions_and_colours_all_reach_the_result() -> None:
    gaussians, decoder = random_gaussians(), _trained(conditioning="bias")
    decoded = decoder(gaussians, _embedding(0))
    assert _distance(decoded, decoder(gaussians, _embedding(1)), "opacity_logits") > 1e-3
    for field in FIELD_OF.values():
        values = {f.name: getattr(gaussians, f.name) for f in fields(Gaussians)}
        values[field] = values[field] + 0.1
        changed = decoder(Gaussians(**values), _embedding(0))
        other = "opacity_logits" if field != "opacity_logits" else "log_scales"
        assert _distance(changed, decoded, other) > 1e-4, field


def test_far_positions_stay_within_the_encoding() -> None:
    gaussians, decoder = random_gaussians(), _trained()
    far = Gaussians(
        gaussians.means * 1e6,
        gaussians.quats,
        gaussians.log_scales,
        gaussians.opacity_logits,
        gaussians.sh,
    )
    assert decoder.network._contracted(far.means).norm(dim=1).max() <= 2.0001


def test_masks_are_read_in_any_order_and_refused_by_name() -> None:
    assert parse_mask("xyz, op") == ("op", "xyz")
    with pytest.raises(UsageError, match="colour"):
        parse_mask("op,colour")
    with pytest.raises(UsageError, match="none"):
        parse_mask(" , ")
