"""Scenes out of archives: those that are needed, checked, and nothing that an archive would rather write."""

from __future__ import annotations

import hashlib
import io
import stat
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from cli.conftest import keyss as keyss
from cli.said import Said
from files.scene_files import WIDTH, photo, save, write_colmap
from keyss.api import PaperTable, download_scenes
from keyss.core import InputError, UsageError
from keyss.reproduction import downloading, fetching, scenes
from keyss.reproduction.downloading import SOURCES, Archive, download_benchmark, unzip_scene
from keyss.reproduction.scenes import BENCHMARK, BenchmarkScene
from reproduction.file_server import Behaviour, serving

SHRUNK = WIDTH // 4
NAMES = ("garden", "stump")


def quiet(line: str) -> None:
    pass


@pytest.fixture(scope="module")
def contents(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """Files of an archive: two scenes with photos of two sizes, and what lies beside them."""
    root = tmp_path_factory.mktemp("archive")
    for name in NAMES:
        folder = write_colmap(root / name, count=9)
        for path in (folder / "images").iterdir():
            save(folder / "images_4" / path.name, photo(0, size=(SHRUNK, 2)))
    found = {str(path.relative_to(root)): path.read_bytes() for path in root.rglob("*") if path.is_file()}
    for name in NAMES:
        model = {k: v for k, v in found.items() if k.startswith(f"{name}/sparse")}
        if f"{name}/sparse/0/cameras.bin" not in model:
            raise AssertionError(f"expected a model in sparse/0, found {sorted(model)}")
    return found | {"flowers.txt": b"see elsewhere"}


def zipped(contents: dict[str, bytes], compression: int = zipfile.ZIP_DEFLATED) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", compression) as archive:
        for name, data in contents.items():
            archive.writestr(name, data)
    return file.getvalue()


@pytest.fixture
def server(contents: dict[str, bytes], monkeypatch: pytest.MonkeyPatch) -> Iterator[Behaviour]:
    expected = BenchmarkScene(9, "images_4", SHRUNK)
    monkeypatch.setattr(scenes, "BENCHMARK", dict.fromkeys(BENCHMARK, expected))
    monkeypatch.setattr(fetching, "PAUSE", 0.0)
    with serving(zipped(contents)) as found:
        monkeypatch.setattr(downloading, "SOURCES", (Archive(found.url, frozenset(NAMES), 10**8),))
        yield found


def downloaded(names: tuple[str, ...], data: Path) -> list[Path]:
    return download_benchmark(names, data, quiet, downloading.SOURCES)


def test_every_scene_of_the_paper_has_one_source() -> None:
    every = [name for source in SOURCES for name in source.scenes]
    assert sorted(every) == sorted(BENCHMARK)
    assert all(source.url.startswith("https://") for source in SOURCES)
    assert len({source.name for source in SOURCES}) == len(SOURCES)


def test_only_what_is_needed_is_unpacked(server: Behaviour, tmp_path: Path) -> None:
    server.drops = [1000]
    assert downloaded(("garden",), tmp_path) == [tmp_path / "garden"]
    assert len(server.asked) == 2
    assert not (tmp_path / "stump").exists()
    assert {path.name for path in (tmp_path / "garden").iterdir()} == {"images_4", "sparse"}
    assert {path.name for path in (tmp_path / "archives").iterdir()} == {"scenes.zip", "SHA256SUMS"}
    sums = (tmp_path / "archives" / "SHA256SUMS").read_text()
    assert sums == f"{hashlib.sha256(server.data).hexdigest()}  scenes.zip\n"
    downloaded(NAMES, tmp_path)  # the other one, from the archive that is there
    assert (tmp_path / "stump").exists()
    assert len(server.asked) == 2
    (tmp_path / "archives" / "scenes.zip").unlink()
    downloaded(NAMES, tmp_path)  # nothing is missing
    assert len(server.asked) == 2


def test_another_archive_than_the_first_one_is_refused(
    server: Behaviour, contents: dict[str, bytes], tmp_path: Path
) -> None:
    downloaded(("garden",), tmp_path)
    (tmp_path / "archives" / "scenes.zip").unlink()
    server.data, server.etag = zipped(contents | {"flowers.txt": b"another"}), '"2"'
    with pytest.raises(InputError, match="SHA256SUMS"):
        downloaded(("stump",), tmp_path)
    assert not (tmp_path / "stump").exists()
    (tmp_path / "archives" / "SHA256SUMS").unlink()
    downloaded(("stump",), tmp_path)
    (tmp_path / "stump").rename(tmp_path / "was-stump")
    (tmp_path / "archives" / "SHA256SUMS").write_text("nonsense\n")
    with pytest.raises(InputError, match="sha256sum"):
        downloaded(("stump",), tmp_path)


@pytest.mark.parametrize("prefix", ["", "db/", "360_v2/some/"])
def test_scenes_lie_wherever_the_archive_has_them(
    contents: dict[str, bytes], tmp_path: Path, prefix: str
) -> None:
    path = tmp_path / "a.zip"
    path.write_bytes(zipped({f"{prefix}{name}": data for name, data in contents.items()}))
    unzip_scene(path, "garden", "images_4", tmp_path / "garden")
    found = {str(each.relative_to(tmp_path)) for each in tmp_path.rglob("garden/**/*") if each.is_file()}
    wanted = ("garden/images_4/", "garden/sparse/0/")
    assert found == {name for name in contents if name.startswith(wanted)}
    for name in found:
        assert (tmp_path / name).read_bytes() == contents[name]


HOSTILE = (
    "../evil",
    "/tmp/evil",
    "garden/images_4/../../../evil",
    "garden/images_4//evil",
    "garden/images_4/..",
    "garden/images_4/.hidden",
    "garden/images_4/a\\..\\evil",
    "garden/images_4/deeper/evil",
    "garden/sparse/0/C:evil",
    "garden/sparse/0/new\nline",
    "garden/evil",
    "notgarden/images_4/evil",
)


def test_no_name_in_an_archive_leads_elsewhere(contents: dict[str, bytes], tmp_path: Path) -> None:
    path = tmp_path / "in" / "a.zip"
    path.parent.mkdir()
    path.write_bytes(zipped(contents | dict.fromkeys(HOSTILE, b"evil")))
    before = set(tmp_path.rglob("*"))
    unzip_scene(path, "garden", "images_4", tmp_path / "out" / "garden")
    written = {each for each in tmp_path.rglob("*") if each.is_file()} - before
    assert {str(each.relative_to(tmp_path / "out")) for each in written} == {
        name for name in contents if name.startswith(("garden/images_4/", "garden/sparse/0/"))
    }
    assert not any(b"evil" in each.read_bytes() for each in written)


def test_links_and_bombs_are_refused(
    contents: dict[str, bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, link = tmp_path / "a.zip", zipfile.ZipInfo("garden/images_4/link.png")
    link.external_attr = (stat.S_IFLNK | 0o777) << 16
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in contents.items():
            archive.writestr(name, data)
        archive.writestr(link, "/etc/passwd")
    with pytest.raises(InputError, match=r"link\.png"):
        unzip_scene(path, "garden", "images_4", tmp_path / "garden")
    path.write_bytes(zipped(contents | {"garden/images_4/bomb.png": bytes(10**7)}))
    monkeypatch.setattr(downloading, "_MOST_FILE_BYTES", 10**6)
    with pytest.raises(InputError, match=r"bomb\.png"):
        unzip_scene(path, "garden", "images_4", tmp_path / "garden")
    monkeypatch.setattr(downloading, "_MOST_FILE_BYTES", 10**8)
    for name, most in (("_MOST_SCENE_BYTES", 10**6), ("_MOST_SCENE_FILES", 3), ("_MOST_FILES", 3)):
        with monkeypatch.context() as patch:
            patch.setattr(downloading, name, most)
            with pytest.raises(InputError, match=r"too many|at most"):
                unzip_scene(path, "garden", "images_4", tmp_path / "garden")
    assert not (tmp_path / "garden").exists()


def test_damage_is_said_and_leaves_nothing(
    server: Behaviour, contents: dict[str, bytes], tmp_path: Path
) -> None:
    data = bytearray(zipped(contents, zipfile.ZIP_STORED))
    model = contents["garden/sparse/0/images.bin"]
    data[data.index(model) + len(model) // 2] ^= 1
    for damaged, words in (
        (bytes(data), "CRC"),
        (bytes(data[:-100]), "zip"),
        (b"<html>not found</html>", "zip"),
        (zipped({k: v for k, v in contents.items() if "garden" not in k}), "expected the scene garden"),
        (zipped({k: v for k, v in contents.items() if "garden/images_4/00" not in k}), "9 photos, found 8"),
    ):
        folder = tmp_path / hashlib.sha256(damaged).hexdigest()[:8]
        server.data, server.etag = damaged, f'"{folder.name}"'
        with pytest.raises(InputError, match=words):
            downloaded(("garden",), folder)
        assert {path.name for path in folder.iterdir()} == {"archives"}
        assert {path.name for path in (folder / "archives").iterdir()} == {"scenes.zip"}
        (folder / "archives" / "scenes.zip").unlink()  # as it says
        server.data, server.etag = zipped(contents), '"right"'
        downloaded(("garden",), folder)


@pytest.mark.parametrize("compression", [zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_damage_of_any_compression_is_said(
    compression: int, contents: dict[str, bytes], tmp_path: Path
) -> None:
    path = tmp_path / "scenes.zip"
    path.write_bytes(zipped(contents, compression))
    with zipfile.ZipFile(path) as file:
        info = file.getinfo("garden/sparse/0/images.bin")
    data = bytearray(path.read_bytes())
    start = info.header_offset + 30 + len(info.filename)
    for offset in range(min(12, info.compress_size)):
        data[start + offset] ^= 0x5A
    path.write_bytes(bytes(data))
    with pytest.raises(InputError, match="cannot be unpacked"):
        unzip_scene(path, "garden", "images_4", tmp_path / "garden")


def test_a_table_says_which_scenes_it_needs(
    server: Behaviour, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = PaperTable("single", scale="full", data=tmp_path, pairs=["garden,stump"])
    assert [path.name for path in download_scenes(asked)] == ["garden", "stump"]
    with pytest.raises(UsageError, match="scale"):
        download_scenes(PaperTable("single", ["a", "b"]))
    with pytest.raises(UsageError, match="did you mean single"):
        download_scenes(replace(asked, table="singel"))


def test_the_command_says_what_cannot_be(keyss: Callable[..., Said], tmp_path: Path) -> None:
    full = ("reproduce", "single", "--scale", "full", "--data", tmp_path / "data", "-o", tmp_path / "out")
    both = keyss(*full, "--download", "--dry-run")
    assert (both.status, "--download" in both.err) == (2, True)
    small = keyss("reproduce", "single", "a", "b", "--download", "-o", tmp_path / "out")
    assert (small.status, "--scale full" in small.err) == (2, True)
    assert not (tmp_path / "data").exists()
