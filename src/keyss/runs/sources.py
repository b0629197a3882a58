"""Arguments that stand for models and scenes, in files or in memory."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from torch import Tensor

from keyss.core.decoded import DecodedGaussians
from keyss.core.errors import InputError, UsageError
from keyss.core.gaussians import Gaussians
from keyss.core.scene import Scene, ViewOptions
from keyss.files.foreign import what_it_is
from keyss.files.models import is_model_path, known_suffixes, read_model
from keyss.runs.files import is_run, model_in

PathLike = str | Path
Background = Tensor | Sequence[float] | None


def path_of(source: PathLike | Scene | Gaussians) -> str | None:
    """The absolute path of a scene, None for one in memory."""
    return None if isinstance(source, Scene | Gaussians) else os.path.realpath(source)


def as_scene(
    source: PathLike | Scene | Gaussians,
    views: ViewOptions,
    *,
    train_pictures: bool = True,
    model: Gaussians | None = None,
) -> Scene:
    """A given scene, the photos in a folder, or renders of a model from all around.

    `train_pictures`: see `scene_of_model`. `model`: the content of a model's file, if it has been read.
    """
    if isinstance(source, Scene):
        return source
    if not isinstance(source, Gaussians) and not is_model_path(source):
        from keyss.files.scenes import load_scene

        if os.path.exists(source) and not os.path.isdir(source):
            raise InputError(
                f"{source}: expected a scene folder or a 3DGS model ({known_suffixes()}), found "
                f"{what_it_is(Path(source))}"
            )
        try:
            return load_scene(source, **vars(views))
        except InputError as error:
            if is_run(Path(source)) and (inside := model_in(Path(source))):
                raise InputError(f"{source}: expected a scene, found a run; its model is {inside}") from error
            raise
    from keyss.rendering.orbit import scene_of_model

    name = "model" if isinstance(source, Gaussians) else Path(source).stem
    model = as_model(source) if model is None else model
    return scene_of_model(
        model, name, size=views.width, background=views.background, train_pictures=train_pictures
    )


def as_model(source: PathLike | Gaussians) -> Gaussians:
    """A model, or the content of its file, on the CPU. Raises InputError."""
    if isinstance(source, Gaussians):
        return source.to("cpu")
    if inside := model_in(Path(source)):
        raise InputError(f"{source}: expected the file of a 3DGS model, found a folder; give {inside}")
    return read_model(source)


def as_3dgs_model(source: PathLike | Gaussians, what: str) -> Gaussians:
    """As `as_model`. Raises UsageError if the model is rendered by a network."""
    model = as_model(source)
    if isinstance(model, DecodedGaussians):
        raise UsageError(f"expected a 3DGS model, but {what}'s model is rendered by a network")
    return model
