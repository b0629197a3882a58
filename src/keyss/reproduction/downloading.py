"""The paper's scenes from where their authors have them: Mip-NeRF 360, and Deep Blending as 3DGS takes it."""

from __future__ import annotations

import lzma
import re
import shutil
import stat
import zipfile
import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from keyss.core.errors import InputError, OutputError
from keyss.files.atomic import write_bytes
from keyss.files.lock import lock
from keyss.files.reading import read_text
from keyss.reproduction import scenes
from keyss.reproduction.fetching import Note, fetch
from keyss.reproduction.scenes import check_benchmark

ARCHIVES, SUMS = "archives", "SHA256SUMS"  # a folder in that of the scenes, and a file in it
_UNPACKED = "unpacked"
_MOST_FILES = 200_000  # in an archive
_MOST_SCENE_FILES = 2000
_MOST_FILE_BYTES = 1 << 30
_MOST_SCENE_BYTES = 16 << 30
_PLAIN_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_. -]{0,199}")
_SUM = re.compile(r"([0-9a-f]{64})  ([A-Za-z0-9_.-]{1,100})")


@dataclass(frozen=True)
class Archive:
    """Where scenes come from. No checksum of any is published."""

    url: str
    scenes: frozenset[str]
    most: int  # bytes: about a third more than public descriptions say, or a guess where they say nothing

    @property
    def name(self) -> str:
        return self.url.rsplit("/", 1)[-1]


_REFRAW = "https://storage.googleapis.com/gresearch/refraw360"
# 12.5 GB, of unknown size, and 0.7 GB, by descriptions of mirrors; the addresses are those of the projects'
# pages (jonbarron.info/mipnerf360, repo-sam.inria.fr/fungraph/3d-gaussian-splatting).
SOURCES: tuple[Archive, ...] = (
    Archive(
        f"{_REFRAW}/360_v2.zip",
        frozenset({"bicycle", "bonsai", "counter", "garden", "kitchen", "room", "stump"}),
        17 * 10**9,
    ),
    Archive(f"{_REFRAW}/360_extra_scenes.zip", frozenset({"flowers", "treehill"}), 10 * 10**9),
    Archive(
        "https://repo-sam.inria.fr/fungraph/3d-gaussian-splatting/datasets/input/tandt_db.zip",
        frozenset({"playroom"}),
        10**9,
    ),
)


def download_benchmark(
    names: Iterable[str], data: Path, note: Note, sources: Sequence[Archive]
) -> list[Path]:
    """Folders of the paper's scenes in `data`, those that were missing from the archives that have them.

    Of a scene its model and the photos of the benchmark's size are unpacked, and checked as before a run.
    Archives stay in `data/archives/`, with their SHA-256 as first seen in `SHA256SUMS`, to which they are
    held from then on, even if they are removed and fetched again. Raises InputError, OutputError.
    """
    wanted = sorted(set(names))
    missing = {name for name in wanted if not (data / name).exists()}
    place = data / ARCHIVES
    try:
        place.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"cannot write to {place}: {error.strerror}") from error
    with lock(place / "lock"):
        for source in sources:
            own = sorted(missing & source.scenes)
            if not own:
                continue
            note(f"{source.name}, for {', '.join(own)}: from {source.url}")
            known = _sums(place / SUMS)
            path = place / source.name
            found = fetch(source.url, path, expected=known.get(source.name), most=source.most, note=note)
            for name in own:
                note(f"unpacking {name}")
                _unpack(path, name, place / _UNPACKED, data / name)
            # Not before: what is damaged is no file to hold others against.
            _write_sums(place / SUMS, known | {source.name: found})
    for name in wanted:
        check_benchmark(data, name)
    return [data / name for name in wanted]


def _unpack(archive: Path, name: str, into: Path, target: Path) -> None:
    """A scene of the archive at `target`: all of it, checked, or nothing. Raises InputError, OutputError."""
    try:
        shutil.rmtree(into, ignore_errors=True)
        unzip_scene(archive, name, scenes.BENCHMARK[name].images, into / name)
        check_benchmark(into, name)
        (into / name).rename(target)
    except OSError as error:
        raise OutputError(f"cannot write to {target}: {error.strerror}") from error
    finally:
        shutil.rmtree(into, ignore_errors=True)


def unzip_scene(archive: Path, name: str, images: str, target: Path) -> None:
    """The COLMAP model and the folder `images` of the scene `name` in a ZIP file, in the new folder `target`.

    Nothing else is written, whatever is in it: names are looked for, not followed. Every file's CRC-32 is
    checked. Raises InputError for a file that is damaged, too large or has no such scene; OSError.
    """
    try:
        with zipfile.ZipFile(archive) as file:
            chosen = _members(archive, file.infolist(), name, images)
            for path, member in chosen.items():
                out = target / path
                out.parent.mkdir(parents=True, exist_ok=True)
                with file.open(member) as source, out.open("xb") as written:
                    shutil.copyfileobj(source, written, 1 << 20)
    except (zipfile.BadZipFile, zlib.error, lzma.LZMAError, EOFError, ValueError, RuntimeError) as error:
        # NotImplementedError, a RuntimeError, is an unknown compression; others are passwords.
        raise _damaged(archive, error) from error
    except OSError as error:
        if error.errno is None:  # as bz2 has it for damage
            raise _damaged(archive, error) from error
        raise


def _damaged(archive: Path, error: Exception) -> InputError:
    return InputError(f"{archive}: cannot be unpacked: {error}; remove it to fetch it again")


def _members(
    archive: Path, infos: Sequence[zipfile.ZipInfo], name: str, images: str
) -> Mapping[str, zipfile.ZipInfo]:
    """Of a scene what is needed, by its path in there. Raises InputError."""
    if len(infos) > _MOST_FILES:
        raise InputError(f"{archive}: expected at most {_MOST_FILES:,} files, found {len(infos):,}")
    models = [each.filename for each in infos if each.filename.endswith(f"{name}/sparse/0/cameras.bin")]
    roots = sorted({each.removesuffix("sparse/0/cameras.bin") for each in models}, key=len)
    roots = [root for root in roots if root == f"{name}/" or root.endswith(f"/{name}/")]
    if not roots:
        raise InputError(f"{archive}: expected the scene {name} ({name}/sparse/0/cameras.bin), found none")
    found: dict[str, zipfile.ZipInfo] = {}
    for info in infos:
        for folder in (images, "sparse/0"):
            rest = info.filename.removeprefix(f"{roots[0]}{folder}/")
            if rest == info.filename or not _PLAIN_NAME.fullmatch(rest):
                continue
            if stat.S_ISLNK(info.external_attr >> 16) or info.file_size > _MOST_FILE_BYTES:
                raise InputError(f"{archive}: {info.filename}: expected a file of at most 1 GiB")
            found[f"{folder}/{rest}"] = info
    size = sum(info.file_size for info in found.values())
    if len(found) > _MOST_SCENE_FILES or size > _MOST_SCENE_BYTES:
        raise InputError(f"{archive}: {name} has {len(found):,} files of {size:,} bytes: too many")
    return found


def _sums(path: Path) -> dict[str, str]:
    """Checksums by names. Raises InputError."""
    if not path.exists():
        return {}
    found = {}
    for line in read_text(path, 1 << 16).splitlines():
        match = _SUM.fullmatch(line)
        if match is None:
            raise InputError(f"{path}: expected lines as sha256sum writes them, found {line[:80]!r}")
        found[match[2]] = match[1]
    return found


def _write_sums(path: Path, sums: Mapping[str, str]) -> None:
    """As `sha256sum --check` reads them. Raises OutputError."""
    write_bytes(path, "".join(f"{value}  {name}\n" for name, value in sorted(sums.items())).encode())
