"""Results do not depend on threads and processes; torch's threads are counted, and idle ones do not spin."""

from __future__ import annotations

import multiprocessing
import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from typing import ClassVar

import pytest
import torch
from torch import Tensor

from keyss import FitConfig, _threads, fit
from keyss.core import KeyssWarning
from keyss.rendering.cpu import parallel
from rendering.child_process import digest, digest_on_threads
from rendering.scenes import Scene, random_scene
from tiny_scenes import tiny_scene

PATIENCE = 120  # seconds until something hangs: far more than a busy machine needs


@pytest.fixture(autouse=True)
def _eight_cores(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Allow as many helper threads as torch uses, on any machine."""
    monkeypatch.setattr(parallel, "_CORES", 8)
    threads = torch.get_num_threads()
    yield
    torch.set_num_threads(threads)


def differing(first: dict[str, Tensor], second: dict[str, Tensor]) -> list[str]:
    assert first.keys() == second.keys()
    return [name for name in first if not torch.equal(first[name], second[name])]


def many(**modes: object) -> Scene:
    """More Gaussians than fit into one piece of work, seen from two sides, on many tiles."""
    return random_scene(count=7000, width=150, height=130, size=0.05, cameras=2, **modes)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "scene",
    [
        many(),
        many(sh_degree=None, channels=7),
    ],
    ids=["colour", "features"],
)
def test_images_and_gradients_are_the_same_for_any_number_of_threads(scene: Scene) -> None:
    torch.set_num_threads(1)
    expected = scene.results()
    for name, tensor in expected.items():
        assert tensor.isfinite().all(), name
    assert differing(scene.results(), expected) == []
    for threads in (2, 3, 7):
        torch.set_num_threads(threads)
        for _ in range(2):
            assert differing(scene.results(), expected) == []


@pytest.mark.parametrize("threads", [1, 3])
def test_python_threads_may_render_at_once(threads: int) -> None:
    torch.set_num_threads(threads)
    scenes = [
        random_scene(count=2000, width=90, height=70, size=0.05, seed=0),
        random_scene(count=900, width=33, height=120, size=0.05, seed=1, sh_degree=None, channels=5),
        random_scene(count=2000, width=90, height=70, size=0.05, seed=2, sh_degree=1),
        random_scene(count=3000, width=64, height=64, size=0.02, seed=3, cameras=2),
    ]
    expected = [scene.results() for scene in scenes]
    started = threading.Barrier(2)

    def draw_repeatedly(some: list[int]) -> list[list[str]]:
        started.wait(PATIENCE)
        return [differing(scenes[i].results(), expected[i]) for _ in range(3) for i in some]

    with ThreadPoolExecutor(2) as pool:
        for wrong in pool.map(draw_repeatedly, ([0, 1, 2, 3], [3, 2, 1, 0])):
            assert wrong == [[]] * 12


@pytest.mark.parametrize(("threads", "cores", "expected"), [(1, 8, 1), (2, 8, 2), (7, 8, 7), (7, 2, 2)])
def test_no_more_threads_than_torch_uses_and_the_machine_has(
    threads: int, cores: int, expected: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(parallel, "_CORES", cores)
    torch.set_num_threads(threads)
    everyone = threading.Barrier(expected)
    seen: list[int] = []

    def kernel(counter: object) -> None:
        seen.append(threading.get_ident())
        everyone.wait(PATIENCE)  # breaks, with an error, where fewer come

    parallel.run(kernel)
    assert len(seen) == len(set(seen)) == expected
    assert threading.get_ident() in seen


def test_an_error_on_a_helper_thread_is_raised() -> None:
    torch.set_num_threads(2)
    here, both = threading.get_ident(), threading.Barrier(2)

    def kernel(counter: object) -> None:
        both.wait(PATIENCE)
        if threading.get_ident() != here:
            raise RuntimeError("the helper failed")

    with pytest.raises(RuntimeError, match="the helper failed"):
        parallel.run(kernel)


def test_a_kernel_is_loaded_by_the_thread_that_calls_it() -> None:
    """Otherwise Ctrl-C, which interrupts that thread, could leave a helper waiting for a lock forever."""
    seen: list[str] = []

    class Kernel:
        overloads: ClassVar[dict[str, str]] = {}

        def __call__(self, counter: object) -> None:
            seen.append(threading.current_thread().name)
            self.overloads["loaded"] = ""

    torch.set_num_threads(2)
    kernel = Kernel()
    parallel.run(kernel)
    assert seen == [threading.current_thread().name]
    parallel.run(kernel)
    assert len(seen) >= 2  # a helper may come too late to be called


def test_spawned_processes_draw_the_same() -> None:
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        there = pool.submit(digest_on_threads, 2).result(timeout=PATIENCE)
    assert there == digest_on_threads(1)


@pytest.mark.skipif(sys.platform != "linux", reason="fork is the default nowhere else")
@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_forked_processes_draw_the_same() -> None:
    # The scene is made before the fork: after it torch's own operations hang, even exp of 1000 numbers.
    scene = random_scene(count=300, width=60, height=70)
    torch.set_num_threads(2)
    expected = digest(scene)
    assert parallel._pools  # helper threads, none of which lives on in the child
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


@pytest.mark.parametrize(
    ("imports", "spinning"), [("torch, keyss", True), ("keyss, torch", False), ("torch", None)]
)
def test_spinning_idle_threads_of_torch_are_detected(imports: str, spinning: bool | None) -> None:
    """A choice of the user is not reported."""
    environment = {name: value for name, value in os.environ.items() if name != "OMP_WAIT_POLICY"}
    if spinning is None:
        environment["OMP_WAIT_POLICY"] = "active"
    code = f"import {imports}; from keyss import _threads; print(_threads.spinning)"
    found = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True)
    assert found.stdout.strip() == str(bool(spinning))


def test_training_warns_of_spinning_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_threads, "spinning", True)
    monkeypatch.setattr(torch, "get_num_threads", lambda: 2)
    with pytest.warns(KeyssWarning, match="import keyss first"):
        fit(tiny_scene(0), config=FitConfig(iterations=1, max_gaussians=50, seed=0))
