"""Which scenes hide which, and what is not Mip-NeRF 360 as it should be."""

from __future__ import annotations

from pathlib import Path

import pytest

from files.scene_files import WIDTH, photo, save, write_colmap
from keyss.api import PaperTable, plan_reproduction, reproduce
from keyss.core import InputError, OutputError, UsageError
from keyss.reproduction import scenes
from keyss.reproduction.published import COVERS, PAIRS, TRIPLES
from keyss.reproduction.scenes import BENCHMARK, BenchmarkScene, check_benchmark, groups_of, link_benchmark

SHRUNK = WIDTH // 4


def test_every_scene_hides_the_next() -> None:
    assert groups_of(["a", "b"], 1) == [("a", "b"), ("b", "a")]
    assert groups_of(["a", "b", "c"], 2) == [("a", "b", "c"), ("b", "c", "a"), ("c", "a", "b")]
    for names, secrets in ((["a"], 1), (["a", "b"], 2), ([], 1)):
        with pytest.raises(UsageError, match="at least"):
            groups_of(names, secrets)


def test_the_papers_scenes_are_those_of_its_tables() -> None:
    assert tuple(BENCHMARK) == (*COVERS, "playroom")
    assert {name for pair in PAIRS for name in pair} == set(BENCHMARK)
    assert {name for triple in TRIPLES for name in triple} <= set(BENCHMARK)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"table": "singel", "scenes": ["a", "b"]}, "did you mean single"),
        ({"table": "single"}, "at least 2 scenes"),
        ({"table": "single", "scenes": ["a", "x/a"]}, "different names"),
        ({"table": "single", "scenes": ["a", "b"], "scale": "full"}, "from `data`"),
        ({"table": "single", "scenes": ["a", "b"], "data": "d"}, "scale"),
        ({"table": "single", "scenes": ["a", "b"], "pairs": ["a,c"]}, "no scene is called 'c'"),
        ({"table": "single", "scenes": ["a", "b"], "pairs": ["a"]}, "a cover and 1 secret"),
        ({"table": "multi", "scenes": ["a", "b", "c"], "pairs": ["a,b,b"]}, "different names"),
        ({"table": "single", "scenes": ["a", "b"], "most": 0}, "`most`"),
        ({"table": "single", "scenes": ["a", "b"], "iterations": 0}, "`iterations`"),
        ({"table": "single", "scenes": ["a.ply", "b"]}, "models have none"),
    ],
)
def test_what_cannot_be_is_refused_before_anything_is_written(
    tmp_path: Path, arguments: dict[str, object], words: str
) -> None:
    for verb in (reproduce, plan_reproduction):
        with pytest.raises(UsageError, match=words):
            verb(PaperTable(**arguments), out=tmp_path / "out")  # type: ignore[operator, arg-type]
    assert not (tmp_path / "out").exists()


def test_a_folder_with_something_else_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "mine").write_text("mine")
    with pytest.raises(OutputError, match="something else"):
        reproduce(PaperTable("single", [tmp_path / "a", tmp_path / "b"]), out=tmp_path)


@pytest.fixture
def benchmark(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a scene that is called garden, of 9 photos in `images_4` and of full size in `images`."""
    folder = write_colmap(tmp_path / "data" / "garden", count=9)
    for path in (folder / "images").iterdir():
        save(folder / "images_4" / path.name, photo(0, size=(SHRUNK, 2)))
    monkeypatch.setattr(scenes, "BENCHMARK", {"garden": BenchmarkScene(9, "images_4", SHRUNK)})
    return tmp_path / "data"


def test_a_benchmark_scene_is_linked(benchmark: Path, tmp_path: Path) -> None:
    from keyss import load_scene

    check_benchmark(benchmark, "garden")
    scene = load_scene(link_benchmark(benchmark, "garden", tmp_path / "links"))
    assert scene.train[0].camera.width == SHRUNK  # not those of full size
    assert (len(scene.train), len(scene.test)) == (7, 2)
    link_benchmark(benchmark, "garden", tmp_path / "links")  # again


def test_what_is_not_the_benchmark_is_said(benchmark: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="garden"):
        check_benchmark(tmp_path, "garden")
    images = benchmark / "garden" / "images_4"
    (images / "more.png").write_bytes((images / "00.png").read_bytes())
    with pytest.raises(InputError, match="expected 9 photos, found 10"):
        check_benchmark(benchmark, "garden")
    (images / "more.png").unlink()
    save(images / "00.png", photo(0))
    with pytest.raises(InputError, match="3 pixels wide, found 12"):
        check_benchmark(benchmark, "garden")
    images.rename(images.with_name("images_8"))
    with pytest.raises(InputError, match="images_4"):
        check_benchmark(benchmark, "garden")


def test_another_split_is_said(benchmark: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scenes, "BENCHMARK", {"garden": BenchmarkScene(10, "images_4", SHRUNK)})
    with pytest.raises(InputError, match="expected 10 photos in the COLMAP model"):
        link_benchmark(benchmark, "garden", tmp_path / "links")
