"""Pairs of scenes."""

from __future__ import annotations

from pathlib import Path

import pytest

from keyss import reproduce
from keyss.core import UsageError
from keyss.lab.many import reproduction


def test_groups_are_cyclic_by_default() -> None:
    groups_of = reproduction.groups_of
    assert groups_of(["a", "b"], 1, (), ()) == [("a", "b"), ("b", "a")]
    assert groups_of(["a", "b", "c"], 2, (), ()) == [("a", "b", "c"), ("b", "c", "a"), ("c", "a", "b")]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"table": "singel", "scenes": ["a", "b"]}, "did you mean single"),
        ({"table": "single"}, "at least 2 scenes"),
        ({"table": "single", "scenes": ["a"]}, "at least 2 scenes"),
        ({"table": "multi", "scenes": ["a", "b"]}, "at least 3 scenes"),
        ({"table": "single", "scenes": ["a", "x/a"]}, "different names"),
        ({"table": "single", "scenes": ["a", "b"], "full": True}, "a scene called 'bicycle', got a, b"),
        ({"table": "single", "scenes": ["a", "b"], "pairs": ["a,c"]}, "a scene called 'c', got a, b"),
        ({"table": "single", "scenes": ["a", "b"], "pairs": ["a"]}, "a cover and 1 secret"),
        ({"table": "multi", "scenes": ["a", "b", "c"], "pairs": ["a,b,b"]}, "different names"),
        ({"table": "single", "scenes": ["a", "b"], "iterations": 0}, "`iterations`"),
        ({"table": "single", "scenes": ["a.ply", "b"]}, "models have none"),
    ],
)
def test_invalid_arguments_write_nothing(tmp_path: Path, arguments: dict[str, object], words: str) -> None:
    for dry_run in (True, False):
        with pytest.raises(UsageError, match=words):
            reproduce(**arguments, dry_run=dry_run, out=tmp_path / "out")  # type: ignore[arg-type]
    assert not (tmp_path / "out").exists()
