"""Signed distances and patterns that the demo scenes are made of. Conventions as in `ray_tracer`."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np

from keyss.demo.ray_tracer import Floats, Vector, smoothstep


def sphere(points: Floats, center: Vector, radius: float) -> Floats:
    x, y, z = _from(points, center)
    distance: Floats = np.sqrt(x * x + y * y + z * z) - np.float32(radius)
    return distance


def ellipsoid(points: Floats, center: Vector, radii: Vector) -> Floats:
    """Not exact, but never more than the distance near the surface of moderately flat ellipsoids."""
    scaled = [value / np.float32(radius) for value, radius in zip(_from(points, center), radii, strict=True)]
    length = np.sqrt(sum(value * value for value in scaled))
    gradient = np.sqrt(
        sum((value / np.float32(radius)) ** 2 for value, radius in zip(scaled, radii, strict=True))
    )
    distance: Floats = length * (length - 1) / np.maximum(gradient, 1e-6)
    return distance


def capsule(points: Floats, start: Vector, end: Vector, radii: tuple[float, float]) -> Floats:
    """A rod from `start` to `end` with round ends, its radius going from the first to the second."""
    x, y, z = _from(points, start)
    ax, ay, az = (np.float32(b - a) for a, b in zip(start, end, strict=True))
    along = np.clip((x * ax + y * ay + z * az) / (ax * ax + ay * ay + az * az), 0, 1)
    away = np.sqrt((x - along * ax) ** 2 + (y - along * ay) ** 2 + (z - along * az) ** 2)
    first, last = np.float32(radii[0]), np.float32(radii[1])
    distance: Floats = (away - (first + along * (last - first))) * np.float32(0.95)
    return distance


def torus(points: Floats, center: Vector, ring: float, tube: float) -> Floats:
    """A ring that stands upright in the x-z plane."""
    x, y, z = _from(points, center)
    around = np.sqrt(x * x + z * z) - np.float32(ring)
    distance: Floats = np.sqrt(around * around + y * y) - np.float32(tube)
    return distance


def octahedron(points: Floats, center: Vector, radius: float, stretch: float) -> Floats:
    """Corners at `radius` around the vertical axis and at `stretch` x `radius` on it; edges rounded."""
    x, y, z = _from(points, center)
    rise = np.float32(1 / stretch)
    shrink = np.float32(1 / np.sqrt(2 + rise * rise))
    distance: Floats = (np.abs(x) + np.abs(y) + np.abs(z) * rise - np.float32(radius)) * shrink - 0.01
    return distance


def disc(points: Floats, center: Vector, tilt: float, radius: float, half_height: float) -> Floats:
    """A coin, leaning by `tilt` radians about the y axis, with rounded edges."""
    x, y, z = _from(points, center)
    c, s = np.float32(np.cos(tilt)), np.float32(np.sin(tilt))
    x, z = c * x + s * z, c * z - s * x
    outside = np.maximum(np.sqrt(x * x + y * y) - np.float32(radius), 0)
    above = np.maximum(np.abs(z) - np.float32(half_height), 0)
    distance: Floats = np.sqrt(outside * outside + above * above) - np.float32(0.008)
    return distance


def turned_profile(points: Floats, profile: list[tuple[float, float]], thickness: float) -> Floats:
    """A vessel: the polyline `profile` of (radius, height), turned about the vertical axis."""
    r, z = np.sqrt(points[0] ** 2 + points[1] ** 2), points[2]
    nearest = np.full(r.shape, 1e9, dtype=np.float32)
    for (r0, z0), (r1, z1) in itertools.pairwise(profile):
        dr, dz = np.float32(r1 - r0), np.float32(z1 - z0)
        along = np.clip(((r - np.float32(r0)) * dr + (z - np.float32(z0)) * dz) / (dr * dr + dz * dz), 0, 1)
        nearest = np.minimum(
            nearest, (r - np.float32(r0) - along * dr) ** 2 + (z - np.float32(z0) - along * dz) ** 2
        )
    distance: Floats = np.sqrt(nearest) - np.float32(thickness)
    return distance


def braid(points: Floats, center: Vector, ring: float, wind: float, tube: float) -> Floats:
    """A trefoil knot standing upright: a strand that winds at `wind` around a ring in the x-z plane."""
    x, y, z = _from(points, center)
    half_twist = np.float32(1.5) * np.arctan2(z, x)
    c, s = np.cos(half_twist), np.sin(half_twist)
    from_axis = np.sqrt(x * x + z * z)
    out = from_axis - np.float32(ring)
    u, v = c * out - s * y, s * out + c * y
    across = np.sqrt((np.abs(u) - np.float32(wind)) ** 2 + v * v) - np.float32(tube)
    # The twist stretches space, most near the axis; far away the ring that holds the strand bounds better.
    away2 = out * out + y * y
    stretch = np.sqrt(1 + np.float32(2.25) * away2 / np.maximum(from_axis, 0.05) ** 2)
    distance: Floats = np.maximum(across / stretch, np.sqrt(away2) - np.float32(wind + tube))
    return distance


def blend(first: Floats, second: Floats, width: float) -> Floats:
    """The union of two shapes with a fillet of about `width`."""
    gap = np.maximum(np.float32(width) - np.abs(first - second), 0)
    joined: Floats = np.minimum(first, second) - gap * gap / np.float32(4 * width)
    return joined


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
        # No matrix product: its last digits depend on the number of threads.
        for (a, b, c), phase in zip(waves, phases, strict=True):
            summed += np.sin(a * points[0] + b * points[1] + c * points[2] + phase)
        return summed / np.float32(3)

    return value


def mix(first: Vector | Floats, second: Vector | Floats, share: Floats) -> Floats:
    """[3, M] colours from `first` at share 0 to `second` at share 1; one colour or [3, M] of them each."""
    a, b = (
        np.array(color, dtype=np.float32)[:, None] if isinstance(color, tuple) else color
        for color in (first, second)
    )
    mixed: Floats = a + share * (b - a)
    return mixed


def joints(value: Floats, period: float, width: float) -> Floats:
    """[M] 1 on the lines at multiples of `period`, `width` wide with soft edges, 0 between them."""
    nearest = np.abs(value - np.float32(period) * np.rint(value / np.float32(period)))
    return 1 - smoothstep(0.3 * width, 0.8 * width, nearest)


def scattered(*cells: Floats) -> Floats:
    """[M] a number in [0, 1) for each combination of whole numbers, as good as random."""
    mixed = sum(np.float64(weight) * cell for weight, cell in zip((12.9898, 78.233), cells, strict=False))
    return (np.sin(mixed) * 43758.5453 % 1.0).astype(np.float32)


def _from(points: Floats, center: Vector) -> tuple[Floats, Floats, Floats]:
    x, y, z = points
    return x - np.float32(center[0]), y - np.float32(center[1]), z - np.float32(center[2])
