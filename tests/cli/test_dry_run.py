"""Hiding, revealing, rendering, measuring and describing, one after the other."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

from cli.harness import SMALL, Result, Run, assert_refused, listing
from keyss.files import read_model


class TestTheWholePath:
    def test_reveal_render_evaluate_info(self, keyss: Run, workspace: Path, tmp_path: Path) -> None:
        secret, images, key = tmp_path / "secret.ply", tmp_path / "images", workspace / "key.txt"
        result = keyss(
            "reveal", workspace / "hidden" / "publish" / "model.ply", "--key-file", key, "-o", secret
        )
        left = len(read_model(secret))
        assert 0 < left <= 100
        assert result == Result(0, f"{secret}: {left} of {left} Gaussians\n", "")
        result = keyss("render", secret, "--cameras", workspace / "b", "-o", images, "--split", "all")
        assert result.status == 0
        assert result.out == f"{images}: 4 images\n"
        assert len(list(images.glob("*.png"))) == 4

        run = tmp_path / "run"
        shutil.copytree(workspace / "hidden", run)
        assert_refused(keyss("evaluate", run, "--key-file", key, "--wrong-keys", 2), 2, "no decoder")
        result = keyss("evaluate", run, "--key-file", key)
        assert result.status == 0
        metrics = json.loads((run / "private" / "metrics.json").read_text())
        assert f"{metrics['secrets'][0]['psnr']:.2f}" in result.out

        result = keyss("info", secret, "--json")
        assert json.loads(result.out)["gaussians"] == left
        result = keyss("info", run)
        assert f"{metrics['secrets'][0]['psnr']:.2f}" in result.out
        assert f"--seed {metrics['seed']}" in result.out.splitlines()[0]
        assert "{" not in result.out


def test_dry_run(keyss: Run, workspace: Path, tmp_path: Path) -> None:
    scenes = ("--cover", workspace / "a", "--secret", workspace / "b", "--key-file", workspace / "key.txt")
    result = keyss("hide", "--publish", "any", *scenes, "-o", tmp_path / "out", *SMALL, "--dry-run")
    assert result.status == 0, result.err
    for words in (
        "plain model of the cover",
        "plain model of the secret",
        "measuring",
        "all ",
        "room ",
        "memory ",
        "disk ",
    ):
        assert words in result.out, words
    assert re.search(r"up to [5-9]\d\d Gaussians of SH degree 3", result.out)
    assert "appended to the cover's 100" in result.out
    assert listing(tmp_path) == {}
    result = keyss("hide", *scenes, "-o", tmp_path / "out", *SMALL, "--dry-run")  # so few have no room
    assert_refused(result, 2, "--publish any has room")
    assert listing(tmp_path) == {}
    result = keyss("hide", *scenes, "-o", tmp_path / "out", *SMALL, "--sh-degree", 0, "--dry-run")
    assert_refused(result, 2, "--sh-degree 1 makes room")  # a degree of zero is one that was given
