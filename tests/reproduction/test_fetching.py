"""A file over HTTP, from a server on this machine: whole or not at all, whatever the server does."""

from __future__ import annotations

import hashlib
import json
import random
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from keyss.core import InputError, OutputError
from keyss.reproduction import fetching
from keyss.reproduction.fetching import fetch
from reproduction.file_server import Behaviour, serving

DATA = random.Random(0).randbytes(300_000)
SUM = hashlib.sha256(DATA).hexdigest()


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch) -> Iterator[Behaviour]:
    monkeypatch.setattr(fetching, "PAUSE", 0.0)
    monkeypatch.setattr(fetching, "CHUNK", 1 << 12)
    with serving(DATA) as found:
        yield found


def got(server: Behaviour, path: Path, expected: str | None = None, most: int = 10**6) -> str:
    return fetch(server.url, path, expected=expected, most=most, note=lambda line: None)


def test_a_file_comes_whole_and_once(server: Behaviour, tmp_path: Path) -> None:
    path = tmp_path / "scenes.zip"
    assert got(server, path) == SUM
    assert path.read_bytes() == DATA
    assert list(tmp_path.iterdir()) == [path]
    assert got(server, path, SUM) == SUM
    assert len(server.asked) == 1


def test_a_lost_connection_is_gone_on_with(server: Behaviour, tmp_path: Path) -> None:
    server.drops = [100_000, 50_000]
    assert got(server, tmp_path / "scenes.zip") == SUM
    assert server.asked == [None, "bytes=100000-", "bytes=150000-"]
    assert (tmp_path / "scenes.zip").read_bytes() == DATA


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(st.integers(0, 120_000), max_size=6), st.booleans(), st.booleans())
def test_wherever_connections_go_the_file_is_whole(
    server: Behaviour, tmp_path: Path, drops: list[int], ranges: bool, etag: bool
) -> None:
    server.drops, server.ranges, server.etag = list(drops), ranges, '"1"' if etag else None
    path = tmp_path / "scenes.zip"
    for each in tmp_path.iterdir():
        each.unlink()
    for _ in range(4):
        with suppress(InputError):  # too many in a row that brought nothing
            assert got(server, path) == SUM
            break
        assert not path.exists()
    assert path.read_bytes() == DATA


def interrupted(server: Behaviour, folder: Path) -> Path:
    """Where `scenes.zip` is to be, of which the first 100,000 bytes are there."""
    server.drops, path = [100_000, *[0] * fetching.TRIES], folder / "scenes.zip"
    with pytest.raises(InputError, match="same command"):
        got(server, path)
    assert (folder / "scenes.zip.part").stat().st_size == 100_000
    server.asked.clear()
    return path


def test_another_process_goes_on(server: Behaviour, tmp_path: Path) -> None:
    path = interrupted(server, tmp_path)
    assert got(server, path) == SUM
    assert server.asked == ["bytes=100000-"]
    assert path.read_bytes() == DATA


def test_what_a_killed_process_wrote_after_its_last_word_is_not_trusted(
    server: Behaviour, tmp_path: Path
) -> None:
    path = interrupted(server, tmp_path)
    with (tmp_path / "scenes.zip.part").open("ab") as part:
        part.write(b"half a block")
    assert got(server, path) == SUM
    assert server.asked == ["bytes=100000-"]


@pytest.mark.parametrize("damage", ["part", "record", "other"])
def test_what_is_not_what_it_was_is_fetched_again(server: Behaviour, tmp_path: Path, damage: str) -> None:
    path = interrupted(server, tmp_path)
    part, record = tmp_path / "scenes.zip.part", tmp_path / "scenes.zip.part.json"
    if damage == "part":
        part.write_bytes(b"x" + part.read_bytes()[1:])
    elif damage == "record":
        record.write_text("{")
    else:
        record.write_text(json.dumps(json.loads(record.read_text()) | {"url": "http://other"}))
    assert got(server, path) == SUM
    assert server.asked == [None]


def test_a_file_that_changed_meanwhile_is_fetched_anew(server: Behaviour, tmp_path: Path) -> None:
    path = interrupted(server, tmp_path)
    server.data, server.etag = DATA[::-1], '"2"'
    got(server, path)
    assert path.read_bytes() == DATA[::-1]
    path.unlink()
    path = interrupted(server, tmp_path)
    server.data = DATA[:50_000]  # so that there is no such range
    got(server, path)
    assert path.read_bytes() == DATA[:50_000]


def test_a_server_that_gives_another_part_is_not_believed(server: Behaviour, tmp_path: Path) -> None:
    path = interrupted(server, tmp_path)
    server.shift = 7
    assert got(server, path) == SUM
    assert server.asked == ["bytes=100000-", None]


def test_one_that_is_busy_is_asked_again_and_others_not(server: Behaviour, tmp_path: Path) -> None:
    server.statuses = [503, 429, 500]
    assert got(server, tmp_path / "a") == SUM
    server.statuses = [404]
    with pytest.raises(InputError, match="404"):
        got(server, tmp_path / "b")
    server.statuses = [503] * 99
    with pytest.raises(InputError, match=r"503.*or put the file at"):
        got(server, tmp_path / "c")


def test_what_is_too_large_or_endless_is_refused(server: Behaviour, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"at most 1,000 bytes, found 300,000"):
        got(server, tmp_path / "a", most=1000)
    server.length = False
    with pytest.raises(InputError, match="size"):
        got(server, tmp_path / "b")
    server.length, server.more = True, b"more"
    assert got(server, tmp_path / "c") == SUM  # no byte after the end is read
    assert not (tmp_path / "a").exists()


def test_another_checksum_than_before_is_said(server: Behaviour, tmp_path: Path) -> None:
    path, other = tmp_path / "scenes.zip", "0" * 64
    for _ in range(2):  # fetched again, and refused again
        with pytest.raises(InputError, match=f"{other}.*{SUM}"):
            got(server, path, other)
        assert not path.exists()
    assert server.asked == [None, None]
    path.write_bytes(DATA)
    with pytest.raises(InputError, match="first seen"):
        got(server, path, other)
    assert path.exists()


def test_no_server_leads_to_files_of_this_machine(server: Behaviour, tmp_path: Path) -> None:
    secret = tmp_path / "secret"
    secret.write_bytes(b"mine")
    for location in (secret.as_uri(), "ftp://127.0.0.1/secret", "data:text/plain,mine"):
        server.location = location
        with pytest.raises(InputError):
            got(server, tmp_path / "a")
    assert not (tmp_path / "a").exists()
    with pytest.raises(InputError):
        fetch(secret.as_uri(), tmp_path / "a", most=10**6, note=lambda line: None)


def test_without_a_network_it_is_said_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fetching, "PAUSE", 0.0)
    for url in ("http://no-such-host.invalid/a.zip", "http://127.0.0.1:9/a.zip"):
        with pytest.raises(InputError, match="or put the file at"):
            fetch(url, tmp_path / "a.zip", most=10**6, note=lambda line: None)


def test_a_full_disk_is_refused_before_it_is_full(
    server: Behaviour, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fetching, "_SPARE", 1 << 60)
    with pytest.raises(OutputError, match="free space"):
        got(server, tmp_path / "a")


def test_ctrl_c_keeps_what_came(server: Behaviour, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, count, write = tmp_path / "scenes.zip", [0], fetching._write

    def pressed(file: object, block: bytes) -> None:
        count[0] += 1
        if count[0] == 5:
            raise KeyboardInterrupt
        write(file, block)  # type: ignore[arg-type]

    monkeypatch.setattr(fetching, "_write", pressed)
    with pytest.raises(KeyboardInterrupt):
        got(server, path)
    monkeypatch.setattr(fetching, "_write", write)
    assert got(server, path) == SUM
    assert server.asked == [None, f"bytes={4 << 12}-"]
