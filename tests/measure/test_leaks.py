"""Looking for a secret: what is planted is found by what it is open to, and elsewhere nothing is."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

import keyss
from keyss.core import Gaussians, UsageError
from keyss.core.similarity import Similarity
from keyss.keys import random_embeddings
from keyss.measure.leaks import SCORES, Attack, attack, decoder_attacks, file_attacks, look_for_secret
from keyss.measure.leaks.attacks import THRESHOLDS
from keyss.methods.learned.decoder import Decoder, DecoderShape
from keyss.methods.learned.payload import HiddenSecret
from keyss.methods.learned.start import hidden_logits, opacity_curve
from tiny_scenes import random_gaussians, ring_cameras, tiny_scene

Rows = dict[str, dict[str, Any]]

COVER, SECRET = tiny_scene(0), tiny_scene(1)
TURN = torch.linalg.qr(torch.randn(3, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1)))[0]
FRAME = Similarity(0.8, TURN * TURN.det().sign(), torch.tensor([0.3, -0.2, 0.1], dtype=torch.float64))
HIDDEN = FRAME.apply_gaussians(random_gaussians(seed=1))  # the secret where it lies in the cover's frame


def _plain(seed: int) -> Gaussians:
    """One of several models of the same cover, with some faint clutter, as training leaves it."""
    generator = torch.Generator().manual_seed(seed)
    model = random_gaussians(1500, seed=0)
    faint = torch.rand(len(model), generator=generator) < 0.1
    shifted = replace(
        model, opacity_logits=torch.where(faint, model.opacity_logits - 3.5, model.opacity_logits)
    )
    return shifted.map(lambda tensor: tensor * (1 + 0.05 * torch.randn(tensor.shape, generator=generator)))


PLAINS = [_plain(seed) for seed in range(2)]


def _look(stego: Gaussians, **options: Any) -> Rows:
    rows, _ = look_for_secret(stego, PLAINS, COVER, SECRET, FRAME, cover_views=4, **options)
    return {row["attack"]: row for row in rows}


def _leaks(rows: Rows, name: str = "gradient") -> dict[str, float]:
    return {attack: row["leak"][name] for attack, row in rows.items()}


def _ghosts(logits: float | Tensor) -> Gaussians:
    """A cover with the secret's Gaussians at these opacities."""
    ghosts = replace(HIDDEN, opacity_logits=torch.as_tensor(logits).expand(len(HIDDEN)).clone())
    return Gaussians.cat([_plain(5), ghosts])


@pytest.fixture(scope="module")
def plain_rows() -> Rows:
    return _look(_plain(5))


def test_a_plain_model_leaks_nothing(plain_rows: Rows) -> None:
    assert max(_leaks(plain_rows).values()) < 0.06
    assert max(_leaks(plain_rows, "psnr_fitted").values()) < 1
    assert max(_leaks(plain_rows, "ssim_fitted").values()) < 0.05


def test_transparent_ghosts_are_found_by_their_opacity() -> None:
    rows = _look(_ghosts(math.log(0.01 / 0.99)))
    for name in ("restored opacities", "rescaled opacities", "matched opacities", "inverted opacities"):
        assert rows[name]["leak"]["gradient"] > 0.3, name
        assert rows[name]["leak"]["psnr_fitted"] > 3, name
        assert rows[name]["gradient"] > rows[name]["null_max"]["gradient"] + 0.3, name
    assert rows["restored opacities"]["best"] != "all"
    assert rows["by the source"]["leak"]["gradient"] < 0.06  # they are in no band


def test_ghosts_in_a_band_are_found_as_they_are_by_who_reads_the_source() -> None:
    rows = _look(_ghosts(hidden_logits(HIDDEN.opacity_logits, 1)))
    assert rows["by the source"]["best"] == "secret 2"
    assert rows["by the source"]["gradient"] > 0.98
    assert rows["by the source"]["psnr"] > 35
    assert rows["by the source"]["leak"]["gradient"] > 0.8
    assert rows["matched opacities"]["leak"]["gradient"] > 0.6


def test_ghosts_that_left_their_band_are_found_too() -> None:
    rows = _look(_ghosts(opacity_curve(0)[0][4] + 0.2))
    assert rows["by the source"]["best"] == "outside the bands"
    assert rows["by the source"]["leak"]["gradient"] > 0.3


@pytest.mark.parametrize("attribute", ["quaternion length", "SH energy"])
def test_a_group_of_its_own_is_found_by_what_sets_it_apart(attribute: str) -> None:
    """As opaque as the cover, among it: nothing else tells it from the cover."""
    group = HIDDEN
    if attribute == "quaternion length":
        group = replace(group, quats=100 * group.quats)
    else:
        group = replace(group, sh=torch.cat([group.sh[:, :1], 1e-4 * group.sh[:, 1:]], dim=1))
    shown = _leaks(_look(Gaussians.cat([_plain(5), group])))
    found = shown.pop(f"outliers in {attribute}")
    shown.pop("clusters")  # an attribute is one of those by which they are told apart
    assert found > 0.6
    assert max(shown.values()) < 0.2


def test_what_carries_a_secret_shows_no_more_than_what_did_not() -> None:
    cover = _plain(0)
    for threshold in THRESHOLDS:  # keep off what a low bit could decide
        close = (cover.opacities - threshold).abs() < 0.01 * threshold
        cover = replace(cover, opacity_logits=cover.opacity_logits + 0.1 * close)
    secret = keyss.Secret(random_gaussians(200, seed=1), "a key")
    carried = keyss.hide(cover, [secret], method="carry", width=40).stego
    rows, pictures = look_for_secret(carried, [cover], COVER, SECRET, FRAME, cover_views=4)
    for row in rows:
        if not (row["attack"].endswith("opacities") or row["attack"] == "by the source"):
            assert row["leak"]["gradient"] < 0.15, row["attack"]  # of these a low bit may decide some
            continue
        assert all(abs(row["leak"][name]) < 5e-3 for name in SCORES), row["attack"]
        picture = pictures[row["attack"]].int()
        assert (picture[:, :40] - picture[:, 44:84]).abs().max() <= 2, row["attack"]


def test_more_views_are_no_more_leak() -> None:
    """Who tries something twice tries it twice on plain models too: rows depend on what is shown only."""
    attacks = file_attacks(ring_cameras(2))[:1]
    twice = [replace(each, show=lambda model, show=each.show: [*show(model)] * 2) for each in attacks]
    once_rows, _ = attack(_ghosts(-5.0), PLAINS, SECRET, FRAME, attacks)
    twice_rows, _ = attack(_ghosts(-5.0), PLAINS, SECRET, FRAME, twice)
    assert twice_rows[0].pop("views") == 2 * once_rows[0].pop("views")
    assert once_rows == twice_rows


def test_rows_are_json_and_pictures_show_what_was_seen_beside_the_photo() -> None:
    attacks = [
        each for each in file_attacks(ring_cameras(2)) if each.name in ("clusters", "least contribution")
    ]
    rows, pictures = attack(_ghosts(-5.0), PLAINS, SECRET, FRAME, attacks)
    again, same = attack(_ghosts(-5.0), PLAINS, SECRET, FRAME, attacks)
    assert rows == again
    assert json.loads(json.dumps(rows, allow_nan=False)) == rows
    assert list(pictures) == [row["attack"] for row in rows]
    for name, picture in pictures.items():
        assert picture.dtype == torch.uint8
        assert picture.shape == (30, 3 * 40 + 2 * 4, 3)
        assert torch.equal(picture[:, -40:], SECRET.test[0].image)
        assert torch.equal(picture, same[name])


def _decoder(conditioning: str) -> HiddenSecret:
    torch.manual_seed(0)
    kind = "curve" if conditioning == "gate" else "network"
    decoder = Decoder(DecoderShape(kind=kind, conditioning=conditioning))  # type: ignore[arg-type]
    decoder.prepare(HIDDEN, random_embeddings(1, torch.Generator().manual_seed(3))[0])
    if conditioning == "gate":
        decoder.set_curve(*opacity_curve(0))
    return HiddenSecret(decoder.requires_grad_(False), FRAME, HIDDEN.means[:4])


def test_a_gate_shows_the_cover_without_its_key_and_the_secret_with_it() -> None:
    stego = _ghosts(hidden_logits(HIDDEN.opacity_logits, 0))
    rows, pictures = look_for_secret(
        stego, PLAINS, COVER, SECRET, FRAME, cover_views=4, restarts=2, opened=_decoder("gate")
    )
    by_name = {row["attack"]: row for row in rows}
    assert [row["attack"] for row in rows if row["control"]] == ["with the key"]
    assert by_name["with the key"]["psnr"] > 30
    assert by_name["with the key"]["leak"]["gradient"] > 0.8
    assert by_name["decoder without its key"]["views"] == 6
    assert abs(by_name["decoder without its key"]["leak"]["gradient"]) < 0.06
    assert set(pictures) == set(by_name)


def test_a_decoder_with_a_bias_is_searched() -> None:
    """This one is new and changes nothing, whatever the key: all that it shows is the cover."""
    search = decoder_attacks(_decoder("bias"), restarts=2, steps=3)[:1]
    as_it_is = Attack("as it is", "", {}, lambda model: iter([("as it is", model)]))
    searched, shown = attack(PLAINS[0], PLAINS, SECRET, FRAME, [*search, as_it_is])[0]
    assert searched["parameters"]["conditioning"] == "bias"
    assert searched["views"] == 6
    assert [searched[name] for name in SCORES] == pytest.approx([shown[name] for name in SCORES])


def test_nothing_to_compare_with_is_refused() -> None:
    with pytest.raises(UsageError, match="plain model"):
        look_for_secret(PLAINS[0], [], COVER, SECRET, FRAME)
    with pytest.raises(UsageError, match="no test views"):
        look_for_secret(PLAINS[0], PLAINS, COVER, replace(SECRET, test=()), FRAME)
