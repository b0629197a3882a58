"""Hides and reveals in memory, and tiny scenes to hide."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest
import torch

from fitting.test_plain import InterruptAt
from keyss.core import Gaussians, InputError, Interrupted, KeyssWarning, Scene, Similarity
from keyss.fitting import mean_psnr
from keyss.methods import Context, HiddenScene, MethodOptions, Source, fit_plain_models, registry
from keyss.progress import Reporter
from tiny_scenes import random_gaussians, tiny_scene


@dataclass(frozen=True)
class Hidden:
    stego: Gaussians
    opened: tuple[HiddenScene, ...]


def hide_scenes(
    scenes: Sequence[Scene],
    keys: Sequence[str],
    options: MethodOptions,
    *,
    plains: Sequence[Gaussians | None] | None = None,
    checkpoints: Path | None = None,
    resume: bool = False,
    reporter: Reporter | None = None,
) -> Hidden:
    """Hide `scenes[1:]` in `scenes[0]`, with seed 0 by default; missing `plains` are fitted."""
    given = plains or [None] * len(scenes)
    method = registry.of_options(options)
    options = replace(options, fit=options.fit.with_seed(0))
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", ".*appended", KeyssWarning)
        sources = [
            Source(model, True, key, scene)
            for model, key, scene in zip(given, ("", *keys), scenes, strict=True)
        ]
        prepared = method.prepare(sources, options)
        context = Context(torch.device("cpu"), checkpoints, resume, reporter, entropy=bytes(32))
        sources = fit_plain_models(sources, prepared.fits, context)
        stego = method.hide(sources, method.prepare(sources, options, prepared), context)
    return Hidden(stego.gaussians, stego.opened)


def check_resumes(
    options: MethodOptions, checkpoints: Path, stage: str, plains: Sequence[Gaussians] | None = None
) -> None:
    """Check that interrupted hiding resumes to the same bits, and with the same options only.

    It is interrupted in `stage`, and before in a plain fit unless `plains` are given.
    """
    scenes, keys = three_scenes()[0][:2], ["a key"]

    def run(resume: bool, interrupt: InterruptAt | None = None) -> Hidden:
        kept: dict[str, Any] = {"checkpoints": checkpoints, "resume": resume, "reporter": interrupt}
        return hide_scenes(scenes, keys, options, plains=plains, **kept)

    whole = hide_scenes(scenes, keys, options, plains=plains)
    with pytest.raises(Interrupted):
        run(False, InterruptAt(17, stage if plains else "plain model of the secret"))
    with pytest.raises(Interrupted):
        run(True, InterruptAt(23, stage))
    assert run(True).stego.digest() == whole.stego.digest()
    changed = options.with_fit(sh0_rate=1e-3)
    with pytest.raises(InputError, match="other settings"):
        hide_scenes(scenes, keys, changed, plains=plains, checkpoints=checkpoints, resume=True)


def moved(scene: Scene, frame: Similarity) -> Scene:
    """Apply a similarity transform to a scene."""
    return replace(
        scene,
        train=tuple(replace(view, camera=frame.apply_camera(view.camera)) for view in scene.train),
        test=tuple(replace(view, camera=frame.apply_camera(view.camera)) for view in scene.test),
        points=frame.apply_points(scene.points),
    )


def three_scenes() -> tuple[list[Scene], list[Gaussians]]:
    """A cover and two secrets, the first of them in another frame, and their true models."""
    quaternion = torch.linalg.qr(
        torch.randn(3, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    )[0]
    rotation = quaternion * quaternion.det().sign()
    frame = Similarity(3.0, rotation, torch.tensor([5.0, -2.0, 1.0], dtype=torch.float64))
    scenes = [tiny_scene(0), moved(tiny_scene(1), frame), tiny_scene(2, distance=5.0)]
    models = [
        random_gaussians(seed=0),
        frame.apply_gaussians(random_gaussians(seed=1)),
        random_gaussians(seed=2),
    ]
    return scenes, models


def psnr_in(model: Gaussians, scene: Scene) -> float:
    """Mean PSNR on the test views of a scene."""
    return mean_psnr(model, scene.test, scene.background)
