"""File names in a run's folder; models and scenes that are given as arguments."""

from __future__ import annotations

import os
from pathlib import Path

from keyss.channels import SUFFIXES, suffix_of
from keyss.core.errors import InputError, UsageError
from keyss.core.gaussians import Gaussians
from keyss.core.picture_network import DecodedGaussians
from keyss.core.scene import Scene, ViewOptions
from keyss.files.file_kinds import identify_file
from keyss.files.model_formats import DECODED_SUFFIX, known_suffixes
from keyss.files.models import is_model_source, read_model
from keyss.methods.hidden import COMPANION
from keyss.runs.folder import CHECKPOINTS, HIDE_FILES, MANIFEST, PRIVATE, PUBLISH, read_manifest

STEGO = f"{PUBLISH}/model.ply"  # an innocuous name
STEGOS = (STEGO, *(f"{PUBLISH}/model{suffix}" for suffix in (*SUFFIXES.values(), DECODED_SUFFIX)))
MODEL = "model.ply"  # result of a plain fit
CONFIG, METRICS, REPORT = f"{PRIVATE}/config.json", f"{PRIVATE}/metrics.json", f"{PRIVATE}/report.md"
LOOK = f"{PRIVATE}/look.png"  # test views before and after
COMPANIONS = f"{PRIVATE}/companion"  # companion files, for those who may see a secret
CONTROLS = f"{PRIVATE}/controls"  # plain models of the cover from other seeds, for audits
PathLike = str | Path


def is_run(folder: Path) -> bool:
    """True for the folder of a run; False if it cannot be read."""
    return os.path.isfile(folder / CONFIG)


def model_in(folder: Path) -> Path | None:
    """The resulting model of a run; `folder` is the run's, or its `publish/`."""
    names = (*STEGOS, MODEL, *(Path(name).name for name in (*STEGOS, MODEL)))
    return next((folder / name for name in names if os.path.isfile(folder / name)), None)


def stego_name(stego: Gaussians) -> str:
    """The name of the file of a published model in the folder of a run."""
    if isinstance(stego, DecodedGaussians):
        return f"{PUBLISH}/model{DECODED_SUFFIX}"
    return f"{PUBLISH}/model{suffix_of(stego)}"


def stego_in(folder: Path) -> Path:
    """The path of a run's published model, or its usual path if there is none."""
    return folder / next((name for name in STEGOS if os.path.isfile(folder / name)), STEGO)


def is_published(model: Path) -> bool:
    """True for the published file of a run that is still beside it."""
    folder = Path(os.path.realpath(model)).parent
    return folder.name == PUBLISH and os.path.isfile(folder.parent / MANIFEST)


def run_folder(path: Path) -> Path:
    """`path`, if it is the folder of a hiding.

    Otherwise raises InputError, which names the run that contains `path` if there is one.
    """
    kind = "a folder" if os.path.isdir(path) else "a file"
    try:
        (path / CONFIG).stat()
        if not os.path.isfile(path / MODEL):
            return path
        problem = "one that `keyss fit` wrote"
    except OSError as error:
        run = next((parent for parent in path.absolute().parents[:2] if is_run(parent)), None)
        problem = f"{kind} in one; give {run}" if run else f"no {CONFIG} in it ({error.strerror})"
        if os.path.isdir(path / CHECKPOINTS):
            problem = f"an interrupted one, which `keyss info {path}` describes"
        if os.path.isfile(path / MANIFEST) and HIDE_FILES in read_manifest(path).files:
            raise InputError(
                f"{path}: this run hid files, and there is nothing to evaluate; `keyss verify "
                f"{stego_in(path)} --key-file KEY` checks them"
            ) from error
    raise InputError(
        f"{path}: expected the folder of a run, as `keyss hide --secret` writes it, found {problem}"
    )


def plain_names(secrets: int) -> list[str]:
    """Files of the plain models of the cover and of the secrets."""
    return [f"{PRIVATE}/cover.ply"] + [f"{PRIVATE}/secret-{index}.ply" for index in range(1, secrets + 1)]


def bound_names(secrets: int) -> list[str]:
    """Files of the upper bounds: plain 3DGS with as many steps as scenes whose plain models had fewer."""
    return [f"{PRIVATE}/bound-{index}.ply" for index in ("cover", *range(1, secrets + 1))]


def companion_names(secrets: int) -> list[str]:
    """Companion files of the secrets, for methods that need them."""
    return [f"{COMPANIONS}/secret-{index}{COMPANION}" for index in range(1, secrets + 1)]


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
    if not isinstance(source, Gaussians) and not is_model_source(source):
        from keyss.files.scenes import load_scene

        if os.path.exists(source) and not os.path.isdir(source):
            raise InputError(
                f"{source}: expected a scene folder or a 3DGS model ({known_suffixes()}), found "
                f"{identify_file(Path(source))}"
            )
        if is_run(Path(source)) and (inside := model_in(Path(source))):
            raise InputError(f"{source}: expected a scene, found a run; its model is {inside}")
        return load_scene(source, **vars(views))
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
    """`as_model`, but raises UsageError if the model is rendered by a network."""
    model = as_model(source)
    if isinstance(model, DecodedGaussians):
        raise UsageError(f"expected a 3DGS model, but {what}'s model is rendered by a network")
    return model
