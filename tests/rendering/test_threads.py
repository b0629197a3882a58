"""Results do not depend on threads and processes."""

from __future__ import annotations

import multiprocessing
import sys
import threading
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor

import pytest
import torch
from torch import Tensor

from keyss import FitConfig, _threads, fit
from keyss.core import KeyssWarning
from keyss.kernels import parallel
from rendering.child_process import digest, digest_on_threads
from rendering.scenes import Scene, random_scene
from tiny_scenes import tiny_scene

PATIENCE = 120  # seconds; a timeout means a deadlock


@pytest.fixture(autouse=True)
def _eight_cores(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Allow several helper threads on any machine."""
    monkeypatch.setattr(parallel, "_CORES", 8)
    threads = torch.get_num_threads()
    yield
    torch.set_num_threads(threads)


def differences(first: dict[str, Tensor], second: dict[str, Tensor]) -> list[str]:
    assert first.keys() == second.keys()
    return [name for name in first if not torch.equal(first[name], second[name])]


def large_scene(**modes: object) -> Scene:
    """Several chunks of Gaussians, many tiles."""
    return random_scene(count=7000, width=150, height=130, size=0.05, **modes)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "scene", [large_scene(), large_scene(sh_degree=None, channels=7)], ids=["colour", "features"]
)
def test_results_do_not_depend_on_threads(scene: Scene) -> None:
    torch.set_num_threads(1)
    expected = scene.results()
    for name, tensor in expected.items():
        assert tensor.isfinite().all(), name
    assert differences(scene.results(), expected) == []
    for threads in (2, 3, 7):
        torch.set_num_threads(threads)
        for _ in range(2):
            assert differences(scene.results(), expected) == []


@pytest.mark.parametrize("threads", [1, 3])
def test_concurrent_rendering(threads: int) -> None:
    torch.set_num_threads(threads)
    scenes = [
        random_scene(count=2000, width=90, height=70, size=0.05, seed=0),
        random_scene(count=900, width=33, height=120, size=0.05, seed=1, sh_degree=None, channels=5),
        random_scene(count=2000, width=90, height=70, size=0.05, seed=2, sh_degree=1),
        random_scene(count=3000, width=64, height=64, size=0.02, seed=3),
    ]
    expected = [scene.results() for scene in scenes]
    started = threading.Barrier(2)

    def draw_repeatedly(some: list[int]) -> list[list[str]]:
        started.wait(PATIENCE)
        return [differences(scenes[i].results(), expected[i]) for _ in range(3) for i in some]

    with ThreadPoolExecutor(2) as pool:
        for wrong in pool.map(draw_repeatedly, ([0, 1, 2, 3], [3, 2, 1, 0])):
            assert wrong == [[]] * 12


def test_worker_errors_propagate() -> None:
    torch.set_num_threads(2)
    here, both = threading.get_ident(), threading.Barrier(2)

    def kernel(counter: object) -> None:
        both.wait(PATIENCE)
        if threading.get_ident() != here:
            raise RuntimeError("the helper failed")

    with pytest.raises(RuntimeError, match="the helper failed"):
        parallel.run(kernel)


def test_spawned_process() -> None:
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        there = pool.submit(digest_on_threads, 2).result(timeout=PATIENCE)
    assert there == digest_on_threads(1)


@pytest.mark.skipif(sys.platform != "linux", reason="fork is the default nowhere else")
@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_forked_process() -> None:
    # Create the scene before the fork: torch's own operations hang in a forked process.
    scene = random_scene(count=300, width=60, height=70)
    torch.set_num_threads(2)
    expected = digest(scene)
    assert parallel._pool.cache_info().currsize  # threads do not survive the fork
    context = multiprocessing.get_context("fork")
    queue: multiprocessing.Queue[str] = context.Queue()
    child = context.Process(target=lambda: queue.put(digest(scene)))
    child.start()
    try:
        assert queue.get(timeout=PATIENCE) == expected
    finally:
        child.join(PATIENCE)
        child.kill()
    assert digest(scene) == expected


def test_spinning_threads_warning(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_threads, "spinning", True)
    monkeypatch.setattr(torch, "get_num_threads", lambda: 2)
    with pytest.warns(KeyssWarning, match="import keyss first"):
        fit(tiny_scene(0), config=FitConfig(iterations=1, max_gaussians=50, seed=0))


def test_blocks_stop_after_interrupt() -> None:
    torch.set_num_threads(4)
    interrupted, begun = threading.Event(), []

    def work(start: int, stop: int) -> None:
        begun.append(start)
        if threading.current_thread() is threading.main_thread():
            interrupted.set()
            raise KeyboardInterrupt
        interrupted.wait(PATIENCE)

    with pytest.raises(KeyboardInterrupt):
        parallel.in_blocks(work, 10_000, 1)
    assert len(begun) < 1000
