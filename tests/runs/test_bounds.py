"""Upper bounds: plain 3DGS with the same budget."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import msgspec

import keyss
from keyss import CarryOptions, FitConfig, Secret
from keyss.progress import Reporter

FIT = FitConfig(iterations=40, max_gaussians=300, grow_every=20, evaluate_every=0, seed=0)
KEY = "a key of many characters: 93hXmQ2"


class Trainings(Reporter):
    """Records the steps of each training."""

    def __init__(self) -> None:
        self.steps: list[int] = []

    def start(self, title: str, iterations: int, iteration: int) -> None:
        self.steps.append(0)

    def update(self, iteration: int, gaussians: int, numbers: dict[str, float]) -> None:
        self.steps[-1] = iteration


def test_bound_has_equal_steps(folders: tuple[Path, Path], tmp_path: Path) -> None:
    trainings = Trainings()
    options = CarryOptions(fit=FIT, publish="converted", fine_tune="always", iterations=30)
    result = keyss.hide(
        folders[0],
        [Secret(folders[1], KEY)],
        method=options,
        bound=True,
        min_psnr=0,
        out=tmp_path / "run",
        reporter=trainings,
    )
    steps = trainings.steps
    assert steps == [40, 40, 30, 70]  # cover, secret, fine-tuning of the secret, bound
    metrics = result.metrics
    assert metrics.steps == metrics.baseline.steps == (steps[0], steps[1] + steps[2]) == (40, steps[3])
    assert metrics.baseline.equal == (True, True)
    assert keyss.evaluate(tmp_path / "run", [KEY]) == metrics
    before = msgspec.json.decode((tmp_path / "run" / "private" / "metrics.json").read_bytes())
    assert before["baseline"]["steps"] == [40, 70]
    longer = keyss.read_model(tmp_path / "run" / "private" / "bound-1.ply")
    assert metrics.baseline.gaussians[1] == len(longer)


def test_shorter_fit_is_no_bound(folders: tuple[Path, Path], tmp_path: Path) -> None:
    trainings = Trainings()
    fitted = keyss.fit(folders[1], config=replace(FIT, iterations=25), out=tmp_path / "plain")
    secret = Secret(folders[1], KEY, tmp_path / "plain" / "model.ply")
    options = CarryOptions(fit=FIT, publish="converted", fine_tune="always")
    metrics = keyss.hide(folders[0], [secret], method=options, min_psnr=0, reporter=trainings).metrics
    assert trainings.steps == [40, 46]
    assert metrics.steps == (40, 71)  # recorded by `keyss fit`
    assert metrics.baseline.steps == (40, 25)
    assert metrics.baseline.equal == (True, False)
    unknown = Secret(folders[1], KEY, fitted.gaussians)
    metrics = keyss.hide(folders[0], [unknown], method=options, bound=True, min_psnr=0).metrics
    assert metrics.steps == (40, None)
    assert metrics.baseline.equal == (True, False)
    carried = keyss.hide(
        folders[0], [unknown], method=CarryOptions(fit=FIT, publish="converted"), bound=True, min_psnr=0
    ).metrics
    assert carried.baseline.equal == (True, True)  # no fine-tuning
