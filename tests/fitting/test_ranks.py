"""Two processes that train together, against one with as many views in a step."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import pytest
import torch

from fitting import training_together
from fitting.training_together import FIT, RUNS, trained
from keyss.core import OtherProcessError, UsageError
from keyss.fitting import FitConfig, Ranks, State, here, joined, load_checkpoint, ranks

pytestmark = pytest.mark.counted

T = TypeVar("T")
TESTS = Path(training_together.__file__).parents[1]
TOGETHER = replace(FIT, views_per_step=2)


def torchrun(folder: Path, device: str) -> None:
    """`training_together` in two processes."""
    launcher = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    program = [training_together.__file__, str(folder), device]
    paths = [str(TESTS), *sys.path]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths), "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [*launcher, *program], env=environment, capture_output=True, text=True, check=False, timeout=300
    )
    assert done.returncode == 0, done.stderr[-3000:]


@pytest.fixture(scope="module")
def two(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Final states of two processes, in a file for each run and rank."""
    folder = tmp_path_factory.mktemp("ranks")
    torchrun(folder, "cpu")
    return folder


@contextmanager
def one_thread() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def assert_near(found: State, expected: State) -> None:
    """Assert equal tensors up to the order of sums."""
    assert found.keys() == expected.keys()
    for name, tensor in expected.items():
        assert found[name].shape == tensor.shape, name
        if tensor.is_floating_point():
            scale = float(tensor.abs().max())
            torch.testing.assert_close(found[name], tensor, rtol=1e-3, atol=1e-4 * scale, msg=name)
        else:
            assert torch.equal(found[name], tensor), name


@pytest.mark.parametrize("name", RUNS)
def test_two_processes_train_like_one_with_twice_the_views(two: Path, name: str) -> None:
    begun = len(RUNS[name](TOGETHER, torch.device("cpu")))
    with one_thread():  # as each of the two has: networks round differently on several
        one = trained(name, TOGETHER)
    assert len(one) > begun  # it was densified
    tensors, meta = one.state()
    found, found_meta = load_checkpoint(two / f"{name}-0")
    assert_near(found, tensors)
    assert found_meta == meta


@pytest.mark.parametrize("name", RUNS)
def test_all_processes_hold_the_same_to_the_bit(two: Path, name: str) -> None:
    assert (two / f"{name}-0").read_bytes() == (two / f"{name}-1").read_bytes()


def test_a_step_of_two_views_differs_from_two_steps() -> None:
    """A step of two views uses both."""
    once, twice = trained("plain", FIT).state()[0], trained("plain", TOGETHER).state()[0]
    assert not torch.allclose(once["means"][:50], twice["means"][:50], atol=1e-4)
    assert len(once["order"]) != len(twice["order"])


def test_each_process_renders_one_view_by_default() -> None:
    second = Ranks(1, 3)
    assert second.views(None) == 3
    assert list(second.mine(range(6))) == [2, 3]
    with pytest.raises(UsageError, match="multiple of the 3 processes, got 4"):
        second.views(4)
    with pytest.raises(UsageError, match="views_per_step"):
        FitConfig(views_per_step=0)


def test_without_torchrun_there_is_one_rank(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in (("RANK", "0"), ("WORLD_SIZE", "1"), ("MASTER_ADDR", "x"), ("MASTER_PORT", "1")):
        monkeypatch.setenv(name, value)
    with joined() as alone:
        assert alone == here() == Ranks()
    monkeypatch.setenv("WORLD_SIZE", "2")
    monkeypatch.setenv("RANK", "two")
    with joined() as alone:
        assert alone == Ranks()


class Deserted(Ranks):
    """Two ranks in this process, which renders the views of both until the other one ends."""

    steps = 0

    def mine(self, drawn: Sequence[T]) -> Sequence[T]:
        return drawn

    def sum(self, trained: Iterable[torch.Tensor], others: Sequence[torch.Tensor]) -> list[torch.Tensor]:
        Deserted.steps += 1
        if Deserted.steps == 25:
            raise OtherProcessError("gone")
        return list(others)

    def agree(self, signum: int, gaussians: int) -> int:
        return signum

    def from_first(self, data: bytes) -> bytes:
        return data


@pytest.mark.parametrize("name", RUNS)
def test_the_state_before_the_step_is_saved_if_another_process_ends(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "checkpoint.safetensors"
    monkeypatch.setattr(Deserted, "steps", 0)
    monkeypatch.setattr(ranks, "_joined", Deserted(0, 2))
    with pytest.raises(OtherProcessError, match="resume=True"):
        trained(name, TOGETHER, checkpoint=path)
    monkeypatch.setattr(ranks, "_joined", Ranks())
    assert load_checkpoint(path)[1]["iteration"] == 24
    resumed = trained(name, TOGETHER, checkpoint=path, resume=True)
    assert_near(resumed.state()[0], trained(name, TOGETHER).state()[0])


@pytest.mark.cuda
def test_two_processes_train_together_on_gpus(tmp_path: Path) -> None:
    """One GPU each, with NCCL; near the result of one process, whose order of sums varies."""
    if torch.cuda.device_count() < 2:
        pytest.skip("needs two GPUs")
    torchrun(tmp_path, "cuda")
    for name in RUNS:
        assert (tmp_path / f"{name}-0").read_bytes() == (tmp_path / f"{name}-1").read_bytes()
        found, _ = load_checkpoint(tmp_path / f"{name}-0")
        count = len(trained(name, TOGETHER, "cuda"))
        assert abs(len(found["means"]) - count) <= 0.05 * count
