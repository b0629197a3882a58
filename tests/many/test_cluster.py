"""Ray as the engine: the same cells, the same bytes, and another attempt where a worker is lost."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from keyss.core import BackendError
from many.fakes import write_spec
from many.killing import kill_until_done, results
from many.test_sweep import run


# Ray warns of its own sockets and of forks.
@pytest.mark.slow
@pytest.mark.filterwarnings("default")
def test_a_local_cluster_does_the_same_cells_with_the_same_bytes(tmp_path: Path) -> None:
    pytest.importorskip("ray", reason="ray is not installed")
    spec, master = (
        write_spec(tmp_path, ["a.ply", "mortal.ply", "broken.ply"], seeds=2),
        tmp_path / "master.txt",
    )
    here = run(spec, tmp_path / "here", master_key_file=master, jobs=1)
    there = run(spec, tmp_path / "there", master_key_file=master, jobs=1, ray="local")
    assert [each.result for each in there.outcomes] == [each.result for each in here.outcomes]
    assert [each.error for each in there.outcomes] == [each.error for each in here.outcomes]
    for name in here.tables:
        assert (tmp_path / "here" / name).read_bytes() == (tmp_path / "there" / name).read_bytes()


@pytest.mark.slow
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="looks at /proc")
@pytest.mark.filterwarnings("default")
def test_with_killed_workers_and_drivers_it_ends_as_if_nothing_had_happened(tmp_path: Path) -> None:
    pytest.importorskip("ray", reason="ray is not installed")
    spec, master = write_spec(tmp_path, ["a.ply", "b.ply"], seeds=12), tmp_path / "master.txt"
    calm = run(spec, tmp_path / "calm", master_key_file=master, jobs=2)

    def worker_or_job(command: str) -> bool:
        return command.startswith("ray::") or "attempt(Path(" in command

    killed = kill_until_done(spec, tmp_path / "out", "ray", 20, seed=4, longest=0.6, chosen=worker_or_job)
    assert sum(each.startswith("ray::") for each in killed) >= 2
    assert len(results(tmp_path / "out")) == 24
    for name in calm.tables:
        assert (tmp_path / "out" / name).read_bytes() == (tmp_path / "calm" / name).read_bytes()


@pytest.mark.parametrize(("package", "ray"), [("ray", "local"), ("yaml", None)])
def test_without_a_package_one_sentence_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, package: str, ray: str | None
) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    spec = write_spec(tmp_path, ["a.ply"], seeds=1)
    with pytest.raises(BackendError, match=r"pip install 'keyss\[sweep\]'"):
        run(spec, tmp_path / "out", jobs=1, ray=ray)
