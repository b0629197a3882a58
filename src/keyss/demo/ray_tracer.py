"""A small ray tracer in numpy for the demo scenes: capped cylinders exactly, other shapes by sphere tracing.

Arrays are float32 and hold one column per ray or point, so [3, M] where a vector is meant. Lengths are
in scene units with z up, colours are linear RGB.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

Floats: TypeAlias = NDArray[np.float32]
Vector: TypeAlias = tuple[float, float, float]

_CHUNK = 1 << 17  # rays traced at once: enough to make numpy's calls worth while, few enough for the cache
_MARCH_STEPS = 64
_HIT = np.float32(1e-3)  # well below a pixel's footprint at the distance of the demo cameras
_LIFT = np.float32(4e-3)  # start of secondary rays above their surface
_SUN_SHARPNESS = np.float32(14.0)  # distance to an occluder over distance from it at which its shadow ends


@dataclass(frozen=True)
class Surface:
    """How M points of a surface reflect light."""

    color: Floats  # [3, M] diffuse reflectance, of metals the colour of what they reflect
    gloss: float = 0.0  # share of light reflected at normal incidence
    power: float = 40.0  # exponent of the highlight
    metal: float = 0.0  # 1: no diffuse light, reflections in `color`
    mirror: float = 0.0  # share of the traced scene seen in it, more at grazing angles


Material: TypeAlias = Callable[[Floats, Floats], Surface]  # ([3, M] world points, [3, M] normals)
Distance: TypeAlias = Callable[[Floats], Floats]  # [3, M] local points -> [M], never more than the true one


@dataclass(frozen=True)
class Slab:
    """A solid vertical cylinder with flat ends."""

    radius: float
    bottom: float
    top: float
    material: Material
    x: float = 0.0
    y: float = 0.0


@dataclass(frozen=True)
class Part:
    """A shape and what it is made of; the material sees the shape's local points."""

    distance: Distance
    material: Material


@dataclass(frozen=True)
class Cluster:
    """Shapes inside a sphere, placed at `origin` and turned about the vertical by `turn` radians."""

    origin: Vector
    center: Vector  # of the sphere, relative to the origin, not turned: keep it on the vertical axis
    radius: float
    parts: tuple[Part, ...]
    turn: float = 0.0

    def local(self, points: Floats) -> Floats:
        moved = points - _column(self.origin)
        return _turned(moved, -self.turn)

    def distance(self, points: Floats) -> Floats:
        """[M] distance of world points from the nearest part."""
        local = self.local(points)
        return functools.reduce(np.minimum, [part.distance(local) for part in self.parts])


@dataclass(frozen=True)
class World:
    """Everything there is, inside a sphere around the origin that shows the sky."""

    slabs: tuple[Slab, ...]
    clusters: tuple[Cluster, ...]
    sun: Vector  # unit vector towards it
    sun_color: Vector
    sky: Callable[[Floats], Floats]  # [3, M] unit directions -> [3, M]; smooth, so that highlights are
    ambient: float  # how much of the sky's light reaches a surface
    ground_color: Vector  # light from below
    radius: float = 14.0
    haze: tuple[float, float] = (4.0, 9.0)  # horizontal distances where it begins and where all is sky
    exposure: float = 1.3


def trace(world: World, origins: Floats, directions: Floats) -> tuple[Floats, Floats]:
    """([3, M] sRGB colours in [0, 1], [3, M] points hit) of rays with unit `directions`."""
    colors, points = np.empty_like(origins), np.empty_like(origins)
    for start in range(0, origins.shape[1], _CHUNK):
        part = slice(start, start + _CHUNK)
        light, points[:, part] = _radiance(world, origins[:, part], directions[:, part], bounces=1)
        colors[:, part] = _developed(world.exposure * light)
    return colors, points


def _developed(light: Floats) -> Floats:
    """[3, M] sRGB in [0, 1] of any amount of light: a soft shoulder, then a little contrast."""
    display = (1 - np.exp(-light)) ** np.float32(1 / 2.2)
    curve = display * display * (3 - 2 * display)
    developed: Floats = display + np.float32(0.6) * (curve - display)
    return developed


def _radiance(world: World, origins: Floats, directions: Floats, bounces: int) -> tuple[Floats, Floats]:
    """([3, M] light that comes along the rays, [3, M] points it comes from)."""
    distance, what, normals = _nearest(world, origins, directions)
    points = origins + distance * directions
    outward: Floats = (points / _length(points)).astype(np.float32, copy=False)
    light = world.sky(outward)
    across = np.sqrt(points[0] * points[0] + points[1] * points[1])
    haze = smoothstep(*world.haze, across)
    haze[what < 0] = 1
    seen = np.flatnonzero(haze < 1)
    if seen.size:
        p, n, d = points[:, seen], normals[:, seen], directions[:, seen]
        near = _shade(world, p, n, d, what[seen], bounces)
        light[:, seen] = near + haze[seen] * (light[:, seen] - near)
    return light, points


def _nearest(world: World, origins: Floats, directions: Floats) -> tuple[Floats, NDArray[np.int64], Floats]:
    """([M] distance, [M] what is hit, [3, M] unit normals); what: slabs, then clusters; -1: sky."""
    distance = _sphere_exit(origins, directions, world.radius)
    what = np.full(distance.shape, -1)
    normals = np.zeros_like(origins)
    for index, slab in enumerate(world.slabs):
        rays, t, flat = _enter_slab(slab, origins, directions)
        closer = t < distance[rays]
        hit, t = rays[closer], t[closer]
        if hit.size:
            distance[hit], what[hit] = t, index
            d = directions[:, hit]
            normals[:, hit] = _slab_normals(slab, origins[:, hit] + t * d, d, flat[closer])
    for index, cluster in enumerate(world.clusters, start=len(world.slabs)):
        hit, t = _march(cluster, origins, directions, distance)
        if hit.size:
            distance[hit], what[hit] = t, index
            normals[:, hit] = _gradient(cluster, origins[:, hit] + t * directions[:, hit])
    return distance, what, normals


def _shade(
    world: World, points: Floats, normals: Floats, directions: Floats, what: NDArray[np.int64], bounces: int
) -> Floats:
    """[3, M] light that the points send back along `directions`."""
    light = np.empty_like(points)
    sun = _column(world.sun)
    lit = np.maximum(_dot(normals, sun), 0)
    facing = np.flatnonzero(lit > 0)
    lit[facing] *= _sunlight(world, points[:, facing] + _LIFT * normals[:, facing])
    openness = _openness(world, points, normals)
    for index in np.unique(what):
        here = np.flatnonzero(what == index)
        for chosen, surface in _surfaces(world, int(index), points[:, here], normals[:, here]):
            these = here[chosen]
            light[:, these] = _reflect(
                world,
                surface,
                points[:, these],
                normals[:, these],
                directions[:, these],
                lit[these],
                openness[these],
                bounces,
            )
    return light


def _surfaces(
    world: World, index: int, points: Floats, normals: Floats
) -> list[tuple[NDArray[np.intp], Surface]]:
    """(which of the points, their surface) for each material of one slab or cluster."""
    if index < len(world.slabs):
        return [(np.arange(points.shape[1]), world.slabs[index].material(points, normals))]
    cluster = world.clusters[index - len(world.slabs)]
    local, local_normals = cluster.local(points), _turned(normals, -cluster.turn)
    nearest = np.argmin([part.distance(local) for part in cluster.parts], axis=0)
    found = []
    for number, part in enumerate(cluster.parts):
        chosen = np.flatnonzero(nearest == number)
        if chosen.size:
            found.append((chosen, part.material(local[:, chosen], local_normals[:, chosen])))
    return found


def _reflect(
    world: World,
    surface: Surface,
    points: Floats,
    normals: Floats,
    directions: Floats,
    lit: Floats,
    openness: Floats,
    bounces: int,
) -> Floats:
    """[3, M] light off one kind of surface: diffuse, the sun's highlight, and the sky or scene mirrored."""
    sun = _column(world.sun)
    sun_color, ground = _column(world.sun_color), _column(world.ground_color)
    overhead = world.sky(np.array([[0.0], [0.0], [1.0]], dtype=np.float32))
    ambient = ground + (0.5 + 0.5 * normals[2]) * (overhead - ground)
    diffuse = surface.color * (sun_color * lit + world.ambient * ambient * openness)

    facing = -_dot(directions, normals)
    mirrored = directions + 2 * facing * normals
    half = sun - directions
    half /= _length(half)
    highlight = np.maximum(_dot(half, normals), 0) ** np.float32(surface.power) * (surface.power + 8) / 8
    tint = surface.color if surface.metal else np.ones((3, 1), dtype=np.float32)
    fresnel = surface.gloss + (1 - surface.gloss) * 0.6 * np.clip(1 - facing, 0, 1) ** 5
    around = world.sky(mirrored) * openness
    if surface.mirror and bounces:
        traced, _ = _radiance(world, points + _LIFT * normals, mirrored, bounces - 1)
        around = around + surface.mirror * (traced - around)
    shine = tint * (fresnel * around + surface.gloss * sun_color * highlight * lit)
    light: Floats = (1 - surface.metal) * diffuse + shine
    return light


def _sunlight(world: World, points: Floats) -> Floats:
    """[M] share of the sun seen from the points, 0 to 1; shadows soften with distance."""
    sun = np.broadcast_to(_column(world.sun), points.shape)
    share = np.ones(points.shape[1], dtype=np.float32)
    for slab in world.slabs:
        share[_enter_slab(slab, points, sun)[0]] = 0
    for cluster in world.clusters:
        # Shadows reach beyond the shapes by their softness, so beyond the sphere of the shapes too.
        enter, leave = _span(cluster, points, sun, margin=0.1)
        rays = np.flatnonzero((leave > enter) & (share > 0))
        t, end = enter[rays], leave[rays]
        for _ in range(_MARCH_STEPS // 2):
            if not rays.size:
                break
            d = cluster.distance(points[:, rays] + t * sun[:, rays])
            penumbra = np.clip(_SUN_SHARPNESS * d / np.maximum(t, 0.02), 0, 1)
            share[rays] = np.minimum(share[rays], penumbra)
            t = t + np.clip(0.8 * d, 0.012, 0.12)
            going = (t < end) & (d > _HIT)
            rays, t, end = rays[going], t[going], end[going]
    return share * share * (3 - 2 * share)


def _openness(world: World, points: Floats, normals: Floats) -> Floats:
    """[M] share of the sky's light that reaches the points: less in corners and under things."""
    reach = np.float32(0.16)
    outside = points + reach * normals
    share = np.ones(points.shape[1], dtype=np.float32)
    for cluster in world.clusters:
        center = _column(cluster.origin) + _column(cluster.center)
        near = np.flatnonzero(_length(outside - center) < cluster.radius + reach)
        if near.size:
            share[near] = np.minimum(share[near], np.clip(cluster.distance(outside[:, near]) / reach, 0, 1))
    for slab in world.slabs:
        away = np.sqrt((outside[0] - slab.x) ** 2 + (outside[1] - slab.y) ** 2) - slab.radius
        beside = np.maximum(away, np.maximum(slab.bottom - outside[2], outside[2] - slab.top))
        share = np.minimum(share, np.clip(beside / reach, 0, 1))
    return 0.35 + 0.65 * share


def _march(
    cluster: Cluster, origins: Floats, directions: Floats, limit: Floats
) -> tuple[NDArray[np.intp], Floats]:
    """(indices of the rays that hit the cluster before `limit`, their distances)."""
    enter, leave = _span(cluster, origins, directions)
    leave = np.minimum(leave, limit)
    rays = np.flatnonzero(leave > enter)
    t, end = enter[rays], leave[rays]
    hits, distances = [rays[:0]], [t[:0]]
    for _ in range(_MARCH_STEPS):
        if not rays.size:
            break
        d = cluster.distance(origins[:, rays] + t * directions[:, rays])
        hit = d < _HIT
        hits.append(rays[hit])
        distances.append(t[hit])
        t = t + d
        going = ~hit & (t < end)
        rays, t, end = rays[going], t[going], end[going]
    # Rays that have not left by now creep along a surface.
    return np.concatenate([*hits, rays]), np.concatenate([*distances, t])


def _span(
    cluster: Cluster, origins: Floats, directions: Floats, margin: float = 0.0
) -> tuple[Floats, Floats]:
    """([M], [M]) where rays enter and leave the cluster's sphere; leave < enter where they miss it."""
    to_center = _column(cluster.origin) + _column(cluster.center) - origins
    middle = _dot(to_center, directions)
    half2 = np.float32(cluster.radius + margin) ** 2 - _dot(to_center, to_center) + middle * middle
    half = np.sqrt(np.maximum(half2, 0))
    return np.maximum(middle - half, 0), np.where(half2 > 0, middle + half, np.float32(-1))


def _gradient(cluster: Cluster, points: Floats) -> Floats:
    """[3, M] unit normals, by differences over the corners of a tetrahedron."""
    normals = np.zeros_like(points)
    for corner in ((1, -1, -1), (-1, -1, 1), (-1, 1, -1), (1, 1, 1)):
        offset = np.array(corner, dtype=np.float32)[:, None]
        normals += offset * cluster.distance(points + np.float32(2e-3) * offset)
    normals /= np.maximum(_length(normals), np.float32(1e-12))
    return normals


def _enter_slab(
    slab: Slab, origins: Floats, directions: Floats
) -> tuple[NDArray[np.intp], Floats, NDArray[np.bool_]]:
    """(indices of the rays that enter the slab from outside, their distances, whether by a flat end)."""
    x, y = origins[0] - np.float32(slab.x), origins[1] - np.float32(slab.y)
    dx, dy = directions[0], directions[1]
    a, b = dx * dx + dy * dy, x * dx + y * dy
    half2 = b * b - a * (x * x + y * y - np.float32(slab.radius) ** 2)
    rays = np.flatnonzero(half2 > 0)
    if rays.size < half2.size:  # most rays pass beside the narrow ones
        a, b, half2 = a[rays], b[rays], half2[rays]
    z, dz = origins[2][rays], directions[2][rays]
    half = np.sqrt(half2)
    with np.errstate(divide="ignore"):
        below, above = (slab.bottom - z) / dz, (slab.top - z) / dz
    flat = np.minimum(below, above)
    enter = np.maximum(flat, (-b - half) / a)
    hit = (enter > 0) & (enter < np.minimum(np.maximum(below, above), (half - b) / a))
    return rays[hit], enter[hit], flat[hit] == enter[hit]


def _slab_normals(slab: Slab, points: Floats, directions: Floats, flat: NDArray[np.bool_]) -> Floats:
    normals = np.zeros_like(points)
    normals[0] = np.where(flat, 0, (points[0] - slab.x) / slab.radius)
    normals[1] = np.where(flat, 0, (points[1] - slab.y) / slab.radius)
    normals[2] = np.where(flat, -np.sign(directions[2]), 0)
    return normals


def _sphere_exit(origins: Floats, directions: Floats, radius: float) -> Floats:
    """[M] distance along rays that start inside the sphere around the world's origin."""
    middle = _dot(origins, directions)
    exit_: Floats = np.sqrt(middle * middle + np.float32(radius) ** 2 - _dot(origins, origins)) - middle
    return exit_


def _turned(points: Floats, angle: float) -> Floats:
    """[3, M] points turned about the vertical axis."""
    if angle == 0:
        return points
    c, s = np.float32(math.cos(angle)), np.float32(math.sin(angle))
    return np.stack([c * points[0] - s * points[1], s * points[0] + c * points[1], points[2]])


def _dot(a: Floats, b: Floats) -> Floats:
    """[M]; spelled out because numpy is slow to sum along a short first axis."""
    product: Floats = a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
    return product


def _length(vectors: Floats) -> Floats:
    length: Floats = np.sqrt(_dot(vectors, vectors))
    return length


def _column(vector: Vector) -> Floats:
    return np.array(vector, dtype=np.float32)[:, None]


def smoothstep(low: float, high: float, value: Floats) -> Floats:
    """0 below `low`, 1 above `high`, a smooth rise between them."""
    t = np.clip((value - np.float32(low)) / np.float32(high - low), 0, 1)
    smooth: Floats = t * t * (3 - 2 * t)
    return smooth
