from __future__ import annotations

import pytest

from keyss.methods.hidden import Remains
from keyss.runs.revealing import Revealed, check_secret, loss_warnings


@pytest.mark.parametrize(
    ("remains", "expected"),
    [
        (Remains(100, 100, (12, 12)), []),
        (Remains(100, 100, (9, 12)), ["3 of 12 chunks of the secret's payload were lost, and restored"]),
        (Remains(75, 100, (9, 12)), ["75 of 100 Gaussians of the secret were found"]),
        (Remains(120, 100), ["120 of 100 Gaussians of the secret were found"]),
    ],
)
def test_loss_warnings(remains: Remains, expected: list[str]) -> None:
    warnings = loss_warnings(remains)
    assert len(warnings) == len(expected)
    for warning, start in zip(warnings, expected, strict=True):
        assert warning.startswith(start)
    assert check_secret(Revealed(None, remains, tuple(warnings))).problems == tuple(warnings)
