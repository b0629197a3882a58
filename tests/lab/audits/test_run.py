"""An audit from files: what it writes, resumes and refuses."""

from __future__ import annotations

import json
import shutil
import time
from dataclasses import replace
from pathlib import Path
from statistics import fmean
from types import SimpleNamespace
from typing import Any

import pytest

import keyss
from keyss import Secret
from keyss.core import InputError, OutputError, UsageError, WrongKeyError
from keyss.files import read_model
from keyss.lab import measure_render_time, render_time
from keyss.lab.audits import PARTS, Section, audit, read_audit
from keyss.lab.audits.audit_run import AUDIT, PICTURES
from keyss.runs import read_manifest
from keyss.runs.files import REPORT
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

    def speed(subject: Any, seed: int, share: Any) -> tuple[Section, dict[str, bytes]]:
        called.append("speed")
        share(0.5)
        return Section(numbers={"gaussians": len(subject.stego)}), {"a picture": b"png"}

    def leaks(subject: Any, seed: int, share: Any) -> tuple[Section, dict[str, bytes]]:
        called.append("leaks")
        if called.count("leaks") == 1 and "fail" in called:
            raise KeyboardInterrupt
        return Section(numbers={"controls": len(subject.controls)}), {}

    parts = {each.__name__: replace(PARTS[each.__name__], measure=each) for each in (speed, leaks)}
    monkeypatch.setattr("keyss.lab.audits.audit_run.PARTS", parts)
    return called


def test_results_of_parts_are_written(run: Path, calls: list[str]) -> None:
    found = audit(run, [KEY], controls=2)
    assert calls == ["speed", "leaks"]
    assert read_audit(run) == found
    assert json.loads((run / "private" / "audit" / "audit.json").read_text())["version"] == 6
    assert found.sections["speed"].numbers == {"gaussians": len(read_model(run / "publish" / "model.ply"))}
    assert found.sections["leaks"].numbers == {"controls": 2}
    assert (len(found.controls), len(set(found.controls))) == (2, 2)
    assert (run / "private" / "audit" / "pictures" / "speed-1.png").exists()
    assert not (run / "private" / "checkpoint").exists()
    assert KEY not in (run / "private" / "audit" / "audit.json").read_text()


def test_parts_are_measured_once(run: Path, calls: list[str]) -> None:
    calls.append("fail")
    with pytest.raises(InputError, match=r"there is no audit; `keyss audit .* makes one"):
        read_audit(run)
    with pytest.raises(KeyboardInterrupt):
        audit(run, [KEY], controls=2)
    assert list(read_audit(run).sections) == ["speed"]
    with pytest.raises(OutputError, match="other controls: `overwrite=True` replaces it"):
        audit(run, [KEY], controls=3)
    assert list(audit(run, [KEY], controls=2).sections) == ["speed", "leaks"]
    found = audit(run, [KEY], controls=2)
    assert calls == ["fail", "speed", "leaks", "leaks"]
    assert audit(run, [KEY], controls=2, only=["speed"], overwrite=True).sections == found.sections
    assert calls[4:] == ["speed"]
    names = read_manifest(run).files["audit"]
    assert sorted(names) == sorted({AUDIT, REPORT, f"{PICTURES}/speed-1.png"})
    assert all((run / name).exists() for name in names)
    (run / AUDIT).write_text("{}")
    with pytest.raises(InputError, match="expected"):
        audit(run, [KEY], controls=2)
    assert list(audit(run, [KEY], controls=3, only=["leaks"], overwrite=True).sections) == ["leaks"]


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
    assert list(found.sections) == list(PARTS)
    parameters = found.sections["parameters"].numbers
    assert set(parameters["distances"]) >= {"position", "scale", "rotation", "opacity", "joint"}
    assert all(each["original"] is not None for each in parameters["distances"].values())
    metrics = json.loads((run_folder / "private" / "metrics.json").read_text())
    mean = fmean(each["psnr"] for each in metrics["secrets"])
    expected = (metrics["cover"]["psnr"] + mean) * (1 - parameters["sinkhorn"]["sum"])
    assert parameters["score"] == pytest.approx(expected)
    assert [len(each) for each in parameters["two_sample"].values()] == [2, 1, 2]
    assert {line.measure for line in found.verdicts} == {
        "cover on test photos",
        "secret 1 on test photos",
        "secret 2 on test photos",
        "wrong keys, secret 1",
        "wrong keys, secret 2",
        "attributes of the Gaussians",
        "classifier between models",
        "the file by itself",
        "StegExpose on renders",
        "leaks without the key",
        "loss of a random 25% of the Gaussians",
    }
    saved = b"".join(path.read_bytes() for path in (run_folder / "private").rglob("*.json"))
    assert not any(key.encode() in saved for key in KEYS)


def test_render_time_ratio(monkeypatch: pytest.MonkeyPatch) -> None:
    # Processor time: whatever else runs does not count.
    monkeypatch.setattr(render_time, "time", SimpleNamespace(perf_counter=time.process_time))
    scene, model = tiny_scene(0, views=8), random_gaussians(4000)
    same = measure_render_time(model, model, scene, rounds=4)
    more = measure_render_time(model, model[:10], scene, rounds=4)
    assert 0 < same.seconds < 10
    assert 0.1 < same.ratio < 10
    assert more.ratio > same.ratio / 10
