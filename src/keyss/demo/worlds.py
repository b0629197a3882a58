"""The two worlds of the demo: a tea table in a garden, and a golden knot in a temple at dusk."""

from __future__ import annotations

import math
from functools import partial

import numpy as np

from keyss.demo import ray_shapes as shapes
from keyss.demo.ray_shapes import Floats, Vector, column, joints, mix, ripples, scattered, smoothstep, turned
from keyss.demo.ray_tracer import Cluster, Material, Part, Slab, Surface, World

_BLACK, _GLAZE, _COBALT = (0.0, 0.0, 0.0), (0.87, 0.87, 0.84), (0.03, 0.09, 0.42)


def tea_table(seed: int) -> World:
    """A teapot, cups and fruit on a round wooden table that stands on a terrace in the grass."""
    wood, porcelain = _plain((0.30, 0.18, 0.10)), partial(_porcelain, seed)
    white, tea = _plain((0.86, 0.84, 0.78), gloss=0.04), _plain((0.42, 0.15, 0.03), gloss=0.05)
    cup = (Part(_CUP, _cup_glaze), Part(shapes.lathe((0.0, 0.15), (0.14, 0.15), thickness=0.006), tea))
    bowl = shapes.lathe((0.0, 0.03), (0.12, 0.03), (0.27, 0.09), (0.36, 0.22), thickness=0.018)
    fruits = [
        Part(shapes.sphere(center, radius), partial(_peel, seed, color))
        for center, radius, color in (
            ((0.15, 0.02, 0.19), 0.135, (0.93, 0.36, 0.03)),
            ((-0.10, 0.14, 0.19), 0.13, (0.95, 0.42, 0.04)),
            ((-0.08, -0.14, 0.19), 0.135, (0.90, 0.30, 0.03)),
            ((0.00, 0.01, 0.37), 0.125, (0.95, 0.72, 0.06)),
        )
    ]
    sugar = shapes.lathe((0.0, 0.02), (0.13, 0.03), (0.17, 0.12), (0.13, 0.2), thickness=0.016)
    return World(
        things=(
            Slab(40.0, -2.0, -1.0, partial(_terrace, seed)),
            Slab(1.75, -0.1, 0.0, partial(_table_top, seed)),
            Slab(0.16, -0.95, -0.1, wood),
            Slab(0.55, -1.0, -0.95, wood),
            Cluster((-0.15, 0.12, 0.0), 0.36, 0.84, (Part(_TEAPOT, porcelain), Part(_LID, porcelain)), -0.6),
            Cluster((0.62, -0.62, 0.0), 0.12, 0.32, cup, 0.4),
            Cluster((-0.95, -0.55, 0.0), 0.12, 0.32, cup, 2.6),
            Cluster((0.68, 0.72, 0.0), 0.22, 0.46, (Part(bowl, _bowl_glaze), *fruits)),
            Cluster((-0.9, 0.75, 0.0), 0.12, 0.3, (Part(sugar, white),)),
        ),
        sun=_unit(0.55, -0.35, 0.75),
        sun_color=(1.25, 1.12, 0.90),
        sky=_day,
        ambient=0.5,
        ground_color=(0.16, 0.19, 0.10),
    )


def golden_knot(seed: int) -> World:
    """A golden trefoil knot around a sapphire, on marble steps between four columns."""
    stone, gold = partial(_porphyry, seed), partial(_gold, seed)
    steps = [
        Slab(radius, bottom, bottom + 0.13, partial(_marble, seed))
        for radius, bottom in ((1.15, 0.0), (0.86, 0.13), (0.57, 0.26))
    ]
    columns, lamps = [], []
    ruby = Part(shapes.octahedron((0.0, 0.0, 0.19), 0.115, 1.5), partial(_gem, (0.75, 0.03, 0.06)))
    for k in range(4):
        x, y = (1.75 * f(math.pi / 4 + k * math.pi / 2) for f in (math.cos, math.sin))
        rings = ((0.19, 0.0, 0.08), (0.125, 0.08, 0.44), (0.19, 0.44, 0.51))
        columns += [Slab(radius, bottom, top, stone, x, y) for radius, bottom, top in rings]
        lamps.append(Cluster((x, y, 0.51), 0.19, 0.2, (ruby,), 0.3 + k))
    knot = Part(shapes.braid((0.0, 0.0, 0.68), 0.42, 0.155, 0.1), gold)
    sapphire = Part(shapes.octahedron((0.0, 0.0, 0.0), 0.14, 1.5), partial(_gem, (0.04, 0.20, 0.85)))
    return World(
        things=(
            *(Slab(40.0, -1.0, 0.0, partial(_mosaic, seed)), *steps, *columns),
            Cluster((0.0, 0.0, 0.39), 0.68, 0.72, (knot,), 0.35),
            Cluster((0.0, 0.0, 1.07), 0.0, 0.24, (sapphire,), 0.7),
            *(*lamps, *_coins(gold)),
        ),
        sun=_unit(-0.45, 0.5, 0.62),
        sun_color=(1.45, 1.08, 0.72),
        sky=_dusk,
        ambient=0.75,
        ground_color=(0.12, 0.08, 0.10),
    )


def _coins(gold: Material) -> list[Cluster]:
    """Small piles of gold on the lowest step's foot, each with a coin that leans on it."""
    piles = []
    for x, y, layers in ((1.42, 0.25, 5), (-0.35, 1.45, 3), (-1.35, -0.30, 6), (0.2, -1.45, 4)):
        coins = [
            shapes.coin((0.02 * math.sin(2.3 * i), 0.02 * math.cos(3.1 * i), 0.022 + 0.04 * i), 0.0)
            for i in range(layers)
        ]
        parts = tuple(Part(shape, gold) for shape in (*coins, shapes.coin((0.145, 0.0, 0.09), -1.1)))
        piles.append(Cluster((x, y, 0.0), 0.1, 0.32, parts, x - y))
    return piles


def _unit(x: float, y: float, z: float) -> Vector:
    length = math.sqrt(x * x + y * y + z * z)
    return x / length, y / length, z / length


# --- skies -----------------------------------------------------------------------------------------------


def _day(directions: Floats) -> Floats:
    sky = mix((0.72, 0.80, 0.86), (0.22, 0.42, 0.80), smoothstep(-0.05, 0.9, directions[2]))
    return mix((0.20, 0.27, 0.12), sky, smoothstep(-0.25, 0.12, directions[2]))


def _dusk(directions: Floats) -> Floats:
    west = np.clip(directions[0] * -0.67 + directions[1] * 0.74, -1, 1)
    horizon = mix((0.34, 0.16, 0.34), (1.25, 0.52, 0.16), (0.5 + 0.5 * west) ** 2)
    sky = mix(horizon, (0.05, 0.07, 0.22), smoothstep(-0.02, 0.75, directions[2]))
    return mix((0.05, 0.04, 0.09), sky, smoothstep(-0.2, 0.1, directions[2]))


# --- the tea table ---------------------------------------------------------------------------------------


_SPOUT = shapes.blend(
    shapes.capsule((0.30, 0.0, 0.22), (0.26, 0.0, 0.18), (0.10, 0.055)),
    shapes.capsule((0.56, 0.0, 0.40), (0.11, 0.0, 0.17), (0.055, 0.036)),
    0.06,
)
_BODY = shapes.blend(shapes.ellipsoid((0.0, 0.0, 0.31), (0.42, 0.42, 0.30)), _SPOUT, 0.08)
_TEAPOT = shapes.blend(_BODY, shapes.torus((-0.46, 0.0, 0.35), 0.18, 0.036), 0.05)
_LID = shapes.blend(
    shapes.ellipsoid((0.0, 0.0, 0.585), (0.21, 0.21, 0.07)), shapes.sphere((0.0, 0.0, 0.70), 0.055), 0.05
)
_CUP = shapes.union(
    shapes.lathe((0.0, 0.012), (0.17, 0.014), (0.25, 0.04), thickness=0.011),  # the saucer
    shapes.lathe((0.0, 0.03), (0.09, 0.035), (0.14, 0.10), (0.155, 0.21), thickness=0.012),
    shapes.torus((0.19, 0.0, 0.125), 0.055, 0.014),
)


def _table_top(seed: int, p: Floats, n: Floats) -> Surface:
    plank = np.floor(p[1] / 0.29)
    shifted = p + np.stack([np.zeros_like(plank), 0.37 * plank, 1.9 * plank])
    grain = ripples(9.0, seed, (0.12, 1.0, 1.0))(shifted)
    tone = ripples(22.0, seed + 1, (0.15, 1.0, 1.0))(shifted)
    share = 0.5 + 0.28 * grain + 0.14 * tone + 0.35 * (scattered(plank) - 0.5)
    wood = mix((0.25, 0.11, 0.04), (0.60, 0.34, 0.15), np.clip(share, 0, 1))
    wood *= 1 - 0.65 * joints(p[1], 0.29, 0.03)
    return Surface(_cloth(p, wood), gloss=0.03, power=24, mirror=0.35)


def _cloth(p: Floats, below: Floats) -> Floats:
    """A gingham cloth lying on the table, drawn over its wood."""
    u, v = turned(p[0], p[1], -0.45)
    edge = np.maximum(np.abs(u), np.abs(v))
    stripes = [smoothstep(-0.3, 0.3, np.sin(2 * math.pi / 0.32 * w)) for w in (u, v)]
    woven = mix((0.88, 0.86, 0.80), (0.50, 0.03, 0.05), 0.5 * (stripes[0] + stripes[1]))
    woven = mix(woven, (0.88, 0.86, 0.80), smoothstep(0.92, 0.94, edge))
    on_top = (1 - smoothstep(1.0, 1.02, edge)) * (p[2] > -0.01)
    return mix(below, woven, on_top.astype(np.float32))


def _terrace(seed: int, p: Floats, n: Floats) -> Surface:
    blotch, tuft = ripples(5.0, seed + 2)(p), ripples(11.0, seed + 3)(p)
    row = np.floor(p[1] / 0.62)
    x = p[0] + 0.31 * (row % 2)
    share = 0.5 * scattered(np.floor(x / 0.62), row) + 0.25 + 0.2 * blotch
    tiles = mix((0.36, 0.24, 0.19), (0.62, 0.50, 0.40), np.clip(share, 0, 1))
    tiles = mix(tiles, (0.17, 0.19, 0.12), np.maximum(joints(x, 0.62, 0.07), joints(p[1], 0.62, 0.07)))
    grass = mix((0.07, 0.17, 0.04), (0.24, 0.38, 0.09), 0.5 + 0.3 * tuft + 0.2 * blotch)
    return Surface(mix(tiles, grass, smoothstep(2.7, 2.95, np.hypot(p[0], p[1]) + 0.12 * blotch)))


def _porcelain(seed: int, p: Floats, n: Floats) -> Surface:
    """White glaze with cobalt petals around the belly and bands above and below."""
    angle, r = np.arctan2(p[1], p[0]), np.hypot(p[0], p[1])
    belly = np.abs(p[2] - 0.29) / 0.13
    petals = smoothstep(-0.06, 0.06, np.abs(np.cos(4 * angle)) - belly)
    cores = smoothstep(0.42, 0.52, np.abs(np.cos(4 * angle)) - belly)
    heights = (0.11, 0.47, 0.56, 0.665)
    bands = np.maximum.reduce([1 - smoothstep(0.010, 0.022, np.abs(p[2] - z)) for z in heights])
    on_body, on_spout = 1 - smoothstep(0.43, 0.45, r), smoothstep(0.58, 0.60, r)
    drawn = np.maximum(petals - 0.6 * cores, bands) * on_body
    blue = np.clip(drawn * (0.85 + 0.15 * ripples(14.0, seed + 4)(p)) + on_spout, 0, 1)
    return Surface(mix(_GLAZE, _COBALT, blue), gloss=0.06, power=70)


def _cup_glaze(p: Floats, n: Floats) -> Surface:
    r = np.hypot(p[0], p[1])
    band = np.maximum(1 - smoothstep(0.012, 0.022, np.abs(p[2] - 0.175)), smoothstep(0.215, 0.23, r))
    return Surface(mix(_GLAZE, _COBALT, band), gloss=0.05, power=60)


def _bowl_glaze(p: Floats, n: Floats) -> Surface:
    share = smoothstep(0.06, 0.2, p[2] + 0.02 * np.sin(8 * np.arctan2(p[1], p[0])))
    return Surface(mix((0.02, 0.20, 0.22), (0.10, 0.52, 0.48), share), gloss=0.06, power=60)


def _peel(seed: int, color: Vector, p: Floats, n: Floats) -> Surface:
    pores = ripples(30.0, seed + 5)(p)
    return Surface(mix(_BLACK, color, 0.93 + 0.07 * pores), gloss=0.03, power=18)


# --- the golden knot -------------------------------------------------------------------------------------


def _gold(seed: int, p: Floats, n: Floats) -> Surface:
    tone = mix((0.78, 0.44, 0.09), (1.0, 0.76, 0.32), np.clip(0.5 + 0.4 * ripples(26.0, seed)(p), 0, 1))
    return Surface(tone, gloss=0.75, power=16, metal=0.6)


def _gem(color: Vector, p: Floats, n: Floats) -> Surface:
    return Surface(mix(_BLACK, color, 0.75 + 0.25 * n[2]), gloss=0.12, power=50)


def _marble(seed: int, p: Floats, n: Floats) -> Surface:
    bend, vein = ripples(4.0, seed + 1)(p), ripples(7.0, seed + 2)(p)
    line = np.abs(np.sin(5 * (p[0] + p[1] * 0.6 + p[2]) + 2.2 * bend))
    veins = (1 - smoothstep(0.03, 0.22, line)) * (0.55 + 0.35 * vein)
    stone = mix((0.03, 0.17, 0.12), (0.07, 0.30, 0.21), np.clip(0.5 + 0.5 * bend, 0, 1))
    return Surface(mix(stone, (0.80, 0.85, 0.76), np.clip(veins, 0, 1)), gloss=0.05, power=60)


def _porphyry(seed: int, p: Floats, n: Floats) -> Surface:
    share = np.clip(0.45 + 0.3 * ripples(6.0, seed + 4)(p) + 0.25 * ripples(34.0, seed + 3)(p), 0, 1)
    return Surface(mix((0.24, 0.06, 0.10), (0.62, 0.30, 0.30), share), gloss=0.04, power=30)


def _mosaic(seed: int, p: Floats, n: Floats) -> Surface:
    """Rings of wedge-shaped tiles around the steps, flagstones beyond."""
    r, angle = np.hypot(p[0], p[1]), np.arctan2(p[1], p[0]) / (2 * math.pi)
    tone = ripples(5.0, seed + 5)(p)
    ring = np.floor(r / 0.32)
    wedge = angle * 32 + 0.5 * (ring % 2)
    tiles = mix((0.06, 0.11, 0.30), (0.62, 0.56, 0.46), (np.floor(wedge) + ring) % 2)
    tiles *= 0.85 + 0.3 * (scattered(np.floor(wedge), ring) - 0.5) + 0.12 * tone
    tiles = mix(tiles, (0.55, 0.36, 0.10), joints(r, 0.32, 0.045))
    flag = scattered(np.floor(p[0] / 0.8), np.floor(p[1] / 0.8))
    share = np.clip(0.5 + 0.4 * tone + 0.5 * (flag - 0.5), 0, 1)
    flags = mix((0.13, 0.11, 0.17), (0.26, 0.22, 0.28), share)
    seams = np.maximum(joints(p[0], 0.8, 0.07), joints(p[1], 0.8, 0.07))
    # Far seams are finer than a pixel.
    flags *= 1 - 0.6 * seams * (1 - smoothstep(3.0, 5.5, r))
    return Surface(mix(tiles, flags, smoothstep(2.54, 2.58, r)), gloss=0.06, power=40, mirror=0.8)


def _plain(color: Vector, gloss: float = 0.02) -> Material:
    return lambda p, n: Surface(column(color), gloss=gloss)
