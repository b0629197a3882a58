"""Event files of TensorBoard, read by TensorBoard."""

from __future__ import annotations

import stat
from pathlib import Path

import pytest

from cli.said import SMALL, Run
from keyss.files import read_model


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of TensorBoard's own
def test_losses_come_back(keyss: Run, scene: Path) -> None:
    events = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    out = scene.parent / "out"
    said = keyss("fit", scene, "-o", out, *SMALL[2:], "--seed", 0, "--tensorboard")
    assert said.status == 0, said.err
    (folder,) = (out / "private" / "tensorboard").iterdir()
    assert folder.name == "fit_b"
    assert stat.S_IMODE((out / "private").stat().st_mode) == 0o700
    found = events.EventAccumulator(str(folder))
    found.Reload()
    losses = found.Scalars("loss")
    assert [each.step for each in losses] == [10, 20]
    assert all(0 < each.value < 1 for each in losses)
    assert found.Scalars("Gaussians")[-1].value >= len(read_model(out / "model.ply"))
    assert "loss" not in said.err
    # What trains is the same, watched or not.
    keyss("fit", scene, "-o", scene.parent / "plain", *SMALL[2:], "--seed", 0)
    assert (out / "model.ply").read_bytes() == (scene.parent / "plain" / "model.ply").read_bytes()
