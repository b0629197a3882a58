"""Hiding, revealing, rendering, measuring and describing, one after the other."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

from cli.said import SMALL, Run, Said, assert_refused, listing
from keyss.files import read_model


class TestTheWholePath:
    def test_reveal_render_evaluate_info(self, keyss: Run, world: Path, tmp_path: Path) -> None:
        secret, images, key = tmp_path / "secret.ply", tmp_path / "images", world / "key.txt"
        said = keyss("reveal", world / "hidden" / "publish" / "model.ply", "--key-file", key, "-o", secret)
        left = len(read_model(secret))
        assert 0 < left <= 100
        assert said == Said(0, f"{secret}: {left} of {left} Gaussians\n", "")
        said = keyss("render", secret, "--cameras", world / "b", "-o", images, "--split", "all")
        assert said.status == 0
        assert said.out == f"{images}: 4 images\n"
        assert len(list(images.glob("*.png"))) == 4

        run = tmp_path / "run"
        shutil.copytree(world / "hidden", run)
        assert_refused(keyss("evaluate", run, "--key-file", key, "--wrong-keys", 2), 2, "no decoder")
        said = keyss("evaluate", run, "--key-file", key)
        assert said.status == 0
        metrics = json.loads((run / "private" / "metrics.json").read_text())
        assert f"{metrics['secrets'][0]['psnr']:.2f}" in said.out

        said = keyss("info", secret, "--json")
        assert json.loads(said.out)["gaussians"] == left
        said = keyss("info", run)
        assert f"{metrics['secrets'][0]['psnr']:.2f}" in said.out
        assert f"--seed {metrics['seed']}" in said.out.splitlines()[0]
        assert "{" not in said.out


def test_a_dry_run_prints_the_whole_and_writes_nothing(keyss: Run, world: Path, tmp_path: Path) -> None:
    scenes = ("--cover", world / "a", "--secret", world / "b", "--key-file", world / "key.txt")
    said = keyss("hide", "--publish", "any", *scenes, "-o", tmp_path / "out", *SMALL, "--dry-run")
    assert said.status == 0, said.err
    for words in (
        "plain model of the cover",
        "plain model of the secret",
        "measuring",
        "all ",
        "room ",
        "memory ",
        "disk ",
    ):
        assert words in said.out, words
    assert re.search(r"up to [5-9]\d\d Gaussians of SH degree 3", said.out)
    assert "appended to the cover's 100" in said.out
    assert listing(tmp_path) == {}
    said = keyss("hide", *scenes, "-o", tmp_path / "out", *SMALL, "--dry-run")  # so few have no room
    assert_refused(said, 2, "--publish any has room")
    assert listing(tmp_path) == {}
    said = keyss("hide", *scenes, "-o", tmp_path / "out", *SMALL, "--sh-degree", 0, "--dry-run")
    assert_refused(said, 2, "--sh-degree 1 makes room")  # a degree of zero is one that was given
