"""The two worlds of the demo: a tea table in a garden, and a golden knot in a temple at dusk."""

from __future__ import annotations

import math
from functools import partial

import numpy as np

from keyss.demo.ray_shapes import (
    blend,
    braid,
    capsule,
    disc,
    ellipsoid,
    joints,
    mix,
    octahedron,
    ripples,
    scattered,
    sphere,
    torus,
    turned_profile,
)
from keyss.demo.ray_tracer import (
    Cluster,
    Floats,
    Material,
    Part,
    Slab,
    Surface,
    Vector,
    World,
    smoothstep,
)


def tea_table(seed: int) -> World:
    """A teapot, cups and fruit on a round wooden table that stands on a terrace in the grass."""
    table = Slab(1.75, -0.1, 0.0, _table_top(seed))
    leg = Slab(0.16, -0.95, -0.1, _plain((0.30, 0.18, 0.10)))
    foot = Slab(0.55, -1.0, -0.95, _plain((0.30, 0.18, 0.10)))
    ground = Slab(40.0, -2.0, -1.0, _terrace(seed))
    white, tea = _plain((0.86, 0.84, 0.78), gloss=0.04), _plain((0.42, 0.15, 0.03), gloss=0.05)

    porcelain = _porcelain(seed)
    teapot = Cluster(
        (-0.15, 0.12, 0.0),
        (0.0, 0.0, 0.36),
        0.84,
        (Part(_teapot, porcelain), Part(_lid, porcelain)),
        turn=-0.6,
    )
    cup = (
        Part(_cup, _cup_glaze),
        Part(partial(turned_profile, profile=[(0.0, 0.15), (0.14, 0.15)], thickness=0.006), tea),
    )
    cups = [
        Cluster((0.62, -0.62, 0.0), (0.0, 0.0, 0.12), 0.32, cup, turn=0.4),
        Cluster((-0.95, -0.55, 0.0), (0.0, 0.0, 0.12), 0.32, cup, turn=2.6),
    ]
    fruits = [
        ((0.15, 0.02, 0.19), 0.135, (0.93, 0.36, 0.03)),
        ((-0.10, 0.14, 0.19), 0.13, (0.95, 0.42, 0.04)),
        ((-0.08, -0.14, 0.19), 0.135, (0.90, 0.30, 0.03)),
        ((0.00, 0.01, 0.37), 0.125, (0.95, 0.72, 0.06)),
    ]
    bowl = Cluster(
        (0.68, 0.72, 0.0),
        (0.0, 0.0, 0.22),
        0.46,
        (
            Part(
                partial(
                    turned_profile,
                    profile=[(0.0, 0.03), (0.12, 0.03), (0.27, 0.09), (0.36, 0.22)],
                    thickness=0.018,
                ),
                _bowl_glaze,
            ),
            *(
                Part(partial(sphere, center=center, radius=radius), _peel(color, seed))
                for center, radius, color in fruits
            ),
        ),
    )
    sugar = Cluster(
        (-0.9, 0.75, 0.0),
        (0.0, 0.0, 0.12),
        0.3,
        (
            Part(
                partial(
                    turned_profile,
                    profile=[(0.0, 0.02), (0.13, 0.03), (0.17, 0.12), (0.13, 0.2)],
                    thickness=0.016,
                ),
                white,
            ),
        ),
    )
    return World(
        slabs=(ground, table, leg, foot),
        clusters=(teapot, *cups, bowl, sugar),
        sun=_unit(0.55, -0.35, 0.75),
        sun_color=(1.25, 1.12, 0.90),
        sky=_day,
        ambient=0.5,
        ground_color=(0.16, 0.19, 0.10),
    )


def golden_knot(seed: int) -> World:
    """A golden trefoil knot around a sapphire, on marble steps between four columns."""
    marble, stone = _marble(seed), _porphyry(seed)
    steps = [
        Slab(radius, bottom, bottom + 0.13, marble)
        for radius, bottom in ((1.15, 0.0), (0.86, 0.13), (0.57, 0.26))
    ]
    columns: list[Slab] = []
    lamps: list[Cluster] = []
    for k in range(4):
        x, y = (1.75 * f(math.pi / 4 + k * math.pi / 2) for f in (math.cos, math.sin))
        columns += [
            Slab(0.19, 0.0, 0.08, stone, x, y),
            Slab(0.125, 0.08, 0.44, stone, x, y),
            Slab(0.19, 0.44, 0.51, stone, x, y),
        ]
        ruby = Part(
            partial(octahedron, center=(0.0, 0.0, 0.19), radius=0.115, stretch=1.5), _gem((0.75, 0.03, 0.06))
        )
        lamps.append(Cluster((x, y, 0.51), (0.0, 0.0, 0.19), 0.2, (ruby,), turn=0.3 + k))
    gold = _gold(seed)
    knot = Cluster(
        (0.0, 0.0, 0.39),
        (0.0, 0.0, 0.68),
        0.72,
        (Part(partial(braid, center=(0.0, 0.0, 0.68), ring=0.42, wind=0.155, tube=0.1), gold),),
        turn=0.35,
    )
    sapphire = Cluster(
        (0.0, 0.0, 1.07),
        (0.0, 0.0, 0.0),
        0.24,
        (
            Part(
                partial(octahedron, center=(0.0, 0.0, 0.0), radius=0.14, stretch=1.5),
                _gem((0.04, 0.20, 0.85)),
            ),
        ),
        turn=0.7,
    )
    return World(
        slabs=(Slab(40.0, -1.0, 0.0, _mosaic(seed)), *steps, *columns),
        clusters=(knot, sapphire, *lamps, *_coins(gold)),
        sun=_unit(-0.45, 0.5, 0.62),
        sun_color=(1.45, 1.08, 0.72),
        sky=_dusk,
        ambient=0.75,
        ground_color=(0.12, 0.08, 0.10),
    )


# --- skies -----------------------------------------------------------------------------------------------


def _day(directions: Floats) -> Floats:
    blue: Vector = (0.22, 0.42, 0.80)
    sky = mix((0.72, 0.80, 0.86), blue, smoothstep(-0.05, 0.9, directions[2]))
    return mix((0.20, 0.27, 0.12), sky, smoothstep(-0.25, 0.12, directions[2]))


def _dusk(directions: Floats) -> Floats:
    west = np.clip(directions[0] * np.float32(-0.67) + directions[1] * np.float32(0.74), -1, 1)
    horizon = mix((0.34, 0.16, 0.34), (1.25, 0.52, 0.16), (0.5 + 0.5 * west) ** 2)
    sky = mix(horizon, (0.05, 0.07, 0.22), smoothstep(-0.02, 0.75, directions[2]))
    return mix((0.05, 0.04, 0.09), sky, smoothstep(-0.2, 0.1, directions[2]))


# --- the tea table ---------------------------------------------------------------------------------------


def _teapot(p: Floats) -> Floats:
    body = ellipsoid(p, (0.0, 0.0, 0.31), (0.42, 0.42, 0.30))
    spout = capsule(p, (0.30, 0.0, 0.22), (0.56, 0.0, 0.40), (0.10, 0.055))
    tip = capsule(p, (0.56, 0.0, 0.40), (0.67, 0.0, 0.57), (0.055, 0.036))
    handle = torus(p, (-0.46, 0.0, 0.35), 0.18, 0.036)
    return blend(blend(body, blend(spout, tip, 0.06), 0.08), handle, 0.05)


def _lid(p: Floats) -> Floats:
    return blend(
        ellipsoid(p, (0.0, 0.0, 0.585), (0.21, 0.21, 0.07)), sphere(p, (0.0, 0.0, 0.70), 0.055), 0.05
    )


def _cup(p: Floats) -> Floats:
    saucer = turned_profile(p, [(0.0, 0.012), (0.17, 0.014), (0.25, 0.04)], 0.011)
    wall = turned_profile(p, [(0.0, 0.03), (0.09, 0.035), (0.14, 0.10), (0.155, 0.21)], 0.012)
    return np.minimum(np.minimum(saucer, wall), torus(p, (0.19, 0.0, 0.125), 0.055, 0.014))


def _table_top(seed: int) -> Material:
    grain, tone = ripples(9.0, seed, (0.12, 1.0, 1.0)), ripples(22.0, seed + 1, (0.15, 1.0, 1.0))

    def material(p: Floats, n: Floats) -> Surface:
        plank = np.floor(p[1] / np.float32(0.29))
        shifted = p + np.stack([np.zeros_like(plank), 0.37 * plank, 1.9 * plank])
        share = 0.5 + 0.28 * grain(shifted) + 0.14 * tone(shifted) + 0.35 * (scattered(plank) - 0.5)
        wood = mix((0.25, 0.11, 0.04), (0.60, 0.34, 0.15), np.clip(share, 0, 1))
        wood *= 1 - 0.65 * joints(p[1], 0.29, 0.03)
        return Surface(_cloth(p, wood), gloss=0.03, power=24, mirror=0.35)

    return material


def _cloth(p: Floats, below: Floats) -> Floats:
    """A gingham cloth lying on the table, drawn over its wood."""
    c, s = np.float32(math.cos(0.45)), np.float32(math.sin(0.45))
    u, v = c * p[0] + s * p[1], c * p[1] - s * p[0]
    edge = np.maximum(np.abs(u), np.abs(v))
    stripes = [smoothstep(-0.3, 0.3, np.sin(np.float32(2 * math.pi / 0.32) * w)) for w in (u, v)]
    woven = mix((0.88, 0.86, 0.80), (0.50, 0.03, 0.05), 0.5 * (stripes[0] + stripes[1]))
    woven = mix(woven, (0.88, 0.86, 0.80), smoothstep(0.92, 0.94, edge))
    on_top = (1 - smoothstep(1.0, 1.02, edge)) * (p[2] > -0.01)
    return mix(below, woven, on_top.astype(np.float32))


def _terrace(seed: int) -> Material:
    blotch, tuft = ripples(5.0, seed + 2), ripples(11.0, seed + 3)

    def material(p: Floats, n: Floats) -> Surface:
        row = np.floor(p[1] / np.float32(0.62))
        x = p[0] + np.float32(0.31) * (row % 2)
        column = np.floor(x / np.float32(0.62))
        share = 0.5 * scattered(column, row) + 0.25 + 0.2 * blotch(p)
        tiles = mix((0.36, 0.24, 0.19), (0.62, 0.50, 0.40), np.clip(share, 0, 1))
        tiles = mix(tiles, (0.17, 0.19, 0.12), np.maximum(joints(x, 0.62, 0.07), joints(p[1], 0.62, 0.07)))
        grass = mix((0.07, 0.17, 0.04), (0.24, 0.38, 0.09), 0.5 + 0.3 * tuft(p) + 0.2 * blotch(p))
        across = np.hypot(p[0], p[1]) + 0.12 * blotch(p)
        return Surface(mix(tiles, grass, smoothstep(2.7, 2.95, across)))

    return material


def _porcelain(seed: int) -> Material:
    """White glaze with cobalt petals around the belly and bands above and below."""
    wash = ripples(14.0, seed + 4)

    def material(p: Floats, n: Floats) -> Surface:
        angle, r = np.arctan2(p[1], p[0]), np.hypot(p[0], p[1])
        belly = np.abs(p[2] - 0.29) / 0.13
        petals = smoothstep(-0.06, 0.06, np.abs(np.cos(4 * angle)) - belly)
        cores = smoothstep(0.42, 0.52, np.abs(np.cos(4 * angle)) - belly)
        bands = np.maximum.reduce(
            [1 - smoothstep(0.010, 0.022, np.abs(p[2] - z)) for z in (0.11, 0.47, 0.56, 0.665)]
        )
        spout = smoothstep(0.58, 0.60, r)
        on_body = 1 - smoothstep(0.43, 0.45, r)
        drawn = np.maximum(petals - 0.6 * cores, bands) * on_body
        blue = np.clip(drawn * (0.85 + 0.15 * wash(p)) + spout, 0, 1)
        return Surface(mix((0.87, 0.87, 0.84), (0.03, 0.09, 0.42), blue), gloss=0.06, power=70)

    return material


def _cup_glaze(p: Floats, n: Floats) -> Surface:
    r = np.hypot(p[0], p[1])
    band = np.maximum(1 - smoothstep(0.012, 0.022, np.abs(p[2] - 0.175)), smoothstep(0.215, 0.23, r))
    return Surface(mix((0.87, 0.87, 0.84), (0.03, 0.09, 0.42), band), gloss=0.05, power=60)


def _bowl_glaze(p: Floats, n: Floats) -> Surface:
    share = smoothstep(0.06, 0.2, p[2] + 0.02 * np.sin(8 * np.arctan2(p[1], p[0])))
    return Surface(mix((0.02, 0.20, 0.22), (0.10, 0.52, 0.48), share), gloss=0.06, power=60)


def _peel(color: Vector, seed: int) -> Material:
    pores = ripples(30.0, seed + 5)

    def material(p: Floats, n: Floats) -> Surface:
        return Surface(mix((0.0, 0.0, 0.0), color, 0.93 + 0.07 * pores(p)), gloss=0.03, power=18)

    return material


# --- the golden knot -------------------------------------------------------------------------------------


def _coins(gold: Material) -> list[Cluster]:
    """Small piles of gold on the lowest step's foot."""
    piles = []
    for x, y, layers in ((1.42, 0.25, 5), (-0.35, 1.45, 3), (-1.35, -0.30, 6), (0.2, -1.45, 4)):
        coins = [
            Part(
                partial(
                    disc,
                    center=(0.02 * math.sin(2.3 * i), 0.02 * math.cos(3.1 * i), 0.022 + 0.04 * i),
                    tilt=0.0,
                    radius=0.10,
                    half_height=0.008,
                ),
                gold,
            )
            for i in range(layers)
        ]
        leaning = Part(
            partial(disc, center=(0.145, 0.0, 0.09), tilt=-1.1, radius=0.10, half_height=0.008), gold
        )
        piles.append(Cluster((x, y, 0.0), (0.0, 0.0, 0.1), 0.32, (*coins, leaning), turn=x - y))
    return piles


def _gold(seed: int) -> Material:
    hammered = ripples(26.0, seed)

    def material(p: Floats, n: Floats) -> Surface:
        tone = mix((0.78, 0.44, 0.09), (1.0, 0.76, 0.32), np.clip(0.5 + 0.4 * hammered(p), 0, 1))
        return Surface(tone, gloss=0.75, power=16, metal=0.6)

    return material


def _gem(color: Vector) -> Material:
    def material(p: Floats, n: Floats) -> Surface:
        inner = mix((0.0, 0.0, 0.0), color, 0.75 + 0.25 * n[2])
        return Surface(inner, gloss=0.12, power=50)

    return material


def _marble(seed: int) -> Material:
    bend, vein = ripples(4.0, seed + 1), ripples(7.0, seed + 2)

    def material(p: Floats, n: Floats) -> Surface:
        line = np.abs(np.sin(5 * (p[0] + p[1] * 0.6 + p[2]) + 2.2 * bend(p)))
        veins = (1 - smoothstep(0.03, 0.22, line)) * (0.55 + 0.35 * vein(p))
        stone = mix((0.03, 0.17, 0.12), (0.07, 0.30, 0.21), np.clip(0.5 + 0.5 * bend(p), 0, 1))
        return Surface(mix(stone, (0.80, 0.85, 0.76), np.clip(veins, 0, 1)), gloss=0.05, power=60)

    return material


def _porphyry(seed: int) -> Material:
    speck, cloud = ripples(34.0, seed + 3), ripples(6.0, seed + 4)

    def material(p: Floats, n: Floats) -> Surface:
        share = np.clip(0.45 + 0.3 * cloud(p) + 0.25 * speck(p), 0, 1)
        return Surface(mix((0.24, 0.06, 0.10), (0.62, 0.30, 0.30), share), gloss=0.04, power=30)

    return material


def _mosaic(seed: int) -> Material:
    """Rings of wedge-shaped tiles around the steps, flagstones beyond."""
    tone = ripples(5.0, seed + 5)

    def material(p: Floats, n: Floats) -> Surface:
        r, angle = np.hypot(p[0], p[1]), np.arctan2(p[1], p[0]) / np.float32(2 * math.pi)
        ring = np.floor(r / np.float32(0.32))
        wedge = angle * 32 + 0.5 * (ring % 2)
        checker = (np.floor(wedge) + ring) % 2
        tiles = mix((0.06, 0.11, 0.30), (0.62, 0.56, 0.46), checker)
        tiles *= 0.85 + 0.3 * (scattered(np.floor(wedge), ring) - 0.5) + 0.12 * tone(p)
        grout = joints(r, 0.32, 0.045)
        tiles = mix(tiles, (0.55, 0.36, 0.10), grout)
        flags = mix(
            (0.13, 0.11, 0.17),
            (0.26, 0.22, 0.28),
            np.clip(
                0.5 + 0.4 * tone(p) + 0.5 * (scattered(np.floor(p[0] / 0.8), np.floor(p[1] / 0.8)) - 0.5),
                0,
                1,
            ),
        )
        seams = np.maximum(joints(p[0], 0.8, 0.07), joints(p[1], 0.8, 0.07))
        # Far seams are finer than a pixel.
        flags *= 1 - 0.6 * seams * (1 - smoothstep(3.0, 5.5, r))
        return Surface(mix(tiles, flags, smoothstep(2.54, 2.58, r)), gloss=0.06, power=40, mirror=0.8)

    return material


# --- shared ----------------------------------------------------------------------------------------------


def _plain(color: Vector, gloss: float = 0.02) -> Material:
    def material(p: Floats, n: Floats) -> Surface:
        return Surface(np.repeat(np.array(color, dtype=np.float32)[:, None], p.shape[1], axis=1), gloss=gloss)

    return material


def _unit(x: float, y: float, z: float) -> Vector:
    length = math.sqrt(x * x + y * y + z * z)
    return x / length, y / length, z / length
