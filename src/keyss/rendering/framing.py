"""What a picture of a model should show: its subject, and which way is up.

The page has the same rules in `web/src/page/framing.ts`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch

from keyss.core.arrays import Doubles
from keyss.core.gaussians import Gaussians

_SAMPLE = 4_000  # Gaussians that are looked at
_SHRINK, _STEPS = 0.87, 60  # ratio of radii, and their number: down to 1/4,000
_LEAST = 0.08  # share of the weight in the smallest sphere
# Exponent of the radius in a sphere's weight: between 1, as of lines, and that of clutter around a subject.
_GROWTH = 0.87
_OUTLIERS = 0.995  # share of the weight of a model without surroundings that its sphere holds
# Ratio of the sizes of Gaussians outside and inside, above which those outside are surroundings.
_COARSER = 1.25
_SLABS, _REACH = 40, 1.2  # slabs across 1.2 radii to both sides, which may hold a floor
_ALIGNED = 0.7  # minimum cosine of a floor's normal with the direction across it
# Degrees from -y, as captures leave it: the first camera looks down or up, and is hardly rolled.
_PITCHES, _ROLLS = np.arange(-10, 56, 5), (-8, 0, 8)
_STEP, _EXACT = 5.0, 6.0  # degrees between those directions; from the axes of other programs
_TILTED_FLOOR, _AXIS_FLOOR = 0.095, 0.15  # share of the Gaussians, by size, in a floor
_CLEARLY = 1.3  # ratio of the floor across an axis to that across a tilted direction
_BELOW = 0.05  # radii by which the middle of a model is below a floor across y where y is up


@dataclass(frozen=True)
class Frame:
    """A sphere around the subject of a model, the up direction, and some of the Gaussians in the sphere."""

    middle: Doubles  # [3]
    radius: float
    up: Doubles  # [3] unit vector
    means: Doubles  # [S, 3]
    weights: Doubles  # [S] opacities
    alone: bool  # True if the model has no surroundings: the sphere holds all but outliers


@torch.no_grad()
def frame_of(model: Gaussians) -> Frame:
    """The dense, opaque part of a model, without coarse surroundings, faint Gaussians and outliers.

    The subject is the sphere with the most opacity for its size; if what lies outside is as fine, all of it.
    Up is the normal of the largest floor below most of the model, among the directions that captures have,
    and along z and y, as other programs have it; -y without a floor.
    """
    model = model[:: max(1, math.ceil(len(model) / _SAMPLE))].to("cpu")
    means, scales = model.means.double().numpy(), model.scales.double().numpy()
    weights = model.opacities.double().nan_to_num(0.0).numpy()
    if not weights.sum() > 0:
        weights = np.ones(len(model))
    ordered = np.sort(scales, axis=1)
    sizes = np.sqrt(ordered[:, 1] * ordered[:, 2])
    middle, radius = _densest(means, weights)
    inside = _distances(means, middle) < radius
    alone = bool(inside.all()) or _median(sizes[~inside], weights[~inside]) < _COARSER * _median(
        sizes[inside], weights[inside]
    )
    if alone:
        middle = _middle(means, weights)
        distances = _distances(means, middle)
        radius = max(quantile(distances, weights, _OUTLIERS), 1e-6)
        inside = distances <= radius
    large = quantile(sizes, np.ones(len(sizes)), 0.95)
    extents = weights * np.minimum(sizes, large)
    normals = _normals(model.quats.double().numpy(), scales.argmin(axis=1))
    up = _up((means[inside] - middle) / radius, normals[inside], extents[inside])
    return Frame(middle, float(radius), up, means[inside], weights[inside], alone)


def _densest(means: Doubles, weights: Doubles) -> tuple[Doubles, float]:
    """Middle and radius of the sphere with the largest weight / radius^_GROWTH."""
    middle = _middle(means, weights)
    radius = max(quantile(_distances(means, middle), weights, 0.995), 1e-6) / _SHRINK
    best, sphere = -1.0, (middle, radius)
    for _ in range(_STEPS):
        radius *= _SHRINK
        inside = _distances(means, middle) < radius
        if weights[inside].sum() < _LEAST * weights.sum():
            break
        middle = _middle(means[inside], weights[inside])
        inside = _distances(means, middle) < radius
        score = weights[inside].sum() / radius**_GROWTH
        if score > best:
            best, sphere = score, (middle, radius)
    return sphere


def _up(offsets: Doubles, normals: Doubles, extents: Doubles) -> Doubles:
    """[3] the up direction; `offsets`: from the middle, in radii; `extents`: sizes, times opacities."""
    total = max(float(extents.sum()), 1e-30)

    def largest(directions: Doubles, least_above: float = 0.0) -> tuple[float, float, Doubles]:
        """The largest floor across one of the directions [D, 3].

        Its share of the extents, how far in radii the model is above it on average, at least `least_above`,
        and the direction.
        """
        best = (0.0, 0.0, directions[0])
        for direction, heights, cosines in zip(
            directions, directions @ offsets.T, directions @ normals.T, strict=True
        ):
            slabs = ((heights / _REACH + 1) * _SLABS / 2).astype(int).clip(0, _SLABS - 1)
            held = np.bincount(slabs, extents * (np.abs(cosines) > _ALIGNED), _SLABS)
            pairs = (held[:-1] + held[1:]) / total
            floor = int(pairs.argmax())
            above = float(heights @ extents) / total - (2 * (floor + 1) / _SLABS - 1) * _REACH
            if pairs[floor] > best[0] and above > least_above:
                best = (float(pairs[floor]), above, direction)
        return best

    down, z = np.array([0.0, -1.0, 0.0]), np.array([0.0, 0.0, 1.0])
    tilted, _, direction = largest(_cap(largest(_of_captures())[2], _STEP, 20))
    level, above, _ = largest(_cap(down, _EXACT, 20), -math.inf)
    if largest(_cap(z, _EXACT, 20))[0] > max(_AXIS_FLOOR, _CLEARLY * tilted):
        return z
    if level > _AXIS_FLOOR and level * _CLEARLY > tilted:
        return down if above > -_BELOW else -down
    return direction if tilted > _TILTED_FLOOR else down


def _of_captures() -> Doubles:
    """[D, 3] up directions in the frame of a first camera that is pitched, and hardly rolled."""
    return np.array(
        [
            [math.sin(roll), -math.cos(roll) * math.cos(pitch), -math.cos(roll) * math.sin(pitch)]
            for pitch in np.radians(_PITCHES)
            for roll in np.radians(_ROLLS)
        ]
    )


def _cap(axis: Doubles, degrees: float, count: int) -> Doubles:
    """[count, 3] directions within `degrees` of `axis`, which is the first, evenly spread."""
    steps = np.arange(count)
    along = 1 - (1 - math.cos(math.radians(degrees))) * steps / count
    turns = steps * math.pi * (3 - math.sqrt(5))
    side = np.cross(axis, [1.0, 0.0, 0.0])
    side /= np.linalg.norm(side)
    across = np.sqrt(1 - along**2)[:, None]
    other = np.cross(axis, side)
    directions: Doubles = along[:, None] * axis + across * (
        np.cos(turns)[:, None] * side + np.sin(turns)[:, None] * other
    )
    return directions


def _normals(quats: Doubles, shortest: npt.NDArray[np.int64]) -> Doubles:
    """[N, 3] the shortest axes of Gaussians."""
    w, x, y, z = (quats / np.linalg.norm(quats, axis=1, keepdims=True).clip(1e-12)).T
    columns = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)],
            [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)],
            [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    axes: Doubles = columns[shortest, :, np.arange(len(quats))]
    return axes


def _middle(means: Doubles, weights: Doubles) -> Doubles:
    return np.array([_median(axis, weights) for axis in means.T])


def _median(values: Doubles, weights: Doubles) -> float:
    return quantile(values, weights, 0.5)


def quantile(values: Doubles, weights: Doubles, share: float) -> float:
    """The least of the values [N] such that those up to it have this share of the weights [N]."""
    order = np.argsort(values, kind="stable")
    total = np.cumsum(weights[order])
    return float(values[order[min(np.searchsorted(total, share * total[-1]), len(values) - 1)]])


def _distances(means: Doubles, middle: Doubles) -> Doubles:
    distances: Doubles = np.linalg.norm(means - middle, axis=1)
    return distances
