"""sealwatch's detectors see payloads in last bits, and nothing where there is nothing."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Iterator
from importlib import import_module
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from keyss.core.errors import BackendError, UsageError
from keyss.measure import sealwatch_detectors
from keyss.measure.sealwatch_detectors import DetectorRoc, SealwatchRocs, sealwatch_roc
from measure.test_roc import views
from measure.test_stegexpose import with_payload

Images = list[npt.NDArray[np.uint8]]


@pytest.fixture(scope="module")
def sealwatch() -> Iterator[Any]:
    """The package, with a stand-in for torchvision where there is none that loads.

    PyPI's torchvision does not load beside a torch for CPUs only. sealwatch imports it for its neural
    networks, none of which is used here: the stand-in has the one name that is needed to define them.
    """
    if importlib.util.find_spec("sealwatch") is None:
        pytest.skip("needs sealwatch: pip install 'keyss[steganalysis]'")
    with pytest.MonkeyPatch.context() as patch:
        try:
            import_module("torchvision.transforms")
        except (ImportError, RuntimeError):
            package, transforms = ModuleType("torchvision"), ModuleType("torchvision.transforms")
            package.transforms, transforms.Grayscale = transforms, object  # type: ignore[attr-defined]
            patch.setitem(sys.modules, "torchvision", package)
            patch.setitem(sys.modules, "torchvision.transforms", transforms)
        try:
            yield import_module("sealwatch")
        except ImportError as error:
            pytest.skip(f"sealwatch does not load: {error}")


def pairs(rate: float, count: int = 15) -> tuple[Images, Images]:
    """Views, and the same with a payload."""
    plain = views((40, 48), count)
    return plain, [with_payload(image, rate) for image in plain]


def detectors(found: SealwatchRocs) -> list[DetectorRoc]:
    """All three."""
    assert found.spam is not None
    return [found.spa, found.ws, found.spam]


@pytest.mark.usefixtures("sealwatch")
class TestWithSealwatch:
    def test_a_payload_is_seen_by_all(self) -> None:
        found = sealwatch_roc(*pairs(0.4))
        assert [len(each.plain) for each in detectors(found)] == [15, 15, 15]
        assert min(each.roc.auc for each in detectors(found)) > 0.95

    def test_spa_finds_the_rate_and_ws_the_rate_of_changes(self) -> None:
        image = views((300, 300), 1)[0]
        found = sealwatch_roc([image], [with_payload(image, 0.4)])
        assert found.spa.stego[0] == pytest.approx(0.4, abs=0.05)
        assert found.ws.stego[0] == pytest.approx(0.2, abs=0.05)
        assert found.ws.plain[0] == pytest.approx(0, abs=0.05)

    def test_the_same_images_are_a_toss_up(self) -> None:
        plain, _ = pairs(0.0)
        assert [each.roc.auc for each in detectors(sealwatch_roc(plain, plain))] == [0.5, 0.5, 0.5]

    def test_views_with_their_labels_drawn_by_lot_are_a_toss_up(self) -> None:
        """Both have a payload, of another key each: there is nothing to learn that holds for other views."""
        random = np.random.default_rng(3)
        clean = views((40, 48), 30)
        noisy = [
            [
                np.rint(image + random.normal(0, 1, image.shape)).clip(0, 255).astype(np.uint8)
                for image in clean
            ]
            for _ in range(2)
        ]
        found = sealwatch_roc(*noisy)
        for each in detectors(found):
            assert each.roc.low < 0.5 < each.roc.high

    def test_two_runs_give_the_same_numbers(self) -> None:
        images = pairs(0.02, 12)
        first = sealwatch_roc(*images, seed=1)
        assert sealwatch_roc(*images, seed=1) == first
        assert sealwatch_roc(*images, seed=2).spam != first.spam

    def test_few_views_teach_nothing(self) -> None:
        assert sealwatch_roc(*pairs(0.4, 9)).spam is None

    def test_images_of_one_colour_are_no_trouble(self) -> None:
        flat = [np.full((8, 8, 3), 7, dtype=np.uint8)] * 10
        assert [each.roc.auc for each in detectors(sealwatch_roc(flat, flat))] == [0.5, 0.5, 0.5]

    def test_the_fast_spam_is_the_slow_one(self, sealwatch: Any) -> None:
        """We run the one in Rust, which is hundreds of times faster."""
        (image,) = views((300, 300), 1)
        found = sealwatch_detectors._spam(sealwatch, [image])[0]
        expected = [
            sealwatch.tools.flatten(sealwatch.spam.py.extract(np.ascontiguousarray(image[:, :, channel])))
            for channel in range(3)
        ]
        np.testing.assert_allclose(found, np.mean(expected, axis=0), atol=1e-4)


def test_both_renders_of_a_view_are_held_out_and_so_are_its_neighbours() -> None:
    plain = np.arange(23, dtype=np.float64)[:, None]
    stego = plain + 100
    taught: list[npt.NDArray[np.float64]] = []

    class Trainer:
        def __init__(self, covers: Any, stegos: Any, **options: Any) -> None:
            assert (stegos == covers + 100).all()
            assert options["seed"] == 5
            self.covers = covers[:, 0]

        def train(self) -> tuple[Trainer, None]:
            taught.append(self.covers)
            return self, None

        def predict_confidence(self, rows: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
            asked = rows[:, 0] % 100
            assert not np.isin(asked, self.covers).any()
            assert (np.diff(asked) == 1).all()  # consecutive views
            return rows[:, 0]

    stand_in = SimpleNamespace(ensemble_classifier=SimpleNamespace(FldEnsembleTrainer=Trainer))
    votes = sealwatch_detectors._held_out_votes(stand_in, plain, stego, seed=5)
    assert votes == (plain[:, 0].tolist(), stego[:, 0].tolist())
    assert len(taught) == 5


@pytest.mark.parametrize(
    "error",
    [ImportError("No module named 'sealwatch'"), RuntimeError("operator torchvision::nms does not exist")],
)
def test_without_sealwatch_one_sentence_names_the_extra(
    monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    def fail(name: str) -> None:
        raise error

    monkeypatch.setattr(sealwatch_detectors, "import_module", fail)
    with pytest.raises(BackendError, match=r"keyss\[steganalysis\]") as raised:
        sealwatch_roc(*pairs(0.0, 2))
    assert str(error) in str(raised.value)


def test_other_views_are_refused() -> None:
    plain, stego = pairs(0.0, 3)
    with pytest.raises(UsageError, match="same views"):
        sealwatch_roc(plain, stego[1:])
    with pytest.raises(UsageError, match="8x8"):
        sealwatch_roc([plain[0][:7]], [plain[0][:7]])
