"""Which scenes hide which: those a person gives, or the paper's, checked."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from keyss.core.errors import InputError, OutputError, UsageError
from keyss.core.nearest import nearest
from keyss.files.colmap import MODEL_PLACES, colmap_model_folder, read_colmap
from keyss.files.images import probe_image

TEST_EVERY = 8


@dataclass(frozen=True)
class BenchmarkScene:
    """A scene as 3DGS is measured on it."""

    photos: int  # every 8th by name is for testing
    images: str  # folder of the photos: of Mip-NeRF 360 a quarter of their size outdoors, half indoors
    width: int  # pixels of those


BENCHMARK: Mapping[str, BenchmarkScene] = {
    "bicycle": BenchmarkScene(194, "images_4", 1237),
    "bonsai": BenchmarkScene(292, "images_2", 1559),
    "room": BenchmarkScene(311, "images_2", 1557),
    "flowers": BenchmarkScene(173, "images_4", 1256),
    "treehill": BenchmarkScene(141, "images_4", 1267),
    "garden": BenchmarkScene(185, "images_4", 1297),
    "stump": BenchmarkScene(125, "images_4", 1245),
    "counter": BenchmarkScene(240, "images_2", 1558),
    "kitchen": BenchmarkScene(279, "images_2", 1558),
    "playroom": BenchmarkScene(225, "images", 1264),
}

Group = tuple[str, ...]  # names of a cover and of what is hidden in it


def by_name(scenes: Sequence[Path | str]) -> dict[str, Path]:
    """Folders of scenes by name. Raises UsageError for two of one name."""
    found: dict[str, Path] = {}
    for each in scenes:
        path = Path(os.path.realpath(each))
        if found.setdefault(path.name, path) != path:
            raise UsageError(f"expected scenes of different names, got two that are called {path.name}")
    return found


def groups_of(names: Sequence[str], secrets: int) -> list[Group]:
    """Each scene hides the ones after it, the last ones the first again. Raises UsageError for too few."""
    if len(names) <= secrets:
        raise UsageError(f"expected at least {secrets + 1} scenes, got {len(names)}")
    twice = [*names, *names]
    return [tuple(twice[index : index + secrets + 1]) for index in range(len(names))]


def asked_groups(pairs: Sequence[str], names: Sequence[str], secrets: int) -> list[Group]:
    """Of COVER,SECRET or COVER,SECRET,SECRET each. Raises UsageError."""
    found = []
    for text in pairs:
        group = tuple(name.strip() for name in text.split(","))
        if len(group) != secrets + 1 or len(set(group)) < len(group):
            raise UsageError(
                f"`pairs`: expected a cover and {secrets} secret(s) of different names, got {text!r}"
            )
        for name in group:
            if name not in names:
                near = nearest(name, names)
                meant = f"did you mean {near}?" if near else f"there are {', '.join(names)}"
                raise UsageError(f"`pairs`: no scene is called {name!r}; {meant}")
        found.append(group)
    return found


def check_benchmark(data: Path, name: str) -> None:
    """Raise InputError unless `data` has a scene of the paper's, with as many photos of the right size."""
    expected, folder = BENCHMARK[name], data / name
    if not folder.is_dir():
        source = "Mip-NeRF 360 (360_v2.zip and, for flowers and treehill, 360_extra_scenes.zip)"
        source = "Deep Blending (tandt_db.zip of 3DGS)" if name == "playroom" else source
        raise InputError(
            f"{data}: expected a folder {name}, a scene of {source}, found none; `download_scenes` fetches it"
        )
    images = folder / expected.images
    if not images.is_dir():
        raise InputError(
            f"{folder}: expected the folder {expected.images}, on whose photos 3DGS is measured, found none"
        )
    if colmap_model_folder(folder) is None:
        raise InputError(f"{folder}: expected a COLMAP model (sparse/0/cameras.bin), found none")
    photos = sorted(path for path in images.iterdir() if path.is_file() and not path.name.startswith("."))
    if len(photos) != expected.photos:
        raise InputError(f"{images}: expected {expected.photos} photos, found {len(photos)}")
    width = probe_image(photos[0])[0]
    if abs(width - expected.width) > 1:
        raise InputError(f"{images}: expected photos {expected.width} pixels wide, found {width}")


def link_benchmark(data: Path, name: str, folder: Path) -> Path:
    """A scene of the paper's in `folder` that has the photos of the benchmark's size and no others: links.

    Raises InputError for a model whose photos are not those of the split, OutputError.
    """
    expected, scene = BENCHMARK[name], folder / name
    try:
        scene.mkdir(parents=True, exist_ok=True)
        model = next(place for place in MODEL_PLACES if colmap_model_folder(data / name, (place,)))
        for link, target in (
            ("sparse", data / name / model),
            (expected.images, data / name / expected.images),
        ):
            if not (scene / link).is_symlink():
                (scene / link).symlink_to(target.resolve())
    except OSError as error:
        raise OutputError(f"cannot write to {scene}: {error.strerror}") from error
    layout = read_colmap(scene)
    counted = len(layout.train) + len(layout.test), len(layout.test)
    if counted != (expected.photos, -(-expected.photos // TEST_EVERY)):
        raise InputError(
            f"{data / name}: expected {expected.photos} photos in the COLMAP model, every {TEST_EVERY}th for "
            f"testing, found {counted[0]} of which {counted[1]} are"
        )
    return scene
