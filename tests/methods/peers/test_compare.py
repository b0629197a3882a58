"""Methods side by side: one table, resumed where it was, and a sentence where something is not possible."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from PIL import Image

from keyss.cli import main
from keyss.core import OutputError, UsageError
from keyss.methods import registry
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
    assert main([*command, "--methods", "3dgs,3dgs-sh"]) == 0
    first = (out / "3dgs-sh" / "publish" / "stego.ply").stat().st_mtime_ns
    capsys.readouterr()
    assert main([*command, "--methods", names]) == 5
    assert "--resume" in capsys.readouterr().err
    assert main([*command, "--methods", names, "--resume", "--width", "20"]) == 5
    assert main([*command, "--methods", names, "--resume"]) == 0
    assert (out / "3dgs-sh" / "publish" / "stego.ply").stat().st_mtime_ns == first  # not again
    said = capsys.readouterr().out
    assert "learned: not possible" in said  # so small a cover has no room
    found = json.loads((out / "comparison.json").read_text())
    rows = {row["name"]: row for row in found["methods"]}
    assert list(rows) == names.split(",")
    assert "any" in rows["learned"]["error"]
    assert rows["3dgs"]["cover"]["psnr"] >= rows["watergs"]["cover"]["psnr"] - 1
    assert rows["3dgs-sh"]["handed_bytes"] > rows["3dgs-sh"]["gaussians"] * 16 * 3 * 4
    assert rows["3dgs-sh"]["secret"]["pruned_loss"] is None  # what is handed over belongs to every row
    assert rows["3dgs"]["secret"]["pruned_loss"] == pytest.approx(0)
    assert {rows[name]["capabilities"]["keys"] for name in ("3dgs", "3dgs-sh")} == {False}
    assert rows["watergs"]["capabilities"]["keys"]
    lines = (out / "comparison.md").read_text().splitlines()
    assert len(lines) == 2 + len(rows)
    assert len({line.count("|") for line in lines}) == 1
    with Image.open(out / "comparison.png") as picture:
        assert picture.height > 4 * 240 * 30 / 40  # photos and three methods
    assert (out / "key.txt").stat().st_mode & 0o77 == 0


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
