"""A small ray tracer in numpy for the demo scenes: capped cylinders exactly, other shapes by sphere tracing.

Conventions as in `ray_shapes`. It is our own because the demo's photos must be the same bytes everywhere,
without a renderer to install.
"""

# mypy: no-warn-return-any
# because numpy's functions are typed to return Any.

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from keyss.demo.ray_shapes import Distance, Floats, Vector, column, dot, length, smoothstep, turned, union

_CHUNK = 1 << 17  # rays traced at once: enough to make numpy's calls worth while, few enough for the cache
_MARCH_STEPS = 64
_HIT = np.float32(1e-3)  # well below a pixel's footprint at the distance of the demo cameras
_LIFT = np.float32(4e-3)  # start of secondary rays above their surface
_SUN_SHARPNESS = np.float32(14.0)  # distance to an occluder over distance from it at which its shadow ends
_REACH = np.float32(0.16)  # distance within which things shade each other from the sky
_RADIUS = 14.0  # of the sphere around the world's origin that shows the sky
_HAZE = (4.0, 9.0)  # horizontal distances where it begins and where all is sky
_EXPOSURE = 1.3

Indices: TypeAlias = NDArray[np.intp]


@dataclass(frozen=True)
class Surface:
    """How M points of a surface reflect light."""

    color: Floats  # [3, M] or [3, 1] diffuse reflectance, of metals the colour of what they reflect
    gloss: float = 0.0  # share of light reflected at normal incidence
    power: float = 40.0  # exponent of the highlight
    metal: float = 0.0  # 1: no diffuse light, reflections in `color`
    mirror: float = 0.0  # share of the traced scene seen in it, more at grazing angles


# Of ([3, M] points, [3, M] normals), both local to the part.
Material: TypeAlias = Callable[[Floats, Floats], Surface]


@dataclass(frozen=True)
class Slab:
    """A solid vertical cylinder with flat ends."""

    radius: float
    bottom: float
    top: float
    material: Material
    x: float = 0.0
    y: float = 0.0

    def hits(self, origins: Floats, directions: Floats, limit: Floats) -> tuple[Indices, Floats, Floats]:
        """(indices of the rays that hit it before `limit`, their distances, [3, M] unit normals)."""
        rays, t, flat = self._entered(origins, directions)
        closer = t < limit[rays]
        rays, t, flat = rays[closer], t[closer], flat[closer]
        d = directions[:, rays]
        points = origins[:, rays] + t * d
        sides = [(points[0] - self.x) / self.radius, (points[1] - self.y) / self.radius]
        return rays, t, np.where(flat, [0 * t, 0 * t, -np.sign(d[2])], [*sides, 0 * t])

    def cast_shadow(self, points: Floats, sun: Floats, share: Floats) -> None:
        """Lower the `share` [M] of the sun that each point sees."""
        share[self._entered(points, sun)[0]] = 0

    def near(self, points: Floats) -> slice:
        """Which points may be within `_REACH`."""
        return slice(None)

    def distance(self, points: Floats) -> Floats:
        """[M] at most the distance of world points."""
        away = np.sqrt((points[0] - self.x) ** 2 + (points[1] - self.y) ** 2) - self.radius
        return np.maximum(away, np.maximum(self.bottom - points[2], points[2] - self.top))

    def surfaces(self, points: Floats, normals: Floats) -> Iterator[tuple[Indices, Surface]]:
        """(which of the points, their surface) for each material."""
        yield np.arange(points.shape[1]), self.material(points, normals)

    def _entered(self, origins: Floats, directions: Floats) -> tuple[Indices, Floats, NDArray[np.bool_]]:
        """(indices of the rays that enter from outside, their distances, whether by a flat end)."""
        x, y = origins[0] - self.x, origins[1] - self.y
        dx, dy = directions[0], directions[1]
        a, b = dx * dx + dy * dy, x * dx + y * dy
        half2 = b * b - a * (x * x + y * y - np.float32(self.radius) ** 2)
        rays = np.flatnonzero(half2 > 0)
        a, b, half2 = a[rays], b[rays], half2[rays]  # most rays pass beside the narrow ones
        z, dz = origins[2][rays], directions[2][rays]
        half = np.sqrt(half2)
        with np.errstate(divide="ignore"):
            below, above = (self.bottom - z) / dz, (self.top - z) / dz
        flat = np.minimum(below, above)
        enter = np.maximum(flat, (-b - half) / a)
        hit = (enter > 0) & (enter < np.minimum(np.maximum(below, above), (half - b) / a))
        return rays[hit], enter[hit], flat[hit] == enter[hit]


class Part(NamedTuple):
    """A shape and what it is made of; the material sees the shape's local points."""

    distance: Distance
    material: Material


@dataclass(frozen=True)
class Cluster:
    """Shapes inside a sphere, placed at `origin` and turned about the vertical by `turn` radians.

    Its methods are those of `Slab`.
    """

    origin: Vector
    height: float  # of the sphere's centre above the origin
    radius: float
    parts: tuple[Part, ...]
    turn: float = 0.0

    def hits(self, origins: Floats, directions: Floats, limit: Floats) -> tuple[Indices, Floats, Floats]:
        enter, leave = self._span(origins, directions)
        leave = np.minimum(leave, limit)
        rays = np.flatnonzero(leave > enter)
        t, end = enter[rays], leave[rays]
        found, distances = [rays[:0]], [t[:0]]
        for _ in range(_MARCH_STEPS):
            if not rays.size:
                break
            d = self.distance(origins[:, rays] + t * directions[:, rays])
            hit = d < _HIT
            found.append(rays[hit])
            distances.append(t[hit])
            t = t + d
            going = ~hit & (t < end)
            rays, t, end = rays[going], t[going], end[going]
        # Rays that have not left by now creep along a surface.
        rays, t = np.concatenate([*found, rays]), np.concatenate([*distances, t])
        # Normals by differences over the corners of a tetrahedron.
        points = origins[:, rays] + t * directions[:, rays]
        normals = np.zeros_like(points)
        for corner in (column((1, -1, -1)), column((-1, -1, 1)), column((-1, 1, -1)), column((1, 1, 1))):
            normals += corner * self.distance(points + np.float32(2e-3) * corner)
        normals /= np.maximum(length(normals), np.float32(1e-12))
        return rays, t, normals

    def cast_shadow(self, points: Floats, sun: Floats, share: Floats) -> None:
        # Shadows reach beyond the shapes by their softness, so beyond the sphere of the shapes too.
        enter, leave = self._span(points, sun, margin=0.1)
        rays = np.flatnonzero((leave > enter) & (share > 0))
        t, end = enter[rays], leave[rays]
        for _ in range(_MARCH_STEPS // 2):
            if not rays.size:
                break
            d = self.distance(points[:, rays] + t * sun[:, rays])
            penumbra = np.clip(_SUN_SHARPNESS * d / np.maximum(t, 0.02), 0, 1)
            share[rays] = np.minimum(share[rays], penumbra)
            t = t + np.clip(0.8 * d, 0.012, 0.12)
            going = (t < end) & (d > _HIT)
            rays, t, end = rays[going], t[going], end[going]

    def near(self, points: Floats) -> Indices:
        return np.flatnonzero(length(points - self._center) < self.radius + _REACH)

    def distance(self, points: Floats) -> Floats:
        return union(*(part.distance for part in self.parts))(self._local(points - column(self.origin)))

    def surfaces(self, points: Floats, normals: Floats) -> Iterator[tuple[Indices, Surface]]:
        local, local_normals = self._local(points - column(self.origin)), self._local(normals)
        nearest = np.argmin([part.distance(local) for part in self.parts], axis=0)
        for number in np.unique(nearest):
            chosen = np.flatnonzero(nearest == number)
            yield chosen, self.parts[number].material(local[:, chosen], local_normals[:, chosen])

    @property
    def _center(self) -> Floats:
        """[3, 1] of the sphere, in the world."""
        return column(self.origin) + column((0.0, 0.0, self.height))

    def _local(self, vectors: Floats) -> Floats:
        """[3, M] vectors from the origin, turned with the shapes."""
        return np.stack([*turned(vectors[0], vectors[1], -self.turn), vectors[2]]) if self.turn else vectors

    def _span(self, origins: Floats, directions: Floats, margin: float = 0.0) -> tuple[Floats, Floats]:
        """([M], [M]) where rays enter and leave the cluster's sphere; leave < enter where they miss it."""
        to_center = self._center - origins
        middle = dot(to_center, directions)
        half2 = np.float32(self.radius + margin) ** 2 - dot(to_center, to_center) + middle * middle
        half = np.sqrt(np.maximum(half2, 0))
        return np.maximum(middle - half, 0), np.where(half2 > 0, middle + half, np.float32(-1))


@dataclass(frozen=True)
class World:
    """Everything there is, under a sky."""

    things: tuple[Slab | Cluster, ...]  # slabs first: they are quick to hit and spare longer marches
    sun: Vector  # unit vector towards it
    sun_color: Vector
    sky: Callable[[Floats], Floats]  # [3, M] unit directions -> [3, M]; smooth, so that highlights are
    ambient: float  # how much of the sky's light reaches a surface
    ground_color: Vector  # light from below


def trace(world: World, origins: Floats, directions: Floats) -> tuple[Floats, Floats]:
    """([3, M] sRGB colours in [0, 1], [3, M] points hit) of rays with unit `directions`."""
    colors, points = np.empty_like(origins), np.empty_like(origins)
    for start in range(0, origins.shape[1], _CHUNK):
        part = slice(start, start + _CHUNK)
        light, points[:, part] = _radiance(world, origins[:, part], directions[:, part], bounces=1)
        # A soft shoulder for any amount of light, then a little contrast.
        display = (1 - np.exp(-(_EXPOSURE * light))) ** np.float32(1 / 2.2)
        colors[:, part] = display + np.float32(0.6) * (display * display * (3 - 2 * display) - display)
    return colors, points


def _radiance(world: World, origins: Floats, directions: Floats, bounces: int) -> tuple[Floats, Floats]:
    """([3, M] light that comes along the rays, [3, M] points it comes from)."""
    middle = dot(origins, directions)
    distance = np.sqrt(middle * middle + np.float32(_RADIUS) ** 2 - dot(origins, origins)) - middle
    what, normals = np.full(distance.shape, -1), np.zeros_like(origins)  # -1: the sky
    for index, thing in enumerate(world.things):
        hit, t, hit_normals = thing.hits(origins, directions, distance)
        distance[hit], what[hit], normals[:, hit] = t, index, hit_normals
    points = origins + distance * directions
    light = world.sky(points / length(points))
    haze = smoothstep(*_HAZE, np.sqrt(points[0] * points[0] + points[1] * points[1]))
    haze[what < 0] = 1
    seen = np.flatnonzero(haze < 1)
    if seen.size:
        near = _shaded(world, points[:, seen], normals[:, seen], directions[:, seen], what[seen], bounces)
        light[:, seen] = near + haze[seen] * (light[:, seen] - near)
    return light, points


def _shaded(
    world: World, points: Floats, normals: Floats, directions: Floats, what: Indices, bounces: int
) -> Floats:
    """[3, M] light that points of the things `what` [M] send back along `directions`."""
    lit = np.maximum(dot(normals, column(world.sun)), 0)
    facing = np.flatnonzero(lit > 0)
    lit[facing] *= _sunlight(world, points[:, facing] + _LIFT * normals[:, facing])
    seen = (points, normals, directions, lit, _openness(world, points + _REACH * normals))
    light = np.empty_like(points)
    for index in np.unique(what):
        here = np.flatnonzero(what == index)
        for chosen, surface in world.things[index].surfaces(points[:, here], normals[:, here]):
            these = here[chosen]
            light[:, these] = _reflected(world, surface, bounces, *(each[..., these] for each in seen))
    return light


def _reflected(world: World, surface: Surface, bounces: int, *seen: Floats) -> Floats:
    """[3, M] light off one kind of surface: diffuse, the sun's highlight, and the sky or scene mirrored.

    `seen`: points, normals and directions of the rays [3, M], and the shares [M] of the sun's light and of
    the sky's that reach the points: less in corners and under things.
    """
    points, normals, directions, lit, openness = seen
    sun, sun_color, ground = column(world.sun), column(world.sun_color), column(world.ground_color)
    overhead = world.sky(column((0.0, 0.0, 1.0)))
    ambient = ground + (0.5 + 0.5 * normals[2]) * (overhead - ground)
    diffuse = surface.color * (sun_color * lit + world.ambient * ambient * openness)

    facing = -dot(directions, normals)
    mirrored = directions + 2 * facing * normals
    half = sun - directions
    half /= length(half)
    highlight = np.maximum(dot(half, normals), 0) ** np.float32(surface.power) * (surface.power + 8) / 8
    tint = surface.color if surface.metal else np.ones((3, 1), dtype=np.float32)
    fresnel = surface.gloss + (1 - surface.gloss) * 0.6 * np.clip(1 - facing, 0, 1) ** 5
    around = world.sky(mirrored) * openness
    if surface.mirror and bounces:
        traced, _ = _radiance(world, points + _LIFT * normals, mirrored, bounces - 1)
        around = around + surface.mirror * (traced - around)
    shine = tint * (fresnel * around + surface.gloss * sun_color * highlight * lit)
    return (1 - surface.metal) * diffuse + shine


def _sunlight(world: World, points: Floats) -> Floats:
    """[M] share of the sun seen from the points, 0 to 1; shadows soften with distance."""
    share = np.ones(points.shape[1], dtype=np.float32)
    for thing in world.things:
        thing.cast_shadow(points, np.broadcast_to(column(world.sun), points.shape), share)
    return share * share * (3 - 2 * share)


def _openness(world: World, outside: Floats) -> Floats:
    """[M] share of the sky's light that reaches surfaces, from points `_REACH` above them."""
    share = np.ones(outside.shape[1], dtype=np.float32)
    for thing in world.things:
        near = thing.near(outside)
        share[near] = np.minimum(share[near], np.clip(thing.distance(outside[:, near]) / _REACH, 0, 1))
    return 0.35 + 0.65 * share
