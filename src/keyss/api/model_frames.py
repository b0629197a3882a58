"""Whether a given model shows the photos of its scene, and the frame in which it does."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from pathlib import Path

import msgspec
import torch

from keyss.core.errors import InputError, KeyssWarning
from keyss.core.gaussians import Gaussians
from keyss.core.scene import Scene, View
from keyss.core.similarity import Similarity
from keyss.files.inputs import read_file
from keyss.fitting.image_metrics import mean_psnr, psnr, subsample_views
from keyss.runs.files import PathLike

_NERFSTUDIO = "dataparser_transforms.json"
_VIEWS = 3
_MAX_BYTES = 1 << 20


class _Transforms(msgspec.Struct):
    """Of Nerfstudio's files: x -> scale * (transform @ (x, 1)), from the cameras' frame to the model's."""

    transform: list[list[float]] = []  # [3, 4]
    scale: float = 1.0
    applied_transform: list[list[float]] | None = None  # [3, 4], of a transforms.json: from COLMAP's frame


def in_frame_of(scene: Scene, model: Gaussians, source: PathLike | Gaussians, folder: object) -> Gaussians:
    """`model` in the frame in which it shows the photos of its scene best.

    Frames are that of the model and those of Nerfstudio's dataparser_transforms.json beside its file
    `source`; `folder`: the scene's. Warns (KeyssWarning) of a model that is moved, or that shows its photos
    worse than one colour does.
    """
    views = subsample_views(scene.test, _VIEWS)
    as_it_is, one_colour = mean_psnr(model, views, scene.background), _psnr_of_one_colour(views)
    if as_it_is >= one_colour or isinstance(source, Gaussians):
        return model
    moved = _moved(model, Path(source), folder)
    best = max(moved, key=lambda frame_model: mean_psnr(frame_model, views, scene.background), default=model)
    best_psnr = mean_psnr(best, views, scene.background)
    if best_psnr >= one_colour:
        text = f"is moved into the frame of its photos, as {_NERFSTUDIO} beside it says"
    else:
        best = model
        text = (
            f"shows the photos of {scene.name} at {as_it_is:.1f} dB PSNR, worse than one colour "
            f"({one_colour:.1f}): it is of another scene, or in another frame, as Nerfstudio exports models, "
            f"rotated and scaled; put the {_NERFSTUDIO} of its training beside it"
        )
    warnings.warn(f"{source}: this model {text}", KeyssWarning, stacklevel=2)
    return best


def _psnr_of_one_colour(views: tuple[View, ...]) -> float:
    """Mean PSNR in dB of the mean colour of each photo."""
    photos = [view.photo(torch.device("cpu")) for view in views]
    flat = [photo.mean((0, 1), keepdim=True).expand_as(photo) for photo in photos]
    return sum(psnr(one, photo) for one, photo in zip(flat, photos, strict=True)) / len(photos)


def _moved(model: Gaussians, path: Path, folder: object) -> Iterator[Gaussians]:
    """`model` in the frame of its cameras, which may be COLMAP's or that of a transforms.json."""
    beside = path.with_name(_NERFSTUDIO)
    if not beside.is_file():
        return
    try:
        file = msgspec.json.decode(read_file(beside, _MAX_BYTES), type=_Transforms)
        moved = _similarity(file.transform, file.scale).inverse().apply_gaussians(model)
        yield moved
        if isinstance(folder, str | Path) and (scene := Path(folder) / "transforms.json").is_file():
            applied = msgspec.json.decode(read_file(scene), type=_Transforms).applied_transform
            if applied is not None:
                yield _similarity(applied, 1.0).apply_gaussians(moved)
    except (msgspec.MsgspecError, ValueError) as error:
        raise InputError(f"{beside}: expected Nerfstudio's transform and scale: {error}") from error


def _similarity(rows: list[list[float]], scale: float) -> Similarity:
    matrix = torch.tensor(rows, dtype=torch.float64)
    if matrix.shape != (3, 4):
        raise ValueError(f"expected 3 rows of 4 numbers, got {list(matrix.shape)}")
    return Similarity(scale, matrix[:, :3], scale * matrix[:, 3])
