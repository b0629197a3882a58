"""`keyss view` and `keyss export-html`: what they refuse, and what they say."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from cli.said import Said, assert_refused
from keyss.files.ply import write_ply
from tiny_scenes import random_gaussians


def test_what_the_page_cannot_show_is_refused(keyss: Callable[..., Said], tmp_path: Path) -> None:
    (tmp_path / "model.glb").write_bytes(b"glTF")
    for command in (["view"], ["export-html", "-o", str(tmp_path / "page.html")]):
        assert_refused(keyss(*command, str(tmp_path / "model.glb")), 2, "keyss convert")
        assert_refused(keyss(*command, str(tmp_path / "nowhere.ply")), 4, "found nothing")
    assert_refused(keyss("view", str(tmp_path / "model.glb"), "--port", "70000"), 2, "--port")


def test_a_page_is_written_and_not_over_another(keyss: Callable[..., Said], tmp_path: Path) -> None:
    write_ply(tmp_path / "model.ply", random_gaussians(5))
    out = tmp_path / "page.html"
    said = keyss("export-html", tmp_path / "model.ply", "-o", out)
    assert said.status == 0, said.err
    assert said.out == f"{out}: {out.stat().st_size / 1e6:.1f} MB; opens in any browser\n"
    assert_refused(keyss("export-html", tmp_path / "model.ply", "-o", out), 5, "--overwrite")
