"""The folder of a run: what it holds, who is at work in it, and what of it this program may remove.

`publish/` holds what may be given away and nothing else; `private/` (mode 0700) holds what this program keeps
to itself, in files of mode 0600: among them the manifest, which lists every file that was written here, and
while something runs the lock, the checkpoints and the files that are not finished.
"""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath
from typing import Any

import msgspec

from keyss._version import __version__
from keyss.core.errors import InputError, OutputError, UsageError
from keyss.files.lock import held_by, lock
from keyss.files.output import check_not_an_input
from keyss.runs.records import read_record, write_record

PUBLISH, PRIVATE = "publish", "private"
MANIFEST = f"{PRIVATE}/manifest.json"
_LOCK, _CHECKPOINTS, _STAGING = (f"{PRIVATE}/{name}" for name in ("lock", "checkpoint", "unfinished"))

_LONGEST_SHOWN = 60  # characters of an argument in a message


@dataclass(frozen=True, kw_only=True)
class Running:
    """Work that has begun and has not ended."""

    stage: str
    arguments: dict[str, Any]  # must be equal to resume
    seconds: float = 0.0  # of its interrupted parts


@dataclass(frozen=True, kw_only=True)
class Manifest:
    """What this program wrote into a folder."""

    version: int = 1
    keyss: str = __version__
    running: Running | None = None
    files: dict[str, tuple[str, ...]] = field(default_factory=dict)  # paths in the folder, by stage


class RunFolder:
    """A folder for the results of one stage: of hiding, or of an audit of what was hidden, for example.

    `arguments`: JSON-able, what `resume` compares. `onto`: stages whose results are there already and stay;
    those of all other stages are replaced, which takes `overwrite`. `writes`: names of files to come, as far
    as they are known; one that is somebody else's is never replaced. `inputs`: what is read; none of it may
    be among what is replaced.

    Nothing is created before `work`. Raises OutputError when the folder is not empty and neither `overwrite`
    nor `resume` is given, when there is nothing to resume, and when another process is at work in it;
    UsageError for both at once.
    """

    def __init__(
        self,
        path: Path | str,
        stage: str,
        arguments: Mapping[str, Any] | None = None,
        *,
        onto: Collection[str] = (),
        writes: Collection[str] = (),
        inputs: Collection[Path] = (),
        overwrite: bool = False,
        resume: bool = False,
    ) -> None:
        self.path, self.stage, self.onto = Path(path), stage, frozenset(onto)
        # As they will be read again: tuples become lists.
        self.arguments: dict[str, Any] = msgspec.json.decode(msgspec.json.encode(dict(arguments or {})))
        if overwrite and resume:
            raise UsageError("`overwrite=True` starts anew and `resume=True` continues: give one of them")
        check_not_published(self.path)
        self._was_there = self.path.exists()
        self._continues = False
        self._started = time.monotonic()
        self.earlier_seconds = 0.0  # of the interrupted parts of a resumed run
        if self.path.is_symlink() or self._was_there:
            if not self.path.is_dir():
                raise OutputError(f"{self.path} exists and is not a folder")
            self._check(overwrite, resume)
            if overwrite:
                self._refuse_inputs(inputs)
        for name in writes:
            _refuse_foreign(self.path, name)

    def _check(self, overwrite: bool, resume: bool) -> None:
        """Raise OutputError where this stage must not begin."""
        if (pid := held_by(self.path / _LOCK)) is not None:
            raise OutputError(f"{self.path}: process {pid} is at work in this folder")
        there = read_manifest(self.path)
        in_use = set(there.files) - self.onto or (there == Manifest() and any(self.path.iterdir()))
        if (running := there.running) is not None:
            if resume:
                self._check_same(running)
                self._continues = True
                self.earlier_seconds = running.seconds
            elif not overwrite and (in_use or self._has_checkpoints()):
                raise OutputError(
                    f"{self.path} holds an interrupted run ({running.stage}): `resume=True` with the same "
                    "arguments continues it, `overwrite=True` drops it"
                )
        elif in_use and resume:
            found = f"a finished run ({self.stage})" if self.stage in there.files else "something else"
            raise OutputError(f"{self.path} holds {found}, and no interrupted run that could be resumed")
        elif in_use and not overwrite:
            raise OutputError(
                f"{self.path} exists: choose another folder, or `overwrite=True` to replace what keyss wrote"
            )

    def _refuse_inputs(self, inputs: Collection[Path]) -> None:
        """Raise UsageError if one of them would be replaced."""
        for stage, names in read_manifest(self.path).files.items():
            for name in names if stage not in self.onto else ():
                check_not_an_input(self.path / name, inputs)

    def _check_same(self, running: Running) -> None:
        """Raise OutputError unless this is the run that was interrupted."""
        if running.stage != self.stage:
            raise OutputError(
                f"{self.path} holds an interrupted run of another kind ({running.stage}, not {self.stage})"
            )
        old, new = running.arguments, self.arguments
        differ = [name for name in sorted({*old, *new}) if old.get(name) != new.get(name)]
        if differ:
            changes = "; ".join(f"{name}: {_differences(old.get(name), new.get(name))}" for name in differ)
            raise OutputError(
                f"{self.path} holds an interrupted run with other arguments ({changes}): give the same ones, "
                "or start anew with `overwrite=True`"
            )

    @contextmanager
    def work(self) -> Iterator[RunFolder]:
        """Claims the folder while the block runs.

        At its end the files that were written appear, all or none, those that they replace are removed, and
        checkpoints too. When the block fails, checkpoints stay if there are any, to be resumed from; else the
        folder is left as it was. Raises OutputError.
        """
        try:
            with _typed(self.path):
                self.path.mkdir(parents=True, exist_ok=True)
                _keep_private(self.path)
            with lock(self.path / _LOCK):
                before = read_manifest(self.path)  # again: now nobody else changes it
                if not self._continues:
                    _drop_unfinished(self.path, before)
                shutil.rmtree(self.path / _STAGING, ignore_errors=True)
                self._save(replace(before, running=self._running()))
                self._names: list[str] = []
                try:
                    yield self
                    with _typed(self.path):
                        self._finish()
                except BaseException:
                    self._give_up()
                    raise
        finally:
            _remove_empty(self.path / PRIVATE)
            if not self._was_there:
                _remove_empty(self.path)

    @property
    def checkpoints(self) -> Path:
        """The folder for checkpoints, created."""
        folder = self.path / _CHECKPOINTS
        with _typed(folder):
            folder.mkdir(exist_ok=True, mode=0o700)
        return folder

    def write(self, writers: Mapping[str, Callable[[Path], None]]) -> Path:
        """Call each writer with a path to write a file or a folder to; returns where they lie until the end.

        Names are paths in the run's folder. Raises OutputError.
        """
        staging = self.path / _STAGING
        with _typed(self.path):
            for name, write in writers.items():
                _refuse_foreign(self.path, name)
                _make_folders(self.path, f"{_STAGING}/{name}")
                write(staging / name)
                written = [staging / name]
                if written[0].is_dir():
                    written = sorted(path for path in written[0].rglob("*") if path.is_file())
                self._names += [str(path.relative_to(staging)) for path in written]
        return staging

    def keep(self, stage: str, name: str, write: Callable[[Path], None]) -> None:
        """Write a file of another stage; it stays whatever becomes of this one. Raises OutputError."""
        with _typed(self.path):
            _write_entered(self.path, stage, name, write)

    def _finish(self) -> None:
        there = read_manifest(self.path)
        kept = {stage: names for stage, names in there.files.items() if stage in self.onto}
        for stage, names in there.files.items():
            if stage not in kept:
                _remove(self.path, names)
        # Listed before they appear: whatever happens in between, the manifest knows them.
        there = replace(there, files=kept | {self.stage: tuple(self._names)})
        self._save(there)
        try:
            for name in self._names:
                staged, target = self.path / _STAGING / name, self.path / name
                _make_folders(self.path, name)
                if name.startswith(f"{PUBLISH}/"):
                    staged.chmod(0o666 & ~_umask())
                os.replace(staged, target)
        except BaseException:
            _remove(self.path, self._names)
            self._save(replace(there, files=kept))
            raise
        # Last: what lies there is known as our own for as long as the manifest says that something runs.
        _drop_unfinished(self.path, there)
        self._save(replace(there, running=None))

    def _give_up(self) -> None:
        """Leave what can be resumed, or the folder as it was."""
        shutil.rmtree(self.path / _STAGING, ignore_errors=True)
        there = read_manifest(self.path)
        if self._has_checkpoints():
            self._save(replace(there, running=self._running()))
            return
        _drop_unfinished(self.path, there)
        there = replace(there, running=None)
        if there.files:
            self._save(there)
        else:
            (self.path / MANIFEST).unlink(missing_ok=True)

    def _running(self) -> Running:
        seconds = self.earlier_seconds + time.monotonic() - self._started
        return Running(stage=self.stage, arguments=self.arguments, seconds=seconds)

    def _has_checkpoints(self) -> bool:
        folder = self.path / _CHECKPOINTS
        # What begins with a dot is what a killed process did not write to its end.
        return folder.is_dir() and any(not path.name.startswith(".") for path in folder.iterdir())

    def _save(self, manifest: Manifest) -> None:
        write_record(self.path / MANIFEST, manifest)


def check_not_published(path: Path | str) -> None:
    """Raise OutputError for a place in a run's `publish/`, which is given away."""
    real = Path(os.path.realpath(path))
    for folder in (real, *real.parents):
        if folder.name == PUBLISH and (folder.parent / MANIFEST).exists():
            raise OutputError(
                f"{path} would be given away with all that is in {folder}: choose another place"
            )


def clear(folder: Path) -> None:
    """Remove all that this program wrote into a folder, and the folder if nothing else is in it."""
    if not (folder / PRIVATE).is_dir():
        return
    with _typed(folder):
        with lock(folder / _LOCK):
            there = read_manifest(folder)
            _drop_unfinished(folder, there)
            _remove(folder, [name for names in there.files.values() for name in names])
            (folder / MANIFEST).unlink(missing_ok=True)
        _remove_empty(folder / PRIVATE)
        _remove_empty(folder)


def write_again(folder: Path, stage: str, name: str, write: Callable[[Path], None]) -> None:
    """Write a file of a finished stage anew. Raises OutputError, also where a process is at work."""
    with _typed(folder):
        _keep_private(folder)
        with lock(folder / _LOCK):
            _write_entered(folder, stage, name, write)


def read_manifest(folder: Path) -> Manifest:
    """What this program wrote into a folder; empty where there is no manifest.

    Raises OutputError for a damaged one, and for one that names what is not in the folder.
    """
    path = folder / MANIFEST
    if not path.exists():
        return Manifest()
    try:
        manifest = read_record(path, Manifest)
    except InputError as error:
        raise OutputError(f"{error}; what keyss wrote in {folder} is not known any more") from error
    for name in (name for names in manifest.files.values() for name in names):
        parts = PurePosixPath(name).parts
        if not parts or ".." in parts or parts[0] == "/" or "\0" in name or name == MANIFEST:
            raise OutputError(f"{path}: {name!r} is not a file in this folder")
    return manifest


def recorded_number(folder: Path, *names: str) -> int | None:
    """An argument of the interrupted run in a folder, by the names that lead to it; None: it has none."""
    running = read_manifest(folder).running
    found: Any = running and running.arguments
    for name in names:
        found = found.get(name) if isinstance(found, dict) else None
    return found if isinstance(found, int) else None


def _drop_unfinished(folder: Path, there: Manifest) -> None:
    """Remove the traces of a run that `there` knows to be unfinished.

    Raises OutputError for folders of these names where it knows of none: they are somebody else's.
    """
    for name in (_CHECKPOINTS, _STAGING):
        if there.running is None and os.path.lexists(folder / name):
            raise OutputError(f"{folder / name} is in the way, and keyss did not write it: move it")
        shutil.rmtree(folder / name, ignore_errors=True)


def _write_entered(folder: Path, stage: str, name: str, write: Callable[[Path], None]) -> None:
    _refuse_foreign(folder, name)
    there = read_manifest(folder)
    if not any(name in names for names in there.files.values()):
        names = {**there.files, stage: (*there.files.get(stage, ()), name)}
        write_record(folder / MANIFEST, replace(there, files=names))
    _make_folders(folder, name)
    write(folder / name)


def _keep_private(folder: Path) -> None:
    """Make the part of a run's folder that is its owner's alone; one of others gets so."""
    (folder / PRIVATE).mkdir(mode=0o700, exist_ok=True)
    (folder / PRIVATE).chmod(0o700)


def _make_folders(folder: Path, name: str) -> None:
    """The folders of a file in a run's folder: those in `private/` are its owner's alone, wherever moved."""
    mode = 0o700 if name.startswith(f"{PRIVATE}/") else 0o777
    for parent in reversed(PurePosixPath(name).parents[:-1]):
        (folder / parent).mkdir(mode=mode, exist_ok=True)


def _refuse_foreign(folder: Path, name: str) -> None:
    """Raise OutputError if what is in the way of a file is not this program's."""
    target = folder / name
    if any((folder / parent).is_symlink() for parent in PurePosixPath(name).parents if parent.name):
        raise OutputError(
            f"{target.parent} leads out of {folder}: remove this link, or choose another folder"
        )
    if not (target.is_symlink() or target.exists()):
        return
    ours = {each for names in read_manifest(folder).files.values() for each in names}
    inside = target.rglob("*") if target.is_dir() and not target.is_symlink() else ()
    files = [str(path.relative_to(folder)) for path in inside if path.is_symlink() or not path.is_dir()]
    if name not in ours and not (files and ours.issuperset(files)):
        raise OutputError(
            f"{target} is in the way, and keyss did not write it: move it, or choose another folder"
        )


def _remove(folder: Path, names: Collection[str]) -> None:
    """Remove files, and folders below `folder` that are empty then; links to elsewhere are not followed."""
    for name in names:
        path = folder / name
        parents = list(path.relative_to(folder).parents)[:-1]
        if any((folder / parent).is_symlink() for parent in parents) or (
            path.is_dir() and not path.is_symlink()
        ):
            continue
        path.unlink(missing_ok=True)
        for parent in parents:
            _remove_empty(folder / parent)


def _remove_empty(folder: Path) -> None:
    with suppress(OSError):  # not there, or something is in it
        folder.rmdir()


def _differences(old: Any, new: Any) -> str:
    """What differs, down to the innermost fields."""
    if isinstance(old, dict) and isinstance(new, dict):
        names = [name for name in sorted({*old, *new}) if old.get(name) != new.get(name)]
        return ", ".join(f"{name} {_differences(old.get(name), new.get(name))}" for name in names)
    shown = _shown(old), _shown(new)
    return "not the same" if max(map(len, shown)) > _LONGEST_SHOWN else f"{shown[0]} then, {shown[1]} now"


def _shown(value: Any) -> str:
    return "none" if value is None else msgspec.json.encode(value).decode()


def _umask() -> int:
    umask = os.umask(0)
    os.umask(umask)
    return umask


@contextmanager
def _typed(path: Path) -> Iterator[None]:
    """The system's errors as OutputErrors."""
    try:
        yield
    except OSError as error:
        raise OutputError(f"cannot write to {error.filename or path}: {error.strerror or error}") from error
