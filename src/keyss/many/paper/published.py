"""Figures of *Key-Secured 3D Secrets within 3D Gaussian Splatting* (KeySS), as its tables give them.

PSNR in dB on test photos. Numbers by the name of the cover where the paper has them by scene.
"""

from __future__ import annotations

from collections.abc import Mapping

Figure = float | Mapping[str, float]  # one number, or one for each cover

COVERS = ("bicycle", "bonsai", "room", "flowers", "treehill", "garden", "stump", "counter", "kitchen")


def _by_cover(*values: float) -> Mapping[str, float]:
    return dict(zip(COVERS, values, strict=True))


# What hides in these, where one secret does: KeySS follows GS-Hider (Zhang et al., NeurIPS 2024, Table 7) and
# prints the covers' names where those of the secrets belong. Playroom is of Deep Blending.
_SECRETS = (
    "playroom",
    "counter",
    "garden",
    "playroom",
    "bicycle",
    "playroom",
    "playroom",
    "bicycle",
    "bonsai",
)
PAIRS = tuple(zip(COVERS, _SECRETS, strict=True))

# Table 1: one secret.
SINGLE: Mapping[str, Mapping[str, Figure]] = {
    "3dgs": {"cover": _by_cover(23.395, 31.690, 31.712, 19.886, 22.579, 25.690, 24.670, 28.702, 30.338)},
    "3dgs-sh": {
        "cover": _by_cover(23.365, 26.286, 29.311, 18.998, 21.479, 24.897, 22.818, 26.893, 28.150),
        "secret": _by_cover(23.548, 21.340, 22.231, 25.080, 20.619, 28.450, 24.067, 20.997, 22.758),
    },
    "3dgs-decoder": {
        "cover": _by_cover(23.914, 27.674, 27.502, 19.877, 21.200, 24.284, 24.134, 26.561, 26.013),
        "secret": _by_cover(20.611, 20.318, 21.668, 20.540, 19.848, 25.287, 19.933, 20.670, 22.367),
    },
    "gs-hider": {
        "cover": _by_cover(24.018, 29.643, 28.865, 20.109, 21.503, 26.753, 24.573, 27.445, 29.447),
        "secret": _by_cover(28.219, 23.846, 22.885, 26.389, 20.276, 32.348, 25.161, 20.792, 26.690),
    },
    "keyss": {
        "cover": _by_cover(23.011, 31.081, 30.785, 19.476, 22.433, 25.225, 23.827, 28.120, 29.862),
        "secret": _by_cover(29.533, 25.456, 23.877, 29.272, 22.121, 28.179, 29.452, 20.891, 29.064),
        "wrong key, cover": _by_cover(22.959, 31.023, 30.719, 19.625, 22.443, 25.120, 23.763, 28.098, 29.495),
        "wrong key, secret": _by_cover(11.010, 10.190, 9.751, 9.624, 12.458, 9.843, 11.228, 10.373, 8.593),
    },
}

# Table 2: a cover and two secrets.
TRIPLES = (("flowers", "treehill", "garden"), ("bicycle", "bonsai", "room"), ("kitchen", "counter", "stump"))
MULTI: Mapping[str, Figure] = {
    "cover": {"flowers": 18.990, "bicycle": 22.478, "kitchen": 30.103},
    "secret 1": {"flowers": 21.038, "bicycle": 29.031, "kitchen": 26.753},
    "secret 2": {"flowers": 21.870, "bicycle": 26.544, "kitchen": 21.519},
    "wrong key, cover": {"flowers": 18.778, "bicycle": 16.456, "kitchen": 29.638},
    "wrong key, secret": {"flowers": 10.598, "bicycle": 12.117, "kitchen": 8.910},
}

# Table 3 and the supplement's breakdown: PSNR of cover and secret, 3D-Sinkhorn (sum), composite score; then
# 3D-Sinkhorn of op, sc, ro, xyz, sh.
_MASKS: Mapping[str, tuple[float, ...]] = {
    "op": (26.020, 26.138, 0.181, 42.717, 0.079, 4e-4, 0.030, 0.038, 0.034),
    "ro": (21.752, 23.784, 0.268, 33.314, 0.133, 5e-4, 0.050, 0.042, 0.043),
    "sc": (25.080, 20.497, 0.190, 36.921, 0.060, 5e-4, 0.041, 0.042, 0.047),
    "xyz": (21.980, 23.866, 0.211, 36.182, 0.099, 4e-4, 0.031, 0.046, 0.034),
    "sh": (22.825, 12.530, 0.162, 29.621, 0.066, 4e-4, 0.030, 0.040, 0.026),
    "op,ro": (26.036, 26.113, 0.175, 43.008, 0.063, 5e-4, 0.038, 0.034, 0.040),
    "op,sc": (25.998, 26.038, 0.208, 41.228, 0.093, 5e-4, 0.038, 0.044, 0.033),
    "op,xyz": (25.777, 21.615, 0.329, 31.795, 0.084, 4e-4, 0.101, 0.073, 0.071),
    "op,sh": (25.831, 24.118, 0.213, 39.319, 0.095, 4e-4, 0.042, 0.041, 0.034),
    "op,ro,sc": (25.632, 24.743, 0.206, 39.987, 0.084, 5e-4, 0.033, 0.054, 0.036),
    "op,ro,xyz": (25.411, 25.662, 0.219, 39.899, 0.102, 5e-4, 0.048, 0.043, 0.026),
    "op,ro,sh": (24.643, 21.645, 0.185, 37.729, 0.077, 4e-4, 0.030, 0.041, 0.037),
    "op,ro,sc,xyz": (25.980, 26.427, 0.153, 44.389, 0.052, 5e-4, 0.027, 0.037, 0.036),
    "op,ro,xyz,sh": (25.951, 19.970, 0.430, 26.157, 0.301, 5e-4, 0.038, 0.038, 0.053),
    "op,ro,sc,xyz,sh": (25.832, 20.961, 0.256, 34.810, 0.125, 5e-4, 0.035, 0.037, 0.058),
}
MASKS: Mapping[str, Mapping[str, Figure]] = {
    mask: {
        "cover": row[0],
        "secret": row[1],
        "mean of both": (row[0] + row[1]) / 2,
        "sinkhorn": row[2],
        "score": row[3],
    }
    for mask, row in _MASKS.items()
}
SINKHORN: Mapping[str, Mapping[str, Figure]] = {
    mask: {
        "sinkhorn": row[2],
        **{f"sinkhorn {name}": row[4 + i] for i, name in enumerate(("op", "sc", "ro", "xyz", "sh"))},
    }
    for mask, row in _MASKS.items()
}

# Table 4, of one pair: whose points, whose poses, whose gradients; PSNR of cover and secret, and their mean.
COMBINED: Mapping[tuple[str, str, str], Mapping[str, Figure]] = {
    key: {"cover": cover, "secret": secret, "mean of both": mean}
    for key, cover, secret, mean in (
        (("cover", "cover", "both"), 22.830, 29.719, 26.275),
        (("cover", "both", "both"), 23.279, 27.083, 25.181),
        (("both", "cover", "both"), 23.300, 26.855, 25.077),
        (("secret", "both", "both"), 19.907, 29.761, 24.834),
        (("secret", "secret", "both"), 19.789, 29.719, 24.754),
        (("both", "secret", "both"), 19.763, 29.693, 24.728),
        (("both", "both", "cover"), 22.888, 29.611, 26.249),
        (("both", "both", "both"), 22.911, 29.858, 26.384),
    )
}

# Supplement: pruning of so many Gaussians; PSNR of cover and secret.
PRUNING: Mapping[str, float] = {
    "5% by opacity, cover": 25.980,
    "5% by opacity, secret": 26.427,
    "10% by opacity, cover": 25.980,
    "10% by opacity, secret": 26.427,
    "15% by opacity, cover": 25.980,
    "15% by opacity, secret": 26.427,
    "25% by opacity, cover": 25.980,
    "25% by opacity, secret": 26.418,
    "5% random, cover": 25.588,
    "5% random, secret": 26.102,
    "10% random, cover": 25.163,
    "10% random, secret": 25.750,
    "15% random, cover": 24.714,
    "15% random, secret": 25.341,
    "25% random, cover": 23.739,
    "25% random, secret": 24.408,
    "whole, cover": 25.980,
    "whole, secret": 26.427,
}

# Supplement: pictures a second of cover and secret, the time of one over that of 3DGS, and whether the SIBR
# viewer opens the model. "100+" is 100.
SPEED: Mapping[str, Mapping[str, float]] = {
    name: {
        **{f"pictures/s, {scene}": rate for scene, rate in rates.items()},
        **{f"time over 3DGS, {scene}": 130 / rate for scene, rate in rates.items()},
        "standard": standard,
    }
    for name, rates, standard in (
        ("3dgs", {"cover": 130}, 1),
        ("gs-hider", {"cover": 45, "secret": 45}, 0),
        ("watergs", {"cover": 100, "secret": 100}, 1),
        ("keyss", {"cover": 130, "secret": 130}, 1),
    )
}
