"""Methods side by side: one table, resumed where it was, and a sentence where something is not possible."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from PIL import Image

from keyss._verbs import comparing
from keyss._verbs.comparing import EVERY, within
from keyss._verbs.shared_folder import alone_in
from keyss.cli import main
from keyss.core import OutputError, UsageError
from keyss.methods import registry
from keyss.methods.plain_models import Bound
from test_api import write_nerfstudio
from tiny_scenes import tiny_scene

SMALL = ["--iterations", "60", "--max-gaussians", "150", "--seed", "3"]


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    root = tmp_path_factory.mktemp("scenes")
    return write_nerfstudio(root / "a", tiny_scene(0)), write_nerfstudio(root / "b", tiny_scene(1))


def test_a_table_a_picture_and_a_second_start(
    folders: tuple[Path, Path],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    out = tmp_path / "compared"
    names = "3dgs,3dgs-sh,watergs,learned"
    command = ["compare", "--cover", str(folders[0]), "--secret", str(folders[1]), *SMALL, "-o", str(out)]
    assert main([*command, "--methods", names, "--dry-run"]) == 0
    assert not out.exists()
    assert "7 to do" in capsys.readouterr().out  # four plain models and three methods
    assert main([*command, "--methods", "3dgs,3dgs-sh"]) == 0
    first = (out / "3dgs-sh" / "publish" / "stego.ply").stat().st_mtime_ns
    before = json.loads((out / "3dgs-sh.json").read_text())
    older = {"version": 1, "name": "3dgs-sh", "cover": {"pruned_loss": None}}
    (out / "3dgs-sh.json").write_text(json.dumps(older))  # of a version that measured other things
    untouched = (out / "3dgs.json").stat().st_mtime_ns
    capsys.readouterr()
    assert main([*command, "--methods", names]) == 5
    assert "--resume" in capsys.readouterr().err
    assert main([*command, "--methods", names, "--resume", "--width", "20"]) == 5
    assert main([*command, "--methods", names, "--resume"]) == 0
    assert (out / "3dgs-sh" / "publish" / "stego.ply").stat().st_mtime_ns == first  # not again
    assert (out / "3dgs.json").stat().st_mtime_ns == untouched
    again = json.loads((out / "3dgs-sh.json").read_text())  # measured again, to the same numbers
    timed = ("measuring_seconds", "cover", "secret")
    assert {k: v for k, v in again.items() if k not in timed} == {
        k: v for k, v in before.items() if k not in timed
    }
    said = capsys.readouterr().out
    assert "learned: not possible" in said  # so small a cover has no room
    found = json.loads((out / "comparison.json").read_text())
    rows = {row["name"]: row for row in found["methods"]}
    assert list(rows) == names.split(",")
    assert "any" in rows["learned"]["error"]
    assert rows["3dgs"]["cover"]["psnr"] >= rows["watergs"]["cover"]["psnr"] - 1
    assert rows["3dgs-sh"]["handed_bytes"] > rows["3dgs-sh"]["gaussians"] * 16 * 3 * 4
    assert {rows[name]["capabilities"]["keys"] for name in ("3dgs", "3dgs-sh")} == {False}
    assert rows["watergs"]["capabilities"]["keys"]
    assert {tuple(rows[name]["trained"]) for name in names.split(",")[:3]} == {(60, 60)}
    tried = {
        name: {each["change"]: each for each in rows[name]["survival"] if not each["skipped"]}
        for name in rows
    }
    # What is handed over belongs to every row, and that of `3dgs` lies elsewhere.
    assert tried["3dgs-sh"]["pruned"]["secret_loss"] is None
    assert {"pruned", ".spz", "purified"} <= set(tried["3dgs"])  # and splat-transform's, where it is there
    assert [each["secret_loss"] for each in tried["3dgs"].values()] == pytest.approx([0] * len(tried["3dgs"]))
    # What `3dgs` publishes is the plain model that others are held against.
    secrecy = rows["3dgs"]["secrecy"]
    for figure in ("classifier", "stealth", "stegexpose"):
        assert secrecy[figure] == secrecy[f"{figure}_plain"]
    assert {each["reader"] for each in rows["watergs"]["readers"]} == {"plyfile", "gsply", "splat-transform"}
    assert all(each["loads"] for each in rows["watergs"]["readers"] if each["loads"] is not None)
    capsys.readouterr()
    assert main([*command, "--methods", names, "--dry-run"]) == 0
    said = capsys.readouterr().out
    assert "0 to do" in said
    assert "learned: " in said
    text = (out / "comparison.md").read_text()
    assert text.count("\n## ") + text.startswith("## ") == 2
    assert "- learned: not possible" in text
    with Image.open(out / "comparison.png") as picture:
        assert picture.height > 4 * 200  # photos and three methods
    assert (out / "key.txt").stat().st_mode & 0o77 == 0


@pytest.mark.parametrize("name", registry.METHODS)
@pytest.mark.parametrize("iterations", [61, 3000])
def test_every_scene_is_drawn_as_often_by_every_method(name: str, iterations: int) -> None:
    for preset in registry.METHODS[name].presets.values():
        options, plain = within(iterations, preset)
        trained = [Bound.of(each, own).steps for each, own in zip(options.training(2), plain, strict=True)]
        assert trained == [iterations] * 2


def test_what_it_does_not_know_is_refused(folders: tuple[Path, Path], tmp_path: Path) -> None:
    from keyss.api import compare

    for methods, words in ((["3dgs", "learnt"], "learnt"), (["learned:worst"], "worst")):
        with pytest.raises(UsageError, match=words):
            compare(*folders, methods=methods, out=tmp_path / "out")
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "a").write_text("mine")
    with pytest.raises(OutputError, match="something else"):
        compare(*folders, out=tmp_path / "mine")
    with pytest.raises(UsageError, match="models have none"):
        compare(tmp_path / "a.ply", folders[1], out=tmp_path / "out")
    assert not (tmp_path / "out").exists()
    assert set(registry.METHODS) >= {"3dgs", "3dgs-sh", "3dgs-decoder", "gs-hider", "watergs"}


def test_where_no_method_works_the_reasons_are_said_and_there_is_no_picture(
    folders: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*arguments: object, **more: object) -> None:
        raise OutputError("the disk is full")

    monkeypatch.setattr(comparing, "hide", full)
    sizes = {"iterations": 20, "max_gaussians": 100, "seed": 1}
    found = comparing.compare(*folders, methods=["3dgs"], out=tmp_path / "out", **sizes)  # type: ignore[arg-type]
    assert [each.error for each in found.methods] == ["the disk is full"]
    assert "the disk is full" in (tmp_path / "out" / "comparison.md").read_text()
    assert not (tmp_path / "out" / "comparison.png").exists()


def test_one_budget_and_one_process_for_a_folder(
    folders: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without numbers the budget is that of the first method's preset."""
    monkeypatch.setattr(comparing, "_PlainModels", None)  # so that it ends before anything is trained
    out = tmp_path / "out"
    with pytest.raises(TypeError):
        comparing.compare(*folders, methods=["learned:quick"], out=out)
    with pytest.raises(OutputError, match="other arguments"):
        comparing.compare(*folders, methods=["carry"], out=out, resume=True)
    with pytest.raises(TypeError):
        comparing.compare(*folders, methods=["carry:quick"], out=out, resume=True)
    with alone_in(out), pytest.raises(OutputError, match="is at work"):
        comparing.compare(*folders, methods=["carry:quick"], out=out, resume=True)


def test_all_is_every_method_and_keyss_as_published() -> None:
    assert set(EVERY) == {*registry.METHODS, "learned:paper"}
    assert len(EVERY) == len(set(EVERY))
    for name in EVERY:  # `paper` is not the first, so that it is another row
        method, _, preset = name.partition(":")
        assert preset in ("", *list(registry.METHODS[method].presets)[1:])
