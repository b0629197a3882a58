"""Signed distances and patterns that the demo scenes are made of.

Arrays are float32 and hold one column per ray or point, so [3, M] where a vector is meant. Lengths are in
scene units with z up, colours are linear RGB. Sums over axes are spelled out: numpy is slow along a short
first axis, and the last digits of its matrix products depend on the number of threads.
"""

# mypy: no-warn-return-any
# because numpy's functions are typed to return Any.

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

Floats: TypeAlias = NDArray[np.float32]
Vector: TypeAlias = tuple[float, float, float]
Distance: TypeAlias = Callable[[Floats], Floats]  # [3, M] local points -> [M], never more than the true one


def column(vector: Vector | Floats) -> Floats:
    """[3, 1]"""
    return np.array(vector, dtype=np.float32)[:, None]


def dot(a: Floats, b: Floats) -> Floats:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def length(vectors: Floats) -> Floats:
    return np.sqrt(dot(vectors, vectors))


def turned(x: Floats, y: Floats, angle: float) -> tuple[Floats, Floats]:
    """Coordinates in a plane, turned about its origin."""
    c, s = np.float32(np.cos(angle)), np.float32(np.sin(angle))
    return c * x - s * y, s * x + c * y


def smoothstep(low: float, high: float, value: Floats) -> Floats:
    """0 below `low`, 1 above `high`, a smooth rise between them."""
    t = np.clip((value - low) / (high - low), 0, 1)
    return t * t * (3 - 2 * t)


# --- shapes ----------------------------------------------------------------------------------------------


def _shape(distance: Callable[..., Floats]) -> Callable[..., Distance]:
    """Turns a distance of (points around the shape's centre, sizes) into a `Distance` of (centre, sizes)."""

    def placed(center: Vector, *sizes: Any) -> Distance:
        return lambda points: distance(points - column(center), *sizes)

    return placed


@_shape
def sphere(points: Floats, radius: float) -> Floats:
    return length(points) - radius


@_shape
def ellipsoid(points: Floats, radii: Vector) -> Floats:
    """Not exact, but never more than the distance near the surface of moderately flat ellipsoids."""
    scaled = points / column(radii)
    size = length(scaled)
    return np.divide(size * (size - 1), np.maximum(length(scaled / column(radii)), 1e-6))


@_shape
def capsule(points: Floats, axis: Vector, radii: tuple[float, float]) -> Floats:
    """A rod along `axis` with round ends, its radius going from the first to the second."""
    along = np.clip(dot(points, column(axis)) / dot(column(axis), column(axis)), 0, 1)
    first, last = (np.float32(radius) for radius in radii)
    away = length(points - along * column(axis))
    return (away - (first + along * (last - first))) * np.float32(0.95)


@_shape
def torus(points: Floats, ring: float, tube: float) -> Floats:
    """A ring that stands upright in the x-z plane."""
    x, y, z = points
    around = np.sqrt(x * x + z * z) - ring
    return np.sqrt(around * around + y * y) - tube


@_shape
def octahedron(points: Floats, radius: float, stretch: float) -> Floats:
    """Corners at `radius` around the vertical axis and at `stretch` x `radius` on it; edges rounded."""
    x, y, z = np.abs(points)
    rise = np.float32(1 / stretch)
    return (x + y + z * rise - radius) * (1 / np.sqrt(2 + rise * rise)) - 0.01


@_shape
def coin(points: Floats, tilt: float) -> Floats:
    """A disc of radius 0.1, leaning by `tilt` radians about the y axis, with rounded edges."""
    z, x = turned(points[2], points[0], tilt)
    outside = np.maximum(np.sqrt(x * x + points[1] * points[1]) - 0.1, 0)
    above = np.maximum(np.abs(z) - 0.008, 0)
    return np.sqrt(outside * outside + above * above) - 0.008


@_shape
def braid(points: Floats, ring: float, wind: float, tube: float) -> Floats:
    """A trefoil knot standing upright: a strand that winds at `wind` around a ring in the x-z plane."""
    x, y, z = points
    half_twist = 1.5 * np.arctan2(z, x)
    c, s = np.cos(half_twist), np.sin(half_twist)
    from_axis = np.sqrt(x * x + z * z)
    out = from_axis - ring
    u, v = c * out - s * y, s * out + c * y
    across = np.sqrt((np.abs(u) - wind) ** 2 + v * v) - tube
    # The twist stretches space, most near the axis; far away the ring that holds the strand bounds better.
    away2 = out * out + y * y
    stretch = np.sqrt(1 + 2.25 * away2 / np.maximum(from_axis, 0.05) ** 2)
    return np.maximum(across / stretch, np.sqrt(away2) - (wind + tube))


def lathe(*profile: tuple[float, float], thickness: float) -> Distance:
    """A vessel: the polyline `profile` of (radius, height), turned about the vertical axis."""

    def distance(points: Floats) -> Floats:
        r, z = np.sqrt(points[0] ** 2 + points[1] ** 2), points[2]
        squares = []
        for (r0, z0), (r1, z1) in itertools.pairwise(profile):
            dr, dz = np.float32(r1 - r0), np.float32(z1 - z0)
            along = np.clip(((r - r0) * dr + (z - z0) * dz) / (dr * dr + dz * dz), 0, 1)
            squares.append((r - r0 - along * dr) ** 2 + (z - z0 - along * dz) ** 2)
        return np.sqrt(functools.reduce(np.minimum, squares)) - thickness

    return distance


def blend(first: Distance, second: Distance, width: float) -> Distance:
    """The union of two shapes with a fillet of about `width`."""

    def distance(points: Floats) -> Floats:
        a, b = first(points), second(points)
        gap = np.maximum(width - np.abs(a - b), 0)
        return np.minimum(a, b) - gap * gap / (4 * width)

    return distance


def union(*shapes: Distance) -> Distance:
    return lambda points: functools.reduce(np.minimum, [shape(points) for shape in shapes])


# --- patterns --------------------------------------------------------------------------------------------


@functools.cache
def ripples(frequency: float, seed: int, stretch: Vector = (1.0, 1.0, 1.0)) -> Callable[[Floats], Floats]:
    """A smooth random function of points in about [-1, 1].

    It is a sum of sines with wave numbers near `frequency` (radians per unit), so it has no detail
    finer than that, unlike lattice noise.
    """
    rng = np.random.default_rng(seed)
    waves = rng.normal(size=(6, 3))
    waves *= frequency * rng.uniform(0.6, 1.3, size=(6, 1)) / np.linalg.norm(waves, axis=1, keepdims=True)
    waves = (waves * np.array(stretch)).astype(np.float32)
    phases = rng.uniform(0, 2 * np.pi, size=6).astype(np.float32)

    def value(points: Floats) -> Floats:
        summed = np.zeros(points.shape[1], dtype=np.float32)
        for wave, phase in zip(waves, phases, strict=True):
            summed += np.sin(dot(wave, points) + phase)
        return summed / np.float32(3)

    return value


def mix(first: Vector | Floats, second: Vector | Floats, share: Floats) -> Floats:
    """[3, M] colours from `first` at share 0 to `second` at share 1; one colour or [3, M] of them each."""
    a, b = (column(color) if isinstance(color, tuple) else color for color in (first, second))
    return a + share * (b - a)


def joints(value: Floats, period: float, width: float) -> Floats:
    """[M] 1 on the lines at multiples of `period`, `width` wide with soft edges, 0 between them."""
    nearest = np.abs(value - np.float32(period) * np.rint(value / period))
    return 1 - smoothstep(0.3 * width, 0.8 * width, nearest)


def scattered(*cells: Floats) -> Floats:
    """[M] a number in [0, 1) for each combination of whole numbers, as good as random."""
    mixed = sum(np.float64(weight) * cell for weight, cell in zip((12.9898, 78.233), cells, strict=False))
    return (np.sin(mixed) * 43758.5453 % 1.0).astype(np.float32)
