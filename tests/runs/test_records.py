"""JSON records."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path

import pytest

from keyss.core import InputError
from keyss.runs import read_record, record_bytes, write_record


@dataclass(frozen=True)
class Scores:
    values: tuple[float, ...]
    best: float | None


@dataclass(frozen=True, kw_only=True)
class Record:
    version: int = 3
    name: str
    scores: dict[str, Scores]
    note: str | None = None


RECORD = Record(name="Füchse 狐", scores={"a": Scores((1.5, 2.0), None), "b": Scores((), 0.1)})


def test_round_trip(tmp_path: Path) -> None:
    write_record(tmp_path / "record.json", RECORD)
    assert read_record(tmp_path / "record.json", Record) == RECORD
    assert json.loads((tmp_path / "record.json").read_text())["version"] == 3


def test_undecodable_file_names() -> None:
    """Python represents undecodable bytes by surrogates."""
    name = "Füchse".encode().decode("ascii", "surrogateescape") + b"\xff".decode("utf-8", "surrogateescape")
    data = record_bytes(Record(name=name, scores={name: Scores((1.0, math.nan), None)}))
    assert json.loads(data)["scores"]["Füchse\ufffd"]["values"] == [1.0, None]
    assert list(json.loads(data)["scores"]) == [json.loads(data)["name"]] == ["Füchse\ufffd"]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", "truncated"),
        ("{", "truncated"),
        ("[]", "Expected `object`"),
        ("{}", "`version`"),
        ('{"version": 2}', "expected version 3, got 2"),
        ('{"version": "3"}', r"at `\$\.version`"),
        ('{"version": true}', r"at `\$\.version`"),
        ('{"version": ' + 5000 * "1" + "}", "version"),
        ('{"version": 3}', "`name`"),
        ('{"version": 3, "name": 1, "scores": {}}', r"Expected `str`, got `int` - at `\$\.name`"),
        ('{"version": 3, "name": "n", "scores": {"a": {"values": [null], "best": 1}}}', r"values\[0\]"),
        ('{"version": 3, "name": "n", "scores": {"a": {"values": ["1"], "best": 1}}}', r"values\[0\]"),
        ('{"version": 3, "name": "n", "scores": {"a": {"values": [NaN], "best": 1}}}', "malformed"),
        ('{"version": 3, "name": "\\ud83e", "scores": {}}', "surrogate|malformed"),
        ('{"version": 3, "name": "n", "scores": ' + 100_000 * "[", "expected a record"),
        ('{"version": 3, "a": ' + 100_000 * "[", "expected a record"),
        (b"\xff\xfe\x00", "malformed"),
        (b'{"version": 3, "name": "\xff", "scores": {}}', "expected a record"),
    ],
    ids=lambda value: repr(value)[:20],
)
def test_invalid_records(tmp_path: Path, text: str | bytes, expected: str) -> None:
    path = tmp_path / "record.json"
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    with pytest.raises(InputError, match=expected) as raised:
        read_record(path, Record)
    assert str(path) in str(raised.value)


def test_missing_and_large_files(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="expected a file, found nothing"):
        read_record(tmp_path / "record.json", Record)
    with open(tmp_path / "record.json", "wb") as file:
        file.truncate((16 << 20) + 1)
    with pytest.raises(InputError, match="at most 16,777,216 bytes"):
        read_record(tmp_path / "record.json", Record)
