"""Mip-NeRF 360, and playroom of Deep Blending: downloads, and links to the photos that papers use."""

from __future__ import annotations

import zipfile
import zlib
from collections.abc import Iterable, Mapping
from pathlib import Path

from keyss.core.errors import InputError, OutputError, import_extra
from keyss.files.colmap import colmap_model_folder, read_colmap

TEST_EVERY = 8

# Number of photos, and the folder that the paper uses: a quarter of the size outdoors, half of it indoors.
BENCHMARK: Mapping[str, tuple[int, str]] = {
    "bicycle": (194, "images_4"),
    "bonsai": (292, "images_2"),
    "room": (311, "images_2"),
    "flowers": (173, "images_4"),
    "treehill": (141, "images_4"),
    "garden": (185, "images_4"),
    "stump": (125, "images_4"),
    "counter": (240, "images_2"),
    "kitchen": (279, "images_2"),
    "playroom": (225, "images"),
}
_REFRAW = "https://storage.googleapis.com/gresearch/refraw360"
_INRIA = "https://repo-sam.inria.fr/fungraph/3d-gaussian-splatting/datasets/input"
# Archives, and the folder of each scene in them: Mip-NeRF 360 from its authors, and Deep Blending from those
# of 3DGS. No checksums are published.
SOURCES: Mapping[str, tuple[str, ...]] = {
    f"{_REFRAW}/360_v2.zip": ("bicycle", "bonsai", "counter", "garden", "kitchen", "room", "stump"),
    f"{_REFRAW}/360_extra_scenes.zip": ("flowers", "treehill"),
    f"{_INRIA}/tandt_db.zip": ("db/playroom",),
}


def download_scenes(names: Iterable[str], data: Path) -> None:
    """Download those of the scenes that are missing in `data`, with the photos that the paper uses.

    Archives stay in `data/archives`. Raises InputError for a failed download or a damaged archive, and
    BackendError without pooch.
    """
    pooch = import_extra("pooch", "reproduce", "download scenes")
    missing = {name for name in names if not (data / name).exists()}
    archives = data / "archives"
    for url, folders in SOURCES.items():
        wanted = {name: folder for folder in folders if (name := folder.rpartition("/")[2]) in missing}
        parts = {name: ("sparse/0", BENCHMARK[name][1]) for name in wanted}
        members = [f"{folder}/{part}" for name, folder in wanted.items() for part in parts[name]]
        file = url.rpartition("/")[2]
        if not wanted:
            continue
        try:
            unzip = pooch.Unzip(members, extract_dir="unpacked")
            pooch.retrieve(url, None, file, path=archives, processor=unzip, progressbar=True)
            for name, folder in wanted.items():
                (archives / "unpacked" / folder).rename(data / name)
        except (OSError, ValueError, zipfile.BadZipFile, zlib.error) as error:
            advice = f"if {archives / file} exists, remove it to download it again"
            raise InputError(f"{url}: cannot be downloaded or unpacked: {error}; {advice}") from error


def link_scene(data: Path, name: str, folder: Path) -> Path:
    """A scene of the paper in `folder`, with links to the photos that the paper uses.

    Raises InputError where they are missing, or not as many as the paper's; OutputError.
    """
    photos, images = BENCHMARK[name]
    scene, source = folder / name, data / name
    model = colmap_model_folder(source)
    if model is None or not (source / images).is_dir():
        raise InputError(
            f"{data}: expected a folder {name} with {images} and a COLMAP model, a scene of Mip-NeRF 360 (or "
            "playroom, of Deep Blending), found none; `download=True` downloads it"
        )
    try:
        scene.mkdir(parents=True, exist_ok=True)
        for place, target in (("sparse", model), (images, source / images)):
            if not (scene / place).is_symlink():
                (scene / place).symlink_to(target.resolve())
    except OSError as error:
        raise OutputError(f"cannot write to {scene}: {error.strerror}") from error
    layout = read_colmap(scene)
    counted = len(layout.train) + len(layout.test), len(layout.test)
    if counted != (photos, -(-photos // TEST_EVERY)):
        raise InputError(
            f"{source}: expected {photos} photos in the COLMAP model, every {TEST_EVERY}th for testing, "
            f"found {counted[0]}, {counted[1]} for testing"
        )
    return scene
