"""Which scenes hide which, and what is not Mip-NeRF 360 as it should be."""

from __future__ import annotations

from pathlib import Path

import pytest

from files.scene_files import WIDTH, photo, save, write_colmap
from keyss import load_scene, reproduce
from keyss.core import InputError, UsageError
from keyss.many import paper, reproducing

SHRUNK = WIDTH // 4


def test_every_scene_hides_the_next() -> None:
    groups_of = reproducing.groups_of
    assert groups_of(["a", "b"], 1, (), None) == [("a", "b"), ("b", "a")]
    assert groups_of(["a", "b", "c"], 2, (), None) == [("a", "b", "c"), ("b", "c", "a"), ("c", "a", "b")]


def test_the_papers_scenes_are_those_of_its_tables() -> None:
    pairs, triples = paper.PAPER.pairs, paper.PAPER.triples
    assert tuple(reproducing.BENCHMARK) == (*(cover for cover, _ in pairs), "playroom")
    assert {name for pair in pairs for name in pair} == set(reproducing.BENCHMARK)
    assert {name for triple in triples for name in triple} <= set(reproducing.BENCHMARK)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"table": "singel", "scenes": ["a", "b"]}, "did you mean single"),
        ({"table": "single"}, "at least 2 scenes"),
        ({"table": "single", "scenes": ["a"]}, "at least 2 scenes"),
        ({"table": "multi", "scenes": ["a", "b"]}, "at least 3 scenes"),
        ({"table": "single", "scenes": ["a", "x/a"]}, "different names"),
        ({"table": "single", "scenes": ["a", "b"], "data": "d"}, "leave out the others"),
        ({"table": "single", "scenes": ["a", "b"], "pairs": ["a,c"]}, "no scene is called 'c'"),
        ({"table": "single", "scenes": ["a", "b"], "pairs": ["a"]}, "a cover and 1 secret"),
        ({"table": "multi", "scenes": ["a", "b", "c"], "pairs": ["a,b,b"]}, "different names"),
        ({"table": "single", "scenes": ["a", "b"], "iterations": 0}, "`iterations`"),
        ({"table": "single", "scenes": ["a.ply", "b"]}, "models have none"),
    ],
)
def test_what_cannot_be_is_refused_before_anything_is_written(
    tmp_path: Path, arguments: dict[str, object], words: str
) -> None:
    for dry_run in (True, False):
        with pytest.raises(UsageError, match=words):
            reproduce(**arguments, dry_run=dry_run, out=tmp_path / "out")  # type: ignore[arg-type]
    assert not (tmp_path / "out").exists()


@pytest.fixture
def benchmark(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a scene that is called garden, of 9 photos in `images_4` and of full size in `images`."""
    folder = write_colmap(tmp_path / "data" / "garden", count=9)
    for path in (folder / "images").iterdir():
        save(folder / "images_4" / path.name, photo(0, size=(SHRUNK, 2)))
    monkeypatch.setattr(reproducing, "BENCHMARK", {"garden": (9, "images_4")})
    return tmp_path / "data"


def test_a_benchmark_scene_is_linked(benchmark: Path, tmp_path: Path) -> None:
    scene = load_scene(reproducing.link_scene(benchmark, "garden", tmp_path / "links"))
    assert scene.train[0].camera.width == SHRUNK  # not those of full size
    assert (len(scene.train), len(scene.test)) == (7, 2)
    reproducing.link_scene(benchmark, "garden", tmp_path / "links")  # again


def test_what_is_not_the_benchmark_is_said(
    benchmark: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(InputError, match="expected a folder garden"):
        reproducing.link_scene(tmp_path, "garden", tmp_path / "links")
    images = benchmark / "garden" / "images_4"
    images.rename(images.with_name("images_8"))
    with pytest.raises(InputError, match="images_4"):
        reproducing.link_scene(benchmark, "garden", tmp_path / "links")
    images.with_name("images_8").rename(images)
    monkeypatch.setattr(reproducing, "BENCHMARK", {"garden": (10, "images_4")})
    with pytest.raises(InputError, match="expected 10 photos in the COLMAP model"):
        reproducing.link_scene(benchmark, "garden", tmp_path / "links")
