"""Rough times of work on files."""

from __future__ import annotations

import warnings
from pathlib import Path

from files.formats.examples import model_of
from keyss.files import write_model
from keyss.runs.estimates import gaussians_in


def test_estimated_model_sizes(tmp_path: Path) -> None:
    (tmp_path / "point_cloud/iteration_7").mkdir(parents=True)
    inside = tmp_path / "point_cloud/iteration_7/point_cloud.ply"
    write_model(inside, model_of(3000, 2))
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # the command warns of the chosen model, once
        assert gaussians_in(tmp_path) == gaussians_in(inside) == 3000
    for name in ("a.spz", "a.compressed.ply", "a.sog"):
        write_model(tmp_path / name, model_of(20_000, 0))
        assert 10_000 < gaussians_in(tmp_path / name) < 40_000
    for name in ("-", "missing.ply", "a/b"):
        assert gaussians_in(Path(name)) == 0
