"""Scenes out of archives, from a server on this machine, and links to their photos."""

from __future__ import annotations

import io
import sys
import zipfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from files.scene_files import WIDTH, photo, save, write_colmap
from keyss import load_scene
from keyss.core import BackendError, InputError
from keyss.lab.many import benchmark_scenes
from serving import serving

SHRUNK = WIDTH // 4


@pytest.fixture
def server(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder that is served, with an archive of two scenes with photos of two sizes."""
    pytest.importorskip("pooch", reason="pooch is not installed")
    served = tmp_path / "served"
    served.mkdir()
    with zipfile.ZipFile(served / "scenes.zip", "w") as archive:
        for name in ("garden", "stump"):
            folder = write_colmap(tmp_path / "originals" / name, count=9)
            for path in (folder / "images").iterdir():
                save(folder / "images_4" / path.name, photo(0, size=(WIDTH // 4, 2)))
            for path in folder.rglob("*"):
                archive.write(path, Path("some", path.relative_to(tmp_path / "originals")))
        archive.writestr("some/garden/images_4/../../../../evil", "evil")
    with serving(served) as address:
        monkeypatch.setattr(
            benchmark_scenes, "SOURCES", {f"{address}scenes.zip": ("some/garden", "some/stump")}
        )
        yield served


def test_only_what_is_needed_is_unpacked(server: Path, tmp_path: Path) -> None:
    data = tmp_path / "data"
    benchmark_scenes.download_scenes(["garden"], data)
    assert {path.name for path in data.iterdir()} == {"archives", "garden"}
    assert {path.name for path in (data / "garden").iterdir()} == {"images_4", "sparse"}
    for path in (data / "garden").rglob("*.*"):
        original = tmp_path / "originals" / path.relative_to(data)
        assert path.read_bytes() == original.read_bytes()
    (server / "scenes.zip").unlink()
    benchmark_scenes.download_scenes(
        ["garden", "stump"], data
    )  # the other one, from the archive that is there
    assert (data / "stump" / "images_4").is_dir()
    benchmark_scenes.download_scenes(["garden", "stump"], data)  # nothing is missing
    assert not list(tmp_path.rglob("evil"))


def test_what_cannot_be_fetched_or_unpacked_is_said(server: Path, tmp_path: Path) -> None:
    archive = (server / "scenes.zip").read_bytes()
    (server / "scenes.zip").unlink()
    with pytest.raises(InputError, match="404"):
        benchmark_scenes.download_scenes(["garden"], tmp_path / "data")
    for damaged in (archive[:-100], b"<html>not found</html>"):
        (server / "scenes.zip").write_bytes(damaged)
        with pytest.raises(InputError, match="remove it to download it again"):
            benchmark_scenes.download_scenes(["garden"], tmp_path / "data")
        (tmp_path / "data" / "archives" / "scenes.zip").unlink()
    other = io.BytesIO()
    with zipfile.ZipFile(other, "w") as file:
        file.writestr("flowers.txt", "elsewhere")
    (server / "scenes.zip").write_bytes(other.getvalue())
    with pytest.raises(InputError, match="cannot be downloaded or unpacked"):
        benchmark_scenes.download_scenes(["garden"], tmp_path / "data")
    assert not (tmp_path / "data" / "garden").exists()


def test_without_pooch_one_sentence_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pooch", None)
    with pytest.raises(BackendError, match=r"pip install 'keyss\[reproduce\]'"):
        benchmark_scenes.download_scenes(["garden"], tmp_path)


@pytest.fixture
def benchmark(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a scene that is called garden, of 9 photos in `images_4` and of full size in `images`."""
    folder = write_colmap(tmp_path / "data" / "garden", count=9)
    for path in (folder / "images").iterdir():
        save(folder / "images_4" / path.name, photo(0, size=(SHRUNK, 2)))
    monkeypatch.setattr(benchmark_scenes, "BENCHMARK", {"garden": (9, "images_4")})
    return tmp_path / "data"


def test_a_benchmark_scene_is_linked(benchmark: Path, tmp_path: Path) -> None:
    scene = load_scene(benchmark_scenes.link_scene(benchmark, "garden", tmp_path / "links"))
    assert scene.train[0].camera.width == SHRUNK  # not those of full size
    assert (len(scene.train), len(scene.test)) == (7, 2)
    benchmark_scenes.link_scene(benchmark, "garden", tmp_path / "links")  # again
