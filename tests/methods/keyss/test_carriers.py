"""The design `carriers`: rows that are a Gaussian of each scene, told apart by the key alone."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from channels.low_bits.trained_like import trained_like
from keyss import Gaussians, KeyssOptions, WrongKeyError
from keyss.channels import LOW_BITS, Payload
from keyss.core import InputError, Similarity, UsageError, same_bits
from keyss.fitting.parameters import make_optimizers, to_parameters
from keyss.keys import random_embeddings
from keyss.measure import search_embeddings, stealth_statistics
from keyss.methods import PlacedScene, RowSecret, registry
from keyss.methods.keyss.designs.carriers import DeadPlaces
from keyss.methods.keyss.rows import PAYLOAD_BYTES, carrying, encrypt_rows, row_kinds, secret_tables
from methods.hiding import Hidden, check_resumes, hide_scenes, psnr_in, three_scenes
from methods.keyss.hiding import EMBEDDINGS, FIT, KEYS, cover_with_zeros, written
from tiny_scenes import random_gaussians

OPTIONS = KeyssOptions(design="carriers", fit=replace(FIT, iterations=200))


@pytest.fixture(scope="module")
def hidden() -> Hidden:
    scenes, models = three_scenes()
    return hide_scenes(scenes, KEYS, OPTIONS, plains=models)


def test_each_key_opens_its_secret_and_another_key_nothing(hidden: Hidden) -> None:
    scenes, _ = three_scenes()
    for index, key in enumerate(KEYS):
        revealed = registry.open_model(hidden.stego, key).reveal(hidden.stego)
        assert psnr_in(revealed, scenes[index + 1]) > psnr_in(hidden.stego, scenes[index + 1]) + 4
    with pytest.raises(WrongKeyError):
        registry.open_model(hidden.stego, "another key")


def test_an_embedding_of_no_key_shows_the_very_cover(hidden: Hidden) -> None:
    for embedding in random_embeddings(8, torch.Generator().manual_seed(5)):
        assert hidden.opened[0].decode(hidden.stego, embedding) is hidden.stego


def test_rows_open_in_any_order_and_after_pruning_and_low_bits() -> None:
    stego, (secret,), _ = written()
    whole = secret.decode(stego, secret.embedding)
    assert len(whole) == secret.count
    embedded = LOW_BITS.prepare(stego).embed([("key", Payload("keyss", b"else"))], entropy=bytes(32))
    assert same_bits(secret.decode(embedded, secret.embedding), whole)
    chosen = torch.randperm(len(stego), generator=torch.Generator().manual_seed(0))[:500]
    some = secret.decode(stego[chosen], secret.embedding)
    rows = {row.numpy().tobytes() for row in whole.means}
    assert 100 < len(some) < len(whole)
    assert all(row.numpy().tobytes() in rows for row in some.means)


def _rows(model: Gaussians) -> list[bytes]:
    """All numbers of each Gaussian, in no order."""
    numbers = torch.cat([values.reshape(len(model), -1) for values in vars(model).values()], dim=1)
    return sorted(row.tobytes() for row in numbers.numpy())


@pytest.mark.parametrize(("secrets", "count"), [(1, 850), (2, 750)])
def test_every_secret_comes_back_as_coded(secrets: int, count: int) -> None:
    stego, made, models = written(secrets, count)
    first = len(carrying(cover_with_zeros())[0].rows)
    for index, secret in enumerate(made):
        parts = models[index][:first], models[index][first:]
        coded = [
            codec.decode(codec.encode(part.with_sh_degree(codec.table.sh_degree)))
            for codec, part in zip(secret.codecs, parts, strict=False)
        ]
        degree = coded[0].sh_degree
        expected = Gaussians.cat([part.with_sh_degree(degree) for part in coded if len(part)])
        decoded = secret.decode(stego, secret.embedding)
        assert _rows(decoded) == _rows(expected)
        other = made[1 - index].embedding if secrets == 2 else EMBEDDINGS[2]
        assert secret.decode(stego, other) is stego


def test_the_cover_keeps_signs_exponents_leading_bits_and_zeros() -> None:
    cover, (stego, *_) = cover_with_zeros(), written()
    before, after = (model.sh[:, 1:].numpy().view(np.uint32) >> 21 for model in (cover, stego))
    assert np.array_equal(before, after)
    assert torch.equal(cover.sh == 0, stego.sh == 0)
    assert same_bits(replace(stego, sh=cover.sh), cover)


def test_what_rows_say_is_uniform() -> None:
    stego, *_ = written()
    said = row_kinds(stego)[0].read(stego)
    counts = np.bincount(said.ravel(), minlength=256)
    expected = counts.sum() / 256
    assert ((counts - expected) ** 2 / expected).sum() / 255 == pytest.approx(1, abs=0.4)


def test_carriers_are_as_uneven_as_those_of_the_cover() -> None:
    """Harmonics of `trained_like` are normal: larger ones are rarer, also within a quarter of an octave."""

    def unevenness(model: Gaussians) -> float:
        words = model.sh[:, 1:].contiguous().numpy().view(np.uint32)
        return float((words >> 20 & 1)[np.abs(model.sh[:, 1:].numpy()) > 0].mean() - 0.5)

    cover, (stego, *_) = cover_with_zeros(), written()
    assert unevenness(cover) < -0.01
    assert unevenness(stego) == pytest.approx(unevenness(cover), abs=0.01)


def test_the_three_channels_stay_alike() -> None:
    """Where kept bits agree the next ones do too, in trained models and in what is written into one."""

    def alike(model: Gaussians) -> float:
        return stealth_statistics(model)["agreement: within a quarter of an octave, channels"].value

    cover, (_, (secret,), (model,)) = trained_like(4000), written()
    noise = torch.randn(4000, 15, 3, generator=torch.Generator().manual_seed(0))
    grey = cover.sh[:, 1:, :1] * (0.1 * noise).exp()
    cover = replace(cover, sh=torch.cat([cover.sh[:, :1], grey], dim=1))
    stego = encrypt_rows(cover, [secret], [model], bytes(32))
    assert alike(cover) > 0.1
    assert alike(stego) > 0.8 * alike(cover)


def test_copies_of_rows_count_once_and_rows_with_other_harmonics_not() -> None:
    stego, (secret,), _ = written()
    whole = secret.decode(stego, secret.embedding)
    assert same_bits(secret.decode(Gaussians.cat([stego, stego]), secret.embedding), whole)
    exchanged = replace(stego, sh=torch.cat([stego.sh[:, :1], stego.sh[:, 1:].roll(1, 0)], dim=1))
    assert secret.decode(exchanged, secret.embedding) is exchanged


def test_the_decoder_without_the_key_shows_nothing_to_a_search() -> None:
    """The white-box attack has the payload but for the embedding, and no gradient."""
    stego, (secret,), _ = written()
    for found in search_embeddings(secret.decode, stego, restarts=2, steps=20):
        assert secret.decode(stego, found) is stego


def test_nearly_the_key_is_as_wrong_as_any() -> None:
    stego, (secret,), _ = written()
    near = secret.embedding.clone()
    near[0] = torch.nextafter(near[0], torch.tensor(2.0))
    assert secret.decode(stego, near) is stego


def test_the_same_secret_gives_the_same_bytes_which_are_few() -> None:
    _, (secret,), _ = written()
    packed = secret.payload()
    assert len(packed.data) <= PAYLOAD_BYTES
    opened = registry._unpacked(packed)
    assert isinstance(opened, RowSecret)
    assert opened.payload() == packed
    assert opened.fingerprint() == secret.fingerprint()


@pytest.mark.parametrize(
    "change", [{"secret": 1}, {"count": 0}, {"visibility": 0.0}, {"embedding": EMBEDDINGS}]
)
def test_damaged_payloads_are_input_errors(change: dict[str, object]) -> None:
    _, (secret,), _ = written()
    with pytest.raises(InputError):
        RowSecret.of(replace(secret, **change).payload())  # type: ignore[arg-type]


def test_a_model_that_was_moved_is_refused() -> None:
    stego, (secret,), _ = written()
    for other in (
        replace(stego, means=stego.means + 1e-3),
        random_gaussians(seed=9),
        stego.with_sh_degree(0),
    ):
        with pytest.raises(InputError, match="none of its Gaussians opens"):
            secret.reveal(other)


def test_a_row_has_room_for_two_secrets_and_no_more() -> None:
    assert [table.sh_degree for table in secret_tables(3, 1)] == [3, 0]
    assert [table.sh_degree for table in secret_tables(2, 1)] == [0]
    assert [table.sh_degree for table in secret_tables(3, 2)] == [0]
    for degree, secrets in ((3, 3), (1, 1)):
        with pytest.raises(UsageError, match="no room for a Gaussian of each"):
            secret_tables(degree, secrets)


def test_an_interrupted_training_resumes_to_the_same_result(tmp_path: Path) -> None:
    options = replace(OPTIONS, fit=replace(FIT, iterations=40, grow_every=5))
    check_resumes(options, tmp_path, "hide", three_scenes()[1][:2])


def test_a_cover_without_harmonics_is_refused() -> None:
    scenes, models = three_scenes()
    options = replace(OPTIONS, fit=replace(FIT, iterations=1))
    with pytest.raises(InputError, match="train longer"):
        hide_scenes(scenes[:2], KEYS[:1], options, plains=models[:2])


def test_a_cover_may_have_rows_of_one_kind_only() -> None:
    cover, (_, (secret,), (model,)) = trained_like(400), written()
    stego = encrypt_rows(cover, [secret], [model[:300]], bytes(32))
    assert [len(kind.rows) for kind in row_kinds(stego)] == [400, 0]
    assert row_kinds(stego)[1].read(stego).shape == (0, 21)
    assert len(secret.decode(stego, secret.embedding)) == 300


def test_a_share_of_pruned_steps_is_one() -> None:
    with pytest.raises(UsageError, match="pruned_steps"):
        KeyssOptions(pruned_steps=1.5)


def test_rows_are_in_the_order_in_which_plain_3dgs_makes_them() -> None:
    """Its own points first, and what grew later at the end."""
    scenes, models = three_scenes()
    both = zip(scenes[:2], models[:2], strict=True)
    placed = [PlacedScene.of(scene, model, Similarity()) for scene, model in both]
    run = OPTIONS.settings.training(placed, [EMBEDDINGS[0]], OPTIONS, torch.device("cpu"))
    start = run.scene_gaussians(0).detach().means.clone()
    for _ in range(120):
        run.step()
    born = run.density["born"]
    fresh = born >= len(born)
    assert 0 < fresh.sum() < len(born)
    stego, _ = run.publish(bytes(32))
    old = ~fresh & (run.scene_gaussians(0).opacities >= OPTIONS.fit.prune_opacity)
    assert torch.equal(stego.means[: int(old.sum())], run.scene_gaussians(0).detach().means[old])
    assert not torch.equal(stego.means[: int(old.sum())], start[old])


def test_clones_come_before_both_parts_of_splits_each_in_the_order_of_their_sources() -> None:
    fit = replace(FIT, max_gaussians=100)
    model = trained_like(12)
    logits = torch.cat([torch.zeros(6), torch.full((6,), -8.0)])  # six places
    large = torch.tensor([False] * 3 + [True] * 9)[:, None]
    scales = torch.where(large, 0.0, -9.0).expand(12, 3).clone()
    params = to_parameters(replace(model, opacity_logits=logits, log_scales=scales), torch.device("cpu"))
    density = DeadPlaces(fit, [1.0], torch.Generator().manual_seed(0))
    born = torch.arange(12).flip(0)
    grown = density._grow(params, make_optimizers(params, fit, 1.0), 0, torch.ones(12), 1, born)
    assert grown.tolist() == [9, 10, 11, 5, 4, 3, 6, 7, 8]


def test_scenes_share_poses_where_options_ask_for_it() -> None:
    scenes, models = three_scenes()
    both = zip(scenes[:2], models[:2], strict=True)
    placed = [PlacedScene.of(scene, model, Similarity()) for scene, model in both]
    options = replace(OPTIONS, common_poses=1.0)
    run = options.settings.training(placed, [EMBEDDINGS[0]], options, torch.device("cpu"))
    assert all(len(set(run._sample_poses())) == 1 for _ in range(10))
    run.step()
