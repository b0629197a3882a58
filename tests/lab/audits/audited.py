"""A small audited run."""

from __future__ import annotations

import warnings
from functools import partial
from pathlib import Path

import pytest

import keyss
from keyss import Secret
from keyss.core import KeyssWarning
from keyss.lab import Change, converters, decoder_attack, half_floats, random_pruning, two_sample
from keyss.lab.audits import audit, parts
from keyss.lab.robustness import survival
from methods.keyss.small import small
from test_api import CONFIG, write_nerfstudio
from tiny_scenes import random_gaussians, tiny_scene

KEYS = ("the key of a treasure", "the key of a map")
# A method with decoders, for measures of wrong keys.
JOINT = small("published", CONFIG.fit)


def audited_run(root: Path) -> None:
    """Make `run`: two secrets in a garden, 40 x 30 pixels, audited by all parts; one converter is missing."""
    scenes = [
        write_nerfstudio(root / name, tiny_scene(seed))
        for seed, name in enumerate(("garden", "treasure", "map"))
    ]
    secrets = [
        Secret(scene, key, random_gaussians(150, seed))
        for seed, (scene, key) in enumerate(zip(scenes[1:], KEYS, strict=True), start=1)
    ]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", KeyssWarning)  # of secrets that are large for their cover
        keyss.hide(
            scenes[0],
            secrets,
            method=JOINT.with_fit(max_gaussians=1300, iterations=20, seed=0),
            views=keyss.ViewOptions(40),
            cover_model=random_gaussians(1000, seed=0),
            min_psnr=0,  # 20 steps from points
            out=root / "run",
        )
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(parts, "decoder_attack", partial(decoder_attack, steps=10))
        patch.setattr(two_sample, "TREES", 5)
        patch.setattr(survival, "default_changes", lambda *_, **__: _few_changes())
        patch.setenv("KEYSS_SPLAT_TRANSFORM", str(root / "nowhere"))
        audit(root / "run", KEYS, controls=2)


def _few_changes() -> list[Change]:
    sog = next(converter for converter in converters() if converter.format == ".sog")
    return [
        random_pruning(0.1),
        *(random_pruning(0.25, draw) for draw in range(3)),
        half_floats(),
        sog.change(),
    ]
