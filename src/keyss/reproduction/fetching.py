"""A large file over HTTP: gone on with where it stopped, and held against the checksum that it had before."""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import socket
import time
from collections.abc import Callable
from dataclasses import dataclass
from http.client import HTTPException, HTTPResponse
from pathlib import Path
from typing import IO, Any
from urllib import request
from urllib.error import HTTPError, URLError

from keyss._version import __version__
from keyss.core.errors import InputError, OutputError
from keyss.runs.records import read_record, write_record

SECONDS = 60.0  # without a byte
TRIES = 4  # one after the other that bring nothing
PAUSE = 2.0  # seconds before another one
CHUNK = 1 << 20  # bytes
_SAVED_EVERY = 1 << 28  # bytes
_RANGE = re.compile(r"bytes (\d{1,15})-\d{1,15}/(\d{1,15})")
_SPARE = 1 << 28  # bytes of disk that are left alone

Note = Callable[[str], None]  # a line on how far it is


@dataclass(frozen=True, kw_only=True)
class _Part:
    """What of a file is there, so that going on with it goes on with the same."""

    version: int = 1
    url: str
    bytes: int = 0
    sha256: str = ""  # of these
    total: int | None = None
    validator: str | None = None  # of the server's, by which it knows the file


class _Lost(Exception):
    """The connection went; another one may do better."""


class _Download:
    """A file on its way: `path.part`, and beside it what is known of it."""

    def __init__(self, url: str, path: Path, most: int, note: Note) -> None:
        self.url, self.most, self.note = url, most, note
        self.advice = f"what came of it is kept, and the same command goes on; or put the file at {path}"
        self.name, self.file = path.name, path.with_name(f"{path.name}.part")
        self.record = path.with_name(f"{path.name}.part.json")
        self.state, self.hash = self._before()

    def _before(self) -> tuple[_Part, Any]:
        """What is there; nothing where it is not what it was."""
        try:
            state = read_record(self.record, _Part)
            if state.url == self.url and self.file.stat().st_size >= state.bytes:
                os.truncate(self.file, state.bytes)  # what came after it was last written down
                found = _hashed(self.file)
                if found.hexdigest() == state.sha256:
                    return state, found
        except (InputError, OSError):
            pass
        return _Part(url=self.url), hashlib.sha256()

    def receive(self) -> bool:
        """Whether all of it is there after one more connection. Raises _Lost, InputError, OutputError."""
        if self.state.bytes == self.state.total:
            return True
        asked = request.Request(self.url, headers={"User-Agent": f"keyss/{__version__}"})
        if self.state.bytes and self.state.validator:
            asked.add_header("Range", f"bytes={self.state.bytes}-")
            asked.add_header("If-Range", self.state.validator)
        try:
            with _opener().open(asked, timeout=SECONDS) as response:
                self._begin(response)
                self._take(response)
        except HTTPError as error:
            error.close()
            if error.code == 416:  # there is no such range: it is not the file that it was
                self._restart()
                raise _Lost("the file has changed") from error
            if error.code == 429 or error.code >= 500:
                raise _Lost(f"HTTP status {error.code}") from error
            raise InputError(f"{self.url}: the server answers {error.code} {error.reason}") from error
        except (URLError, OSError, HTTPException) as error:
            reason = error.reason if isinstance(error, URLError) else error
            if isinstance(reason, socket.gaierror):
                raise InputError(f"{self.url}: cannot be reached: {reason}; {self.advice}") from error
            raise _Lost(f"{reason}" or type(reason).__name__) from error
        return self.state.bytes == self.state.total

    def _begin(self, response: HTTPResponse) -> None:
        """Where the answer goes on. Raises InputError for what is too large or of no known size."""
        validator = response.headers.get("ETag")
        validator = (
            response.headers.get("Last-Modified") if (validator or "W/").startswith("W/") else validator
        )
        if response.status == 206:
            found = _RANGE.fullmatch(response.headers.get("Content-Range", ""))
            if found is None or (int(found[1]), int(found[2])) != (self.state.bytes, self.state.total):
                self._restart()
                raise _Lost("the server gives another part than was asked for")
            return
        self._restart()
        length = response.headers.get("Content-Length", "")
        if not re.fullmatch(r"\d{1,15}", length):
            raise InputError(f"{self.url}: expected a file whose size the server tells, found none")
        if int(length) > self.most:
            raise InputError(f"{self.url}: expected at most {self.most:,} bytes, found {int(length):,}")
        self.state = _Part(url=self.url, total=int(length), validator=validator)

    def _restart(self) -> None:
        self.state, self.hash = _Part(url=self.url), hashlib.sha256()

    def _take(self, response: IO[bytes]) -> None:
        """Write all that comes, and down how far it came, whatever happens. Raises OutputError."""
        start, said = self.state, time.monotonic()
        total, done = start.total or 0, start.bytes
        free = shutil.disk_usage(self.file.parent).free
        if free < total - done + _SPARE:
            raise OutputError(
                f"{self.file.parent}: expected {(total - done + _SPARE) / 1e9:.1f} GB of free space for "
                f"{self.name}, found {free / 1e9:.1f} GB"
            )
        saved = done
        with _written(self.file, "r+b" if done else "wb") as file:
            file.seek(done)
            try:
                # One byte more than there should be would not go unnoticed.
                while block := response.read(min(CHUNK, total - done + 1)):
                    if done + len(block) > total:
                        raise InputError(f"{self.url}: expected {total:,} bytes, the server sends more")
                    _write(file, block)
                    self.hash.update(block)
                    done += len(block)
                    if done - saved >= _SAVED_EVERY:
                        saved = done
                        self._save(file, start, done)
                    if time.monotonic() - said > 10:
                        said = time.monotonic()
                        self.note(f"{self.name}: {done / 1e9:.2f} of {total / 1e9:.2f} GB")
            finally:
                self._save(file, start, done)

    def _save(self, file: IO[bytes], start: _Part, done: int) -> None:
        """Raises OutputError."""
        try:
            file.flush()
            os.fsync(file.fileno())
        except OSError as error:
            raise OutputError(f"cannot write to {self.file}: {error.strerror}") from error
        digest = self.hash.hexdigest()
        self.state = _Part(
            url=self.url, bytes=done, sha256=digest, total=start.total, validator=start.validator
        )
        write_record(self.record, self.state)


def fetch(url: str, path: Path, *, expected: str | None = None, most: int, note: Note) -> str:
    """The SHA-256 of the file at `url`, which is at `path` afterwards.

    What is there is not fetched again, and what was interrupted is gone on with, if the server still has the
    same file. `expected`: the checksum that it must have. `most`: bytes. Raises InputError for a server that
    cannot be reached, and for another checksum; OutputError.
    """
    if path.exists():
        try:
            digest = _hashed(path).hexdigest()
        except OSError as error:
            raise InputError(f"{path}: cannot be read: {error.strerror}") from error
        _check(path, digest, expected)
        return str(digest)
    part, fruitless = _Download(url, path, most, note), 0
    while True:
        before = part.state.bytes
        try:
            if part.receive():
                break
            raise _Lost("the connection ended early")
        except _Lost as error:
            fruitless = 0 if part.state.bytes > before else fruitless + 1
            if fruitless == TRIES:
                raise InputError(f"{url}: cannot be fetched: {error}; {part.advice}") from error
        time.sleep(PAUSE * fruitless)
    digest = part.hash.hexdigest()
    try:
        _check(part.file, digest, expected)
    except InputError:
        part.record.unlink(missing_ok=True)  # so that it is not gone on with
        raise
    try:
        part.file.rename(path)
        part.record.unlink(missing_ok=True)
    except OSError as error:
        raise OutputError(f"cannot write to {path}: {error.strerror}") from error
    return str(digest)


class _Redirects(request.HTTPRedirectHandler):
    def redirect_request(
        self, req: request.Request, fp: Any, code: Any, msg: Any, headers: Any, newurl: str
    ) -> Any:
        if req.type == "https" and not newurl.startswith("https:"):
            raise URLError(f"it is moved to {newurl}, which is less safe")
        return super().redirect_request(req, fp, code, msg, headers, newurl)


def _opener() -> request.OpenerDirector:
    """For HTTP and HTTPS alone: no files, no FTP, wherever a server points to."""
    found = request.OpenerDirector()
    for handler in (
        request.ProxyHandler(),
        request.UnknownHandler(),
        request.HTTPHandler(),
        request.HTTPSHandler(),
        request.HTTPDefaultErrorHandler(),
        _Redirects(),
        request.HTTPErrorProcessor(),
    ):
        found.add_handler(handler)
    return found


def _check(path: Path, found: str, expected: str | None) -> None:
    if expected is not None and found != expected:
        raise InputError(
            f"{path}: expected the SHA-256 {expected}, as when it was first seen, found {found}; if you "
            "trust what is there now, remove the line in SHA256SUMS beside it, else the file"
        )


def _hashed(path: Path) -> Any:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256")


def _written(path: Path, mode: str) -> IO[bytes]:
    try:
        return path.open(mode)
    except OSError as error:
        raise OutputError(f"cannot write to {path}: {error.strerror}") from error


def _write(file: IO[bytes], block: bytes) -> None:
    try:
        file.write(block)
    except OSError as error:  # which is no connection that went
        raise OutputError(f"cannot write to {file.name}: {error.strerror}") from error
