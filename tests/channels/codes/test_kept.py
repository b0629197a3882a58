"""What is left as it is: clones, levels near limits, rotations that would get another largest part."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from channels.codes.published import FORMATS, codes_of, written
from keyss.channels import CodesCover, in_counted_order
from keyss.channels.codes.fields import sog_distances
from keyss.channels.codes.kept import changeable

SECRET = bytes(32)


def test_gaussians_nearer_to_each_other_than_by_chance_stay() -> None:
    codes = codes_of(".spz")
    fields = in_counted_order(codes)[1]
    positions = codes.positions.copy()
    positions[1000:1200] = positions[:200] + np.array([1, 0, 0])
    near = replace(codes, positions=positions)
    free = np.stack(changeable(near, in_counted_order(near)[1], SECRET)[:3])
    assert free[:, :200].mean() < 0.1 > free[:, 1000:1200].mean()
    apart = np.stack(changeable(codes, fields, SECRET)[:3])
    assert apart[:, :200].mean() > 0.8 < free[:, 2000:].mean()


@pytest.mark.parametrize("suffix", FORMATS)
def test_neighbours_with_equal_rotations_keep_them(suffix: str) -> None:
    codes = in_counted_order(codes_of(suffix))[0]
    means = codes.dequantise().means.numpy()
    for row in (10, 2000, 4000):
        nearest = int(np.linalg.norm(means - means[row], axis=1).argsort()[1])
        rotations = codes.rotations.copy()
        rotations[nearest] = rotations[row]
        free = np.stack(changeable(*in_counted_order(replace(codes, rotations=rotations)), SECRET))
        assert not free[:, [row, nearest]].any()
        assert free.any(axis=0).mean() > 0.8


@pytest.mark.parametrize("suffix", FORMATS)
def test_fewer_change_the_nearer_a_limit_is(suffix: str) -> None:
    cover = CodesCover.of(codes_of(suffix, 30_000))
    for field, free in zip(cover.fields, cover.free, strict=True):
        if field.name != "rotations":
            continue
        most = {".spz": 511, ".sog": 255, ".compressed.ply": 1023}[suffix]
        ends = np.minimum(np.abs(field.levels - (-511 if suffix == ".spz" else 0)), most - field.levels)
        assert not free[ends < 2].any()
        assert free[ends > 100].mean() > 0.8


def test_steps_of_a_sog_stay_as_large_as_they_are() -> None:
    codes = codes_of(".sog", 30_000)
    cover = CodesCover.of(codes)
    distances = [
        sog_distances(each, each.positions)
        for each in (cover.codes, in_counted_order(written(cover, b"data"))[0])
    ]
    assert len(np.unique(distances[0])) > 1
    assert np.array_equal(*distances)
