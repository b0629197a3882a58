"""`keyss view`."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from cli.harness import Run, assert_refused
from keyss.core import Gaussians
from keyss.files import read_model, write_model
from tiny_scenes import random_gaussians


def test_invalid_models(keyss: Run, tmp_path: Path) -> None:
    (tmp_path / "model.txt").write_text("not a model")
    (tmp_path / "text.ply").write_text("ply\nformat ascii 1.0\nelement vertex 1\nend_header\n")
    write_model(tmp_path / "cut.ply", random_gaussians(5))
    (tmp_path / "cut.ply").write_bytes((tmp_path / "cut.ply").read_bytes()[:-1])
    for name in ("cut.spz", "cut.sog", "cut.splat", "cut.compressed.ply"):
        write_model(tmp_path / name, random_gaussians(5))
        (tmp_path / name).write_bytes((tmp_path / name).read_bytes()[:-1])
        assert_refused(keyss("view", tmp_path / name, "-o", tmp_path / "page.html"), 4, "not a whole")
    for command in (["view"], ["view", "-o", str(tmp_path / "page.html")]):
        assert_refused(keyss(*command, str(tmp_path / "model.txt")), 4, "expected a 3DGS model")
        assert_refused(keyss(*command, str(tmp_path / "text.ply")), 4, "not a 3DGS model")
        assert_refused(keyss(*command, str(tmp_path / "cut.ply")), 4, "; download or copy it again")
        assert_refused(keyss(*command, str(tmp_path / "nowhere.ply")), 4, "nowhere.ply does not exist")
        assert_refused(keyss(*command, str(tmp_path)), 4, "found a folder")
    assert_refused(keyss("view", str(tmp_path / "model.txt"), "--port", "70000"), 2, "--port")
    assert_refused(keyss("view", str(tmp_path / "model.txt"), "--pose", "1,2,3"), 2, "--pose: expected eye=")


def test_unsupported_formats_are_converted(keyss: Run, tmp_path: Path) -> None:
    text = write_in_text(tmp_path / "text.ply", random_gaussians(5))
    gltf = tmp_path / "scene.glb"
    write_model(gltf, random_gaussians(5))
    for model, name in ((text, "text.ply"), (gltf, "scene.ply")):
        out = tmp_path / f"{name}-page"
        result = keyss("view", model, "-o", out)
        assert result.status == 0, result.err
        assert f"the page does not read {'a .ply in text' if model == text else 'a .glb'}" in result.err
        assert read_model(out / name).digest() == read_model(model).digest()


def write_in_text(path: Path, model: Gaussians) -> Path:
    write_model(path, model)
    header, _, rows = path.read_bytes().partition(b"end_header\n")
    values = np.frombuffer(rows, "<f4").reshape(len(model), -1)
    lines = "\n".join(" ".join(f"{each:.9g}" for each in row) for row in values)
    path.write_bytes(header.replace(b"binary_little_endian", b"ascii") + f"end_header\n{lines}\n".encode())
    return path


def test_page_output(keyss: Run, tmp_path: Path) -> None:
    write_model(tmp_path / "model.ply", random_gaussians(5))
    out = tmp_path / "page.html"
    result = keyss("view", tmp_path / "model.ply", "-o", out)
    assert result.status == 0, result.err
    assert result.out == f"{out}: {out.stat().st_size / 1e6:.1f} MB; opens in any browser\n"
    assert_refused(keyss("view", tmp_path / "model.ply", "-o", out), 5, "--overwrite")
