"""An audit from files: what it writes, resumes and refuses."""

from __future__ import annotations

import json
import shutil
import time
from pathlib import Path
from statistics import fmean
from types import SimpleNamespace
from typing import Any

import pytest
import torch

import keyss
from keyss import Secret
from keyss.core import InputError, Interrupted, OutputError, UsageError, WrongKeyError
from keyss.lab import RenderTime, measure_render_time
from keyss.lab.audits import PARTS, Audit, audit, parts, read_audit
from keyss.lab.audits.forecast import forecast_audit
from lab.audits.audited import KEYS
from test_api import ANY, write_nerfstudio
from tiny_scenes import random_gaussians, tiny_scene

KEY = "open sesame 4711"


@pytest.fixture(scope="module")
def hidden(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("audit")
    cover, secret = (write_nerfstudio(root / name, tiny_scene(seed)) for seed, name in enumerate("ab"))
    method = ANY.with_fit(max_gaussians=600)
    keyss.hide(cover, [Secret(secret, KEY)], method=method, out=root / "run")
    return root / "run"


@pytest.fixture
def run(hidden: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(hidden, tmp_path / "run"))


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Record the calls of two parts; the second fails once after "fail"."""
    called: list[str] = []

    def speed(subject: Any, seed: int, progress: Any) -> tuple[dict[str, RenderTime], Any]:
        called.append("speed")
        progress(1, 2)
        result = {"stego model": RenderTime(len(subject.stego), 1.0)}
        return result, {"a.png": torch.zeros(4, 5, 3, dtype=torch.uint8)}

    def leaks(subject: Any, seed: int, progress: Any) -> tuple[Any, Any]:
        called.append("leaks")
        if called.count("leaks") == 1 and "fail" in called:
            raise KeyboardInterrupt
        return ((),) * len(subject.controls), {}

    monkeypatch.setattr("keyss.lab.audits.audit_run.PARTS", {"speed": speed, "leaks": leaks})
    return called


def gaussians_of(found: Audit) -> float:
    """The number that the part `speed` stored."""
    assert found.speed is not None
    return found.speed["stego model"].seconds


def test_results_of_parts_are_written(run: Path, calls: list[str]) -> None:
    found = audit(run, [KEY], controls=2)
    assert calls == ["speed", "leaks"]
    assert read_audit(run) == found
    assert json.loads((run / "private" / "audit" / "audit.json").read_text())["version"] == 5
    assert gaussians_of(found) == len(keyss.read_model(run / "publish" / "model.ply"))
    assert found.leaks == ((), ())
    assert (len(found.controls), len(set(found.controls))) == (2, 2)
    assert (run / "private" / "audit" / "pictures" / "a.png").exists()
    assert not (run / "private" / "checkpoint").exists()
    assert KEY not in (run / "private" / "audit" / "audit.json").read_text()


def test_resume(run: Path, calls: list[str]) -> None:
    calls.append("fail")
    with pytest.raises(Interrupted):
        audit(run, [KEY], controls=2)
    assert not (run / "private" / "audit" / "audit.json").exists()
    with pytest.raises(InputError, match=r"there is no audit; `keyss audit .* makes one"):
        audit(run, report_only=True)
    with pytest.raises(OutputError, match="`resume=True` with the same arguments"):
        audit(run, [KEY], controls=2)
    with pytest.raises(OutputError, match="controls: 2 then, 3 now"):
        audit(run, [KEY], controls=3, resume=True)
    found = audit(run, [KEY], controls=2, resume=True)
    assert calls == ["fail", "speed", "leaks", "leaks"]
    assert gaussians_of(found) > 0
    assert (run / "private" / "audit" / "pictures" / "a.png").exists()


def test_invalid_arguments(run: Path, tmp_path: Path, calls: list[str]) -> None:
    with pytest.raises(WrongKeyError):
        audit(run, ["another"])
    with pytest.raises(UsageError, match="at least 2"):
        audit(run, [KEY], controls=1)
    with pytest.raises(UsageError, match="no such part"):
        audit(run, [KEY], only=["looks"])
    with pytest.raises(InputError):
        audit(tmp_path, [KEY])
    (run / "private" / "cover.ply").unlink()
    with pytest.raises(InputError, match="plain model of the cover"):
        audit(run, [KEY], controls=2)


def test_whole_audit(run_folder: Path) -> None:
    found = read_audit(run_folder)
    assert found.parameters is not None
    assert set(found.parameters.distances) >= {"position", "scale", "rotation", "opacity", "joint"}
    assert all(each.original is not None for each in found.parameters.distances.values())
    metrics = json.loads((run_folder / "private" / "metrics.json").read_text())
    mean = fmean(each["psnr"] for each in metrics["secrets"])
    expected = (metrics["cover"]["psnr"] + mean) * (1 - found.parameters.sinkhorn.sum)
    assert found.parameters.score == pytest.approx(expected)
    assert [len(each) for each in vars(found.parameters.two_sample).values()] == [2, 1, 2]
    assert found.images is not None
    assert found.leaks is not None
    pictures = {file for files in found.images.pictures.values() for file in files.values()}
    pictures |= {str(row.picture) for rows in found.leaks for row in rows}
    assert all((run_folder / "private" / "audit" / "pictures" / name).is_file() for name in pictures)
    saved = b"".join(path.read_bytes() for path in (run_folder / "private").rglob("*.json"))
    assert not any(key.encode() in saved for key in KEYS)


def test_ratio_of_equal_and_of_smaller_models(monkeypatch: pytest.MonkeyPatch) -> None:
    # Processor time: whatever else runs does not count.
    monkeypatch.setattr(parts, "time", SimpleNamespace(perf_counter=time.process_time))
    scene, model = tiny_scene(0, views=8), random_gaussians(4000)
    same = measure_render_time(model, model, scene, rounds=4)
    more = measure_render_time(model, model[:10], scene, rounds=4)
    assert 0 < same.seconds < 10
    assert 0.1 < same.ratio < 10
    assert more.ratio > same.ratio / 10


def test_forecasts_need_no_keys_and_grow_with_the_work(run: Path) -> None:
    found = forecast_audit(run)
    assert list(found.seconds) == ["controls", *PARTS]
    assert found.steps == ANY.fit.iterations
    more = forecast_audit(run, controls=6, only=("speed", "stealth"))
    assert list(more.seconds) == ["controls", "stealth", "speed"]
    assert more.seconds["controls"] > found.seconds["controls"]
    assert more.seconds["speed"] == found.seconds["speed"]
    with pytest.raises(UsageError, match="no such part"):
        forecast_audit(run, only=("sorcery",))
