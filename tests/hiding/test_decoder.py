from __future__ import annotations

from dataclasses import fields

import pytest
import torch

from keyss.core import Gaussians, UsageError
from keyss.hiding.decoder import Decoder, DecoderShape
from keyss.hiding.mask import ATTRIBUTES, parse_mask
from keyss.seal import random_embeddings
from tiny_scenes import random_gaussians

FIELD_OF = {"op": "opacity_logits", "ro": "quats", "sc": "log_scales", "xyz": "means", "sh": "sh"}


def _trained(mask: str = "op,ro,sc,xyz,sh", seed: int = 0) -> Decoder:
    """A decoder whose last layers are not zero any more."""
    torch.manual_seed(seed)
    decoder = Decoder(DecoderShape(mask=parse_mask(mask)))
    decoder.standardise(random_gaussians())
    for branch in decoder.branches.values():
        torch.nn.init.normal_(branch[-1].weight)
    return decoder.requires_grad_(False)


def _embedding(seed: int = 0) -> torch.Tensor:
    return random_embeddings(1, torch.Generator().manual_seed(seed))[0]


def _distance(a: Gaussians, b: Gaussians, name: str) -> float:
    return (getattr(a, name) - getattr(b, name)).abs().max().item()


def test_a_new_decoder_changes_nothing_for_any_key() -> None:
    gaussians = random_gaussians()
    decoder = Decoder(DecoderShape(mask=ATTRIBUTES))
    decoder.standardise(gaussians)
    for seed in range(3):
        decoded = decoder(gaussians, _embedding(seed))
        assert all(_distance(decoded, gaussians, f.name) == 0 for f in fields(Gaussians))


@pytest.mark.parametrize("attribute", ATTRIBUTES)
def test_a_mask_updates_its_attribute_and_no_other(attribute: str) -> None:
    gaussians = random_gaussians()
    decoded = _trained(attribute)(gaussians, _embedding())
    for name, field in FIELD_OF.items():
        changed = _distance(decoded, gaussians, field) > 0
        assert changed == (name == attribute), name


def test_residuals_have_either_sign() -> None:
    gaussians = random_gaussians()
    decoded = _trained()(gaussians, _embedding())
    for field in FIELD_OF.values():
        residual = getattr(decoded, field) - getattr(gaussians, field)
        assert residual.min() < 0 < residual.max(), field


def test_every_gaussian_is_decoded_alone() -> None:
    """Re-ordering and pruning change nothing for those that stay."""
    gaussians, decoder, key = random_gaussians(), _trained(), _embedding()
    decoded = decoder(gaussians, key)
    chosen = torch.randperm(len(gaussians))[:50]
    again = decoder(gaussians[chosen], key)
    for field in FIELD_OF.values():
        torch.testing.assert_close(getattr(again, field), getattr(decoded, field)[chosen], rtol=0, atol=1e-5)


def test_keys_and_positions_and_colours_all_reach_the_result() -> None:
    gaussians, decoder = random_gaussians(), _trained()
    decoded = decoder(gaussians, _embedding(0))
    assert _distance(decoded, decoder(gaussians, _embedding(1)), "opacity_logits") > 1e-3
    for field in FIELD_OF.values():
        values = {f.name: getattr(gaussians, f.name) for f in fields(Gaussians)}
        values[field] = values[field] + 0.1
        changed = decoder(Gaussians(**values), _embedding(0))
        other = "opacity_logits" if field != "opacity_logits" else "log_scales"
        assert _distance(changed, decoded, other) > 1e-4, field


def test_a_description_can_be_shared_between_keys() -> None:
    gaussians, decoder = random_gaussians(), _trained()
    description = decoder.describe(gaussians)
    assert description.shape == (len(gaussians), decoder.shape.inputs)
    for seed in range(2):
        shared, fresh = (
            decoder(gaussians, _embedding(seed), description),
            decoder(gaussians, _embedding(seed)),
        )
        assert _distance(shared, fresh, "means") == 0


def test_far_positions_stay_within_the_encoding() -> None:
    gaussians, decoder = random_gaussians(), _trained()
    far = Gaussians(
        gaussians.means * 1e6,
        gaussians.quats,
        gaussians.log_scales,
        gaussians.opacity_logits,
        gaussians.sh,
    )
    assert decoder._contracted(far.means).norm(dim=1).max() <= 2.0001


def test_masks_are_read_in_any_order_and_refused_by_name() -> None:
    assert parse_mask("xyz, op") == ("op", "xyz")
    with pytest.raises(UsageError, match="colour"):
        parse_mask("op,colour")
    with pytest.raises(UsageError, match="none"):
        parse_mask(" , ")
