"""The folder of a run: its files, the process that works in it, and the files that keyss may remove.

`publish/` holds what may be given away and nothing else. `private/` (mode 0700, files 0600) holds the rest:
the manifest, which lists every file that keyss wrote, and while a run is at work its lock, checkpoints and
unfinished files.
"""

from __future__ import annotations

import os
import shutil
import time
import warnings
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any

import msgspec

from keyss._version import __version__
from keyss.core.errors import InputError, KeyssWarning, OutputError, UsageError
from keyss.core.gaussians import Gaussians
from keyss.files.atomic import check_not_an_input, leftovers, lock, public_mode, write_bytes
from keyss.files.models import write_model
from keyss.runs.json_records import read_record, record_bytes, write_record

PUBLISH, PRIVATE = "publish", "private"
MANIFEST = f"{PRIVATE}/manifest.json"
_LOCK, CHECKPOINTS, _STAGING = (f"{PRIVATE}/{name}" for name in ("lock", "checkpoint", "unfinished"))
HIDE_FILES = "hide files"  # the stage of hidden files

_MAX_SHOWN = 60  # characters of an argument in a message


@dataclass(frozen=True, kw_only=True)
class Running:
    """An unfinished stage."""

    stage: str
    arguments: dict[str, Any]  # must be equal to resume
    seconds: float = 0.0  # duration of its interrupted parts


@dataclass(frozen=True, kw_only=True)
class Manifest:
    """The files that keyss wrote into a folder."""

    version: int = 1
    keyss: str = __version__
    running: Running | None = None
    files: dict[str, tuple[str, ...]] = field(default_factory=dict)  # relative paths, by stage


class RunFolder:
    """A folder for the results of one stage, such as hiding, or an audit of a finished hiding.

    `arguments`: JSON-able, must be equal to resume. `onto`: stages whose results stay, perhaps its own;
    replacing those of other stages needs `overwrite`. `writes`: known names of files to write; raises
    OutputError if others wrote such files. `inputs`: files that are read and must not be replaced.

    Nothing is created before `work`. Raises OutputError if the folder is not empty without `overwrite` or
    `resume`, if it holds another run to resume, and if another process works in it; UsageError for both
    options. Warns (KeyssWarning) if there is no checkpoint to resume from.
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
        # Equal to what a manifest returns: tuples become lists.
        self.arguments: dict[str, Any] = msgspec.json.decode(record_bytes(dict(arguments or {})))
        if overwrite and resume:
            raise UsageError("`overwrite=True` starts anew and `resume=True` continues: give one of them")
        check_not_published(self.path)
        self._existed = self.path.exists()
        self._resumes = False
        self._started = time.monotonic()
        self.earlier_seconds = 0.0  # interrupted parts of a resumed run
        if self.path.is_symlink() or self._existed:
            if not self.path.is_dir():
                raise OutputError(f"{self.path} exists and is not a folder")
            self._check(overwrite, resume)
            for name in self._files_to_replace(read_manifest(self.path)) if overwrite else ():
                check_not_an_input(self.path / name, inputs)
        real = Path(os.path.realpath(self.path))
        nearest = next(folder for folder in (real, *real.parents) if folder.exists())
        if not os.access(nearest, os.W_OK):
            raise OutputError(f"cannot write to {self.path}: {nearest} is not writable")
        if resume and not self._has_checkpoints():
            warnings.warn(f"{self.path} holds no checkpoint: starting anew", KeyssWarning, stacklevel=3)
        for name in writes:
            _refuse_foreign(self.path, name)

    def _check(self, overwrite: bool, resume: bool) -> None:
        """Raise OutputError if this stage must not begin."""
        if (self.path / _LOCK).exists():
            with lock(self.path / _LOCK, self.path):  # raises OutputError if another process holds it
                pass
        manifest = read_manifest(self.path)
        in_use = set(manifest.files) - self.onto or (manifest == Manifest() and self._has_files())
        if (running := manifest.running) is not None:
            if resume:
                self._check_same(running)
                self._resumes = True
                self.earlier_seconds = running.seconds
            elif not overwrite and (in_use or self._has_checkpoints()):
                raise OutputError(
                    f"{self.path} holds an interrupted run ({running.stage}): `resume=True` with the same "
                    "arguments continues it, `overwrite=True` drops it"
                )
        elif in_use and resume:
            content = f"a finished run ({self.stage})" if self.stage in manifest.files else "something else"
            raise OutputError(f"{self.path} holds {content}, and no interrupted run that could be resumed")
        elif in_use == {self.stage} and self.onto and not overwrite:
            raise OutputError(
                f"{self.path} has a finished {self.stage} already: `overwrite=True` replaces it and keeps "
                "all other files"
            )
        elif in_use and not overwrite:
            raise OutputError(
                f"{self.path} exists: choose another folder, or `overwrite=True` to replace what keyss wrote "
                "there and keep all other files"
            )

    def _has_files(self) -> bool:
        """True if the folder has a file; a killed process may leave folders, locks and a partial manifest."""
        left = {self.path / _LOCK, *leftovers(self.path / MANIFEST)}
        paths = self.path.rglob("*")
        return any(path not in left and not (path.is_dir() and not path.is_symlink()) for path in paths)

    def _files_to_replace(self, manifest: Manifest) -> list[str]:
        """Names of the files that this stage replaces."""
        return [name for stage, names in manifest.files.items() if stage not in self.onto for name in names]

    def _check_same(self, running: Running) -> None:
        """Raise OutputError unless `running` has the stage and the arguments of this run."""
        if running.stage != self.stage:
            raise OutputError(
                f"{self.path} holds an interrupted run of another kind ({running.stage}, not {self.stage}): "
                "finish that one, or start anew with `overwrite=True`"
            )
        if running.arguments != self.arguments:
            changes = _differences(running.arguments, self.arguments)
            own = [change for change in changes if not change.startswith("keys: ")]  # verifiers depend on all
            raise OutputError(
                f"{self.path} holds an interrupted run with other arguments ({'; '.join(own or changes)}): "
                "give the same ones, or start anew with `overwrite=True`"
            )

    @contextmanager
    def work(self) -> Iterator[RunFolder]:
        """Claim the folder while the block runs.

        At its end, all written files appear or none, and checkpoints and replaced files are removed. If the
        block fails, checkpoints stay; without checkpoints, the folder does not change. Raises OutputError.
        """
        try:
            with _os_errors(self.path):
                self.path.mkdir(parents=True, exist_ok=True)
            make_private(self.path / PRIVATE)
            with lock(self.path / _LOCK, self.path):
                manifest = read_manifest(self.path)  # read again: no other process can change it now
                if not self._resumes:
                    _drop_unfinished(self.path, manifest)
                shutil.rmtree(self.path / _STAGING, ignore_errors=True)
                self._save(replace(manifest, running=self._running()))
                self._names: list[str] = []
                try:
                    yield self
                    with _os_errors(self.path):
                        self._finish()
                except BaseException:
                    self._give_up()
                    raise
        finally:
            _remove_empty(self.path / PRIVATE)
            if not self._existed:
                _remove_empty(self.path)

    @property
    def checkpoints(self) -> Path:
        """The folder for checkpoints, created."""
        folder = self.path / CHECKPOINTS
        with _os_errors(folder):
            folder.mkdir(exist_ok=True, mode=0o700)
        return folder

    def write(self, contents: Mapping[str, Any]) -> Path:
        """Write models, bytes and records; returns the folder that holds them until the end.

        Names are paths in the run's folder, where the files appear at the end. Raises OutputError.
        """
        staging = self.path / _STAGING
        with _os_errors(self.path):
            for name, content in contents.items():
                _refuse_foreign(self.path, name)
                _make_parents(self.path, f"{_STAGING}/{name}")
                _write(staging / name, content)
                self._names.append(name)
        return staging

    def keep(self, stage: str, name: str, content: Any) -> None:
        """Write a file of another stage, which stays even if this stage fails. Raises OutputError."""
        with _os_errors(self.path):
            _write_listed(self.path, stage, name, content)

    def _finish(self) -> None:
        manifest = read_manifest(self.path)
        kept = {stage: names for stage, names in manifest.files.items() if stage in self.onto}
        _remove(self.path, self._files_to_replace(manifest))
        # List files before they appear, so that the manifest knows them after a crash.
        names = dict.fromkeys((*kept.get(self.stage, ()), *self._names))
        manifest = replace(manifest, files=kept | {self.stage: tuple(names)})
        self._save(manifest)
        try:
            for name in self._names:
                staged = self.path / _STAGING / name
                _make_parents(self.path, name)
                if name.startswith(f"{PUBLISH}/"):
                    staged.chmod(public_mode())
                os.replace(staged, self.path / name)
        except BaseException:
            _remove(self.path, self._names)
            self._save(replace(manifest, files=kept))
            raise
        # This order matters: unfinished files count as keyss's only while a stage is running.
        _drop_unfinished(self.path, manifest)
        self._save(replace(manifest, running=None))

    def _give_up(self) -> None:
        """Keep checkpoints to resume from; without any, restore the folder."""
        shutil.rmtree(self.path / _STAGING, ignore_errors=True)
        manifest = read_manifest(self.path)
        if self._has_checkpoints():
            self._save(replace(manifest, running=self._running()))
            return
        _drop_unfinished(self.path, manifest)
        if manifest.files:
            self._save(replace(manifest, running=None))
        else:
            (self.path / MANIFEST).unlink(missing_ok=True)

    def _running(self) -> Running:
        seconds = self.earlier_seconds + time.monotonic() - self._started
        return Running(stage=self.stage, arguments=self.arguments, seconds=seconds)

    def _has_checkpoints(self) -> bool:
        folder = self.path / CHECKPOINTS
        # Names with a leading dot are unfinished files of killed processes.
        return folder.is_dir() and any(not path.name.startswith(".") for path in folder.iterdir())

    def _save(self, manifest: Manifest) -> None:
        write_record(self.path / MANIFEST, manifest)


def check_not_published(path: Path | str) -> None:
    """Raise OutputError for a path in a run's `publish/`, which is given away."""
    real = Path(os.path.realpath(path))
    for folder in (real, *real.parents):
        if folder.name == PUBLISH and (folder.parent / MANIFEST).exists():
            raise OutputError(f"{path} would be given away with everything in {folder}: choose another place")


def clear(folder: Path) -> None:
    """Remove all files that keyss wrote into a folder, then the folder if it is empty."""
    if not (folder / PRIVATE).is_dir():
        return
    with _os_errors(folder):
        with lock(folder / _LOCK, folder):
            manifest = read_manifest(folder)
            _drop_unfinished(folder, manifest)
            _remove(folder, [name for names in manifest.files.values() for name in names])
            (folder / MANIFEST).unlink(missing_ok=True)
        _remove_empty(folder / PRIVATE)
        _remove_empty(folder)


def write_again(folder: Path, stage: str, name: str, content: Any) -> None:
    """Replace a file of a finished stage. Raises OutputError, also if a process works in the folder."""
    make_private(folder / PRIVATE)
    with _os_errors(folder), lock(folder / _LOCK, folder):
        _write_listed(folder, stage, name, content)


def read_manifest(folder: Path) -> Manifest:
    """The manifest of a folder, empty if there is none.

    Raises OutputError if it is damaged or names files outside the folder.
    """
    path = folder / MANIFEST
    if not path.exists():
        return Manifest()
    try:
        manifest = read_record(path, Manifest)
    except InputError as error:
        raise OutputError(
            f"{error}; without it, keyss does not know which files in {folder} it wrote"
        ) from error
    for name in (name for names in manifest.files.values() for name in names):
        listed = PureWindowsPath(name)  # splits at both kinds of slash and knows drives
        if not listed.name or ".." in listed.parts or listed.anchor or "\0" in name or name == MANIFEST:
            raise OutputError(f"{path}: {name!r} is not a file in this folder")
    return manifest


def _drop_unfinished(folder: Path, manifest: Manifest) -> None:
    """Remove checkpoints and unfinished files.

    Raises OutputError if they exist while no stage is running: keyss did not write them.
    """
    for name in (CHECKPOINTS, _STAGING):
        if manifest.running is None and os.path.lexists(folder / name):
            raise OutputError(f"{folder / name} is in the way, and keyss did not write it: move it")
        shutil.rmtree(folder / name, ignore_errors=True)


def _write(path: Path, content: Any) -> None:
    """Write a model, bytes or a record."""
    if isinstance(content, Gaussians):
        write_model(path, content)
    elif isinstance(content, bytes):
        write_bytes(path, content)
    else:
        write_record(path, content)


def _write_listed(folder: Path, stage: str, name: str, content: Any) -> None:
    """Write a file, and list it in the manifest first."""
    _refuse_foreign(folder, name)
    manifest = read_manifest(folder)
    if not any(name in names for names in manifest.files.values()):
        files = {**manifest.files, stage: (*manifest.files.get(stage, ()), name)}
        write_record(folder / MANIFEST, replace(manifest, files=files))
    _make_parents(folder, name)
    _write(folder / name, content)


def make_private(folder: Path) -> None:
    """Make a folder that only its owner can access. Raises OutputError."""
    with _os_errors(folder):
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        folder.chmod(0o700)


def _make_parents(folder: Path, name: str) -> None:
    """Make the parent folders of a file; in `private/`, only the owner can access them."""
    mode = 0o700 if name.startswith(f"{PRIVATE}/") else 0o777
    for parent in reversed(PurePosixPath(name).parents[:-1]):
        (folder / parent).mkdir(mode=mode, exist_ok=True)


def _refuse_foreign(folder: Path, name: str) -> None:
    """Raise OutputError if `name` exists and keyss did not write it."""
    target = folder / name
    if any((folder / parent).is_symlink() for parent in PurePosixPath(name).parents if parent.name):
        raise OutputError(
            f"{target.parent} leads out of {folder}: remove this link, or choose another folder"
        )
    ours = {name for names in read_manifest(folder).files.values() for name in names}
    if os.path.lexists(target) and name not in ours:
        raise OutputError(
            f"{target} is in the way, and keyss did not write it: move it, or choose another folder"
        )


def _remove(folder: Path, names: Collection[str]) -> None:
    """Remove files, then empty parent folders. Links out of `folder` are not followed."""
    for name in names:
        path = folder / name
        parents = list(path.relative_to(folder).parents)[:-1]
        linked = any((folder / parent).is_symlink() for parent in parents)
        if linked or (path.is_dir() and not path.is_symlink()):
            continue
        path.unlink(missing_ok=True)
        for parent in parents:
            _remove_empty(folder / parent)


def _remove_empty(folder: Path) -> None:
    with suppress(OSError):  # missing or not empty
        folder.rmdir()


def _differences(old: dict[str, Any], new: dict[str, Any]) -> dict[str, None]:
    """The innermost fields that differ, in order; equal changes of fields of one name once."""
    changes: dict[str, None] = {}
    for name in sorted({*old, *new}):
        pair = before, now = old.get(name), new.get(name)
        if isinstance(before, dict) and isinstance(now, dict):
            changes |= _differences(before, now)
        elif before != now:
            shown = ["none" if value is None else msgspec.json.encode(value).decode() for value in pair]
            brief = max(map(len, shown)) <= _MAX_SHOWN
            changes[f"{name}: " + (f"{shown[0]} then, {shown[1]} now" if brief else "not the same")] = None
    return changes


@contextmanager
def _os_errors(path: Path) -> Iterator[None]:
    """Turn errors of the system into OutputErrors."""
    try:
        yield
    except OSError as error:
        raise OutputError(f"cannot write to {error.filename or path}: {error.strerror or error}") from error
