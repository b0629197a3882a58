"""Which Gaussians may be written: what gives low bits away, and that what is written gives nothing away."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from channels.lsb.payloads import embed, extract
from channels.lsb.trained_like import trained_like
from keyss.channels import LOW_BITS, chance_of_bits, read_low_bits, usable_carriers
from keyss.channels.lsb.bits import DEPTHS, Layout, used_words, write_low_bits
from keyss.channels.lsb.equal_steps import Steps
from keyss.channels.lsb.trailing_zeros import count_trailing_zeros, least_exponent
from keyss.channels.lsb.usable import MAX_SEPARATION, chance_of_lattice
from keyss.core import Gaussians, UsageError

STEP = 2.0**-12  # scale of the last steps of the optimiser that rounds them
MODELS = 16


def rounded_like(count: int, seed: int, step: float = STEP) -> Gaussians:
    """A model whose optimiser rounds its last step before subtracting it, in numpy's single precision."""
    model = trained_like(count, seed)
    random = np.random.default_rng(seed)
    before = model.sh.numpy()
    steps = (random.choice([-1, 1], before.shape) * random.exponential(step, before.shape)).astype(np.float32)
    return replace(model, sh=torch.from_numpy(before - steps))


def small_even_numbers(model: Gaussians) -> float:
    """Zeros less ones in bits 1 to 3 of small harmonics with an even mantissa, in standard deviations."""
    words = used_words(model)[:, 8:]
    small = words[((words >> 23 & 255) < 127 + np.log2(STEP)) & (words & 1 == 0)]
    ones = sum(int((small >> bit & 1).sum()) for bit in (1, 2, 3))
    return (1.5 * len(small) - ones) / (0.75 * len(small)) ** 0.5


def _auc(plain: list[float], changed: list[float]) -> float:
    greater = np.subtract.outer(plain, changed)
    return float((greater > 0).mean() + 0.5 * (greater == 0).mean())


@pytest.fixture(scope="module")
def rounded() -> list[Gaussians]:
    return [rounded_like(1500, seed) for seed in range(MODELS)]


def test_models_with_trailing_zeros_and_new_bits_look_alike(rounded: list[Gaussians]) -> None:
    """The sum that told all carried models from plain ones, as somebody counts who knows the optimiser."""
    size = int(0.95 * min(LOW_BITS.prepare(model).capacity.bytes for model in rounded))
    stegos = [
        embed(model, [("a key", np.random.default_rng(seed).bytes(size))], bytes([seed] * 32))
        for seed, model in enumerate(rounded)
    ]
    plain = [small_even_numbers(model) for model in rounded]
    assert np.mean(plain) > 3  # trailing zeros there are
    assert abs(_auc(plain, [small_even_numbers(stego) for stego in stegos]) - 0.5) < 0.1
    # The control: new bits in every Gaussian.
    random = np.random.default_rng(0)
    careless = [
        write_low_bits(
            model,
            Layout.of(model),
            [(8, np.arange(len(model)), random.integers(0, 256, (len(model), 53), np.uint8))],
        )
        for model in rounded
    ]
    assert _auc(plain, [small_even_numbers(model) for model in careless]) > 0.95


def test_little_is_left_alone_where_nothing_is_given_away(rounded: list[Gaussians]) -> None:
    """The limit of confidence leaves alone 2 to 8 % of 1,500 Gaussians, 0.5 % of 20,000."""
    fine = [usable_carriers(trained_like(1500, seed)).mean() for seed in range(MODELS)]
    assert min(fine) > 0.9
    assert np.mean(fine) > 0.94
    assert np.mean([usable_carriers(model).mean() for model in rounded]) < np.mean(fine) - 0.05


@pytest.mark.parametrize("step", [2.0**-16, 2.0**-13, 2.0**-10])
def test_what_is_given_away_keeps_to_its_share(step: float) -> None:
    """By the true probabilities of trailing zeros, which the limit is to be safe for."""
    words = np.concatenate([used_words(rounded_like(4000, seed, step))[:, 8:] for seed in (1, 2)])
    counts = count_trailing_zeros(words)
    least = least_exponent(counts, MAX_SEPARATION)
    exponents = np.arange(256)
    # A step is larger than 2^(e + 2) with this probability: then bits 0 and 1 of a number are zero.
    forced = np.exp(-(2.0 ** (exponents - 127 + 2)) / step)
    even = counts[:, 1:].sum(axis=1)
    given_away = (even * (2 * forced) ** 2)[least:].sum()
    assert given_away <= MAX_SEPARATION
    assert least < 127 + np.log2(step) + 4  # not much more is left alone than has to be


def test_the_chance_of_uniform_bits_is_one_and_that_of_others_is_small() -> None:
    random = np.random.default_rng(0)
    words = random.integers(0, 1 << 23, (4000, 40), np.uint32) | np.uint32(120 << 23)
    assert chance_of_bits(words, 13) > 1e-3
    copied = words & ~np.uint32(2) | words << 1 & np.uint32(2)  # bit 1 is bit 0
    assert chance_of_bits(copied, 13) < 1e-100
    chained = np.where(words & 64, words, words & ~np.uint32(128))  # bit 7 is zero more often where bit 6 is
    assert chance_of_bits(chained, 13) < 1e-100


def test_bits_that_depend_on_each_other_are_refused() -> None:
    """Every byte is uniform, and so is every bit by itself."""
    model = trained_like(4000, 2)
    words = model.sh.numpy().view(np.uint32)
    words ^= (words & 1) << 3 ^ (words >> 3 & 1) << 3  # bit 3 is bit 0
    with pytest.raises(UsageError, match=r"low bits of (f_rest|harmonics) in this cover are not random"):
        LOW_BITS.prepare(model)
    LOW_BITS.prepare(trained_like(4000, 2))


def test_quaternions_of_unit_length_stay_so() -> None:
    model = trained_like(4000, 6)
    unit = replace(model, quats=torch.nn.functional.normalize(model.quats, dim=1))
    stego = embed(unit, [("a key", b"secret")])
    assert Layout.of(unit) == Layout.of(stego) == Layout(3, quats=False)
    assert torch.equal(stego.quats, unit.quats)
    assert read_low_bits(stego).shape[1] == 49
    assert extract(stego, "a key") == b"secret"


def typed(model: Gaussians) -> tuple[Gaussians, Any]:
    model.quats[:100] = torch.tensor([1.0, 0, 0, 0])
    model.sh[100:200, 4:] = 0
    model.opacity_logits[200:230] = 0.1234567
    return model, slice(230)


def repeated(model: Gaussians) -> tuple[Gaussians, Any]:
    return Gaussians.cat([model, model[:10]]), np.r_[:10, len(model) : len(model) + 10]


def grey_or_round(model: Gaussians) -> tuple[Gaussians, Any]:
    """Whichever low bits their values have."""
    model.sh[:300, 7, 2] = model.sh[:300, 7, 0] * (1 + 1e-5)
    model.log_scales[300:600, 1] = model.log_scales[300:600, 2] * (1 - 1e-6)
    return model, slice(600)


def clones(model: Gaussians) -> tuple[Gaussians, Any]:
    """Gaussians that training hardly moved apart: a whole triple with the same high bits."""
    others = model[:40].map(lambda values: values * (1 + 2e-7))
    both = Gaussians.cat([model, replace(others, means=others.means + 0.01)])
    return both, np.r_[:40, len(model) : len(model) + 40]


def unit_or_half_precision(model: Gaussians) -> tuple[Gaussians, Any]:
    """As in models that were merged: the others of their kind would tell which were written."""
    unit = replace(model[:300], quats=torch.nn.functional.normalize(model.quats[:300], dim=1))
    short = model[300:320].map(lambda values: values.half().float())
    return Gaussians.cat([unit, short, model[320:]]), slice(320)


def three_equal_harmonics(model: Gaussians) -> tuple[Gaussians, Any]:
    """A Gaussian that few views show gets equal steps for all of them; by chance two may be equal."""
    for row in range(100):
        for other in range(1 + row % 2):
            model.sh[row, 2 + other, row % 3] = -model.sh[row, 1, row % 3] * (1 + 2.0**-20)
    return model, slice(1, 100, 2)


def saturated(model: Gaussians) -> tuple[Gaussians, Any]:
    """Logits whose sigmoid has no gradient stay equal in clones whose other numbers were trained."""
    model.opacity_logits[:200] = torch.linspace(16.0001, 19, 200) * 1.0001
    model.opacity_logits[200:400] = -model.opacity_logits[:200]
    return model, slice(200)


def shared_channel(model: Gaussians, harmonics: int = 15) -> tuple[Gaussians, Any]:
    """As where the colour of a channel is clamped: its harmonics are frozen, and all others are trained."""
    for row in range(60):
        shared = slice(1, 1 + harmonics)
        model.sh[row, shared, row % 3] = model.sh[1000 + row, shared, row % 3]
    return model, np.r_[:60, 1000:1060]


def three_shared(model: Gaussians) -> tuple[Gaussians, Any]:
    return shared_channel(model, 3)


def colours_together(model: Gaussians) -> tuple[Gaussians, Any]:
    """As in a band of harmonics that few steps reached, while errors of two colours were proportional."""
    step, sign = 1e-3 * torch.arange(1, 61)[:, None], torch.tensor([1, -1]).repeat(30)[:, None]
    model.sh[:60, 9:, 1] = sign * model.sh[:60, 9:, 0].sign() * (model.sh[:60, 9:, 0].abs() + step)
    return model, slice(60)


PREDICTABLE = (
    *(typed, repeated, grey_or_round, clones, unit_or_half_precision, three_equal_harmonics, saturated),
    *(shared_channel, three_shared, colours_together),
)


@pytest.mark.parametrize("change", PREDICTABLE)
def test_predictable_gaussians_stay_as_they_are(change: Callable[[Gaussians], tuple[Gaussians, Any]]) -> None:
    model, rows = change(trained_like(3000, 5))
    usable = usable_carriers(model)
    assert not usable[rows].any()
    assert np.delete(usable, rows).mean() > 0.9
    stego = embed(model, [("a key", b"secret")])
    rows = torch.from_numpy(np.arange(len(model))[rows])
    assert stego[rows].digest() == model[rows].digest()


def test_two_equal_colours_are_noticed_where_they_are_many() -> None:
    """They are equal by chance: not excluded."""
    model = trained_like(2000)
    step = 1e-3 * torch.arange(1, 61)[:, None]
    model.sh[:60, 9:11, 1] = model.sh[:60, 9:11, 0].sign() * (model.sh[:60, 9:11, 0].abs() + step)
    steps = Steps(model, Layout(3))
    assert not steps.equal(8)[:60].all()
    assert steps.chance(8, ~steps.equal(8)) < 1e-20


def siblings_like(
    count: int, pairs: int, seed: int, ratio: float = 20, *, near: bool = True
) -> tuple[Gaussians, np.ndarray]:
    """A model in which some Gaussians moved away from their clones by equal steps; and [2, pairs] which."""
    random = np.random.default_rng(seed)
    model = trained_like(count, seed)
    both = random.permutation(count)[: 2 * pairs].reshape(2, pairs)
    sh, means = model.sh.numpy().copy(), model.means.numpy().copy()
    steps = random.uniform(0.002, 0.02, (pairs, 1, 3)) * random.choice([-1, 1], (pairs, 16, 1))
    steps *= random.choice([-1, 1], (pairs, 1, 3))  # of the colours' errors; those above of the harmonics
    steps[:, 0] *= ratio
    sh[both[1]] = sh[both[0]] + steps.astype(np.float32)
    if near:
        means[both[1]] = means[both[0]] + random.normal(0, 1e-3, (pairs, 3)).astype(np.float32)
    return replace(model, sh=torch.from_numpy(sh), means=torch.from_numpy(means)), both


@pytest.mark.parametrize("ratio", [20, 10, 5, 1])
def test_siblings_that_moved_apart_by_equal_steps_stay_as_they_are(ratio: float) -> None:
    """Their harmonics follow from each other and from constant colours. By chance few are left alone."""
    model, both = siblings_like(3000, 40, 0, ratio)
    alone = trained_like(3000, 0)
    assert not usable_carriers(model)[both].any()
    others = np.setdiff1d(np.arange(3000), both)
    left = usable_carriers(alone)[others] & ~usable_carriers(model)[others]
    assert left.sum() <= 20
    # In siblings, the detectors find equal steps before and after; new bits in every Gaussian end them.
    noise = np.random.default_rng(0).integers(0, 256, (3000, 53), np.uint8)
    careless = write_low_bits(model, Layout.of(model), [(8, np.arange(3000), noise)])
    every = np.ones(3000, bool)
    assert Steps(model, Layout(3)).chance(8, every) < 1e-100
    assert Steps(careless, Layout(3)).chance(8, every) > 1e-6
    assert Steps(model, Layout(3)).chance(8, usable_carriers(model)) > 1e-6


@pytest.mark.parametrize("sh_degree", [1, 3])
def test_distant_siblings_are_found_by_what_equal_steps_leave_alone(sh_degree: int) -> None:
    """As after the split of a large Gaussian."""
    model, both = siblings_like(3000, 40, 1, near=False)
    model = replace(model, sh=model.sh[:, : (sh_degree + 1) ** 2])
    found = Steps(model, Layout(sh_degree)).equal(8)
    assert found[both].all()
    assert np.delete(found, both.ravel()).mean() < 0.05


@pytest.mark.parametrize("depth", DEPTHS)
@pytest.mark.parametrize("sh_degree", [1, 2, 3])
def test_equal_steps_are_those_of_a_plain_search(sh_degree: int, depth: int) -> None:
    """All pairs of a Gaussian and its 8 nearest neighbours or zero, in NumPy; low bits are unknown."""
    model, _ = siblings_like(400, 120, sh_degree)
    model = replace(model, sh=model.sh[:, : (sh_degree + 1) ** 2])
    model.sh[:100, -1] += 1e-3 * torch.arange(1, 101)[:, None]  # no steps
    model.log_scales[:30] = model.log_scales[:30, :1].repeat(1, 3) * torch.tensor([1, 1 + 1e-6, 1 - 1e-6])
    means = model.means.double().numpy()
    words = [torch.cat([model.log_scales, model.opacity_logits[:, None]], 1), model.quats]
    words += [model.sh[:, 1:, colour] for colour in range(3)]
    apart = np.zeros(400, bool)
    for group in words:
        bits = group.contiguous().numpy().view(np.uint32)
        low = np.uint32((2 << depth) - 1)
        known = (bits & ~low | np.uint32(1 << depth)).view(np.float32).astype(float)
        cells = 2.0 ** ((bits >> 23 & 255).astype(float) - 127 + depth + 1 - 23)
        for row in range(400):
            near = np.argsort(((means - means[row]) ** 2).sum(axis=1), kind="stable")[1:9]
            pairs = [(other, known[other], cells[other]) for other in near]
            for other, its, spans in [(row, 0 * known[row], cells[row]), *pairs]:
                moved = np.abs(known[row] - np.where(other == row, (1 << depth) * 2.0**-149, its))
                span = np.maximum(cells[row], spans)
                equal = np.abs(moved[:, None] - moved) <= np.maximum(span[:, None], span)
                if equal.sum(axis=0).max() >= 3:
                    apart[[row, other]] = True
    assert min(apart.sum(), (~apart).sum()) > 30
    assert np.array_equal(Steps(model, Layout(sh_degree)).equal(depth), apart)


def in_equal_steps(pairs: int, two: tuple[int, int]) -> Gaussians:
    """Pairs of near Gaussians of which `two` harmonics differ by equal steps."""
    model = trained_like(2 * pairs)
    sh = model.sh.numpy().copy()
    steps = np.random.default_rng(0).uniform(0.002, 0.02, (pairs, 3)).astype(np.float32)
    for harmonic in two:
        sh[pairs:, harmonic] = sh[:pairs, harmonic] + steps
    near = model.means[:pairs] + 1e-4
    return replace(model, sh=torch.from_numpy(sh), means=torch.cat([model.means[:pairs], near]))


def test_covers_whose_harmonics_follow_each_other_are_refused() -> None:
    """As where training saw most Gaussians from one direction. Equal steps of two make no exclusion."""
    model = in_equal_steps(2000, (1, 5))
    usable = ~Steps(model, Layout(3)).equal(8)
    assert usable.mean() > 0.9
    with pytest.raises(UsageError, match=r"predict each other's low bits \(p = .*equal steps"):
        LOW_BITS.prepare(model)
    noise = np.random.default_rng(1).integers(0, 256, (usable.sum(), 53), np.uint8)
    LOW_BITS.prepare(write_low_bits(model, Layout.of(model), [(8, np.flatnonzero(usable), noise)]))


@pytest.mark.parametrize("factor", [1.3, 0.9, 4 / 3])
def test_multiplied_colours_are_refused(factor: float) -> None:
    """Of the floats of one exponent, not all are products."""
    model = trained_like(3000)
    with pytest.raises(UsageError, match=r"multiples of one step|not random"):
        usable_carriers(replace(model, sh=model.sh * factor))
    chances = [chance_of_lattice(used_words(trained_like(2000, seed))[:, 8:]) for seed in range(4)]
    assert min(chances) > 1e-3


def test_no_opacity_crosses_the_threshold_of_pruning() -> None:
    """Trainers remove opacities below 0.005. Those with the same fixed bits stay, and no others."""
    edge = np.float32(np.log(0.005 / 0.995))
    near = np.random.default_rng(1).integers(-1536, 1536, 1024, np.int32)
    words = edge.view(np.uint32) + near.astype(np.uint32)
    model = trained_like(1024, 0)
    model = replace(model, opacity_logits=torch.from_numpy(words.view(np.float32).copy()))
    chosen = usable_carriers(model)
    noise = np.random.default_rng(0).integers(0, 256, (chosen.sum(), 53), np.uint8)
    new = write_low_bits(model, Layout.of(model), [(8, np.flatnonzero(chosen), noise)])
    assert np.array_equal(new.opacity_logits.numpy() < edge, model.opacity_logits.numpy() < edge)
    assert chosen.mean() > 0.7
