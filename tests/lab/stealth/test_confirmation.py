"""Candidate scores confirm identical Gaussians, but not carried secrets."""

from __future__ import annotations

import os

import pytest

from channels.quiet.trained_like import keys
from keyss.lab import candidate_scores, changed_low_bits
from lab.stealth.careless import overwritten, plain
from methods.carry.carried import embed_derived

SECRETS = 2


def test_identical_high_bits() -> None:
    file = overwritten(plain(1))
    assert candidate_scores(file, plain(1))["identical high bits"] == 1
    assert candidate_scores(file, plain(2))["identical high bits"] == 0
    assert changed_low_bits(file, plain(1)) == 1
    assert changed_low_bits(file, plain(2)) == changed_low_bits(file, file) == 0


def test_carried_secrets_are_not_confirmed() -> None:
    """Embedding does not change the scores of candidates."""
    candidates = [plain(10 + index, 700) for index in range(SECRETS)]
    covers = [plain(index) for index in range(SECRETS)]
    before = [
        candidate_scores(cover, each)["nearness of rows, median"] for cover in covers for each in candidates
    ]
    files = [
        embed_derived(cover, [(keys(index), secret)], os.urandom(32))
        for index, (cover, secret) in enumerate(zip(covers, candidates, strict=True))
    ]
    after = [
        candidate_scores(file, each)["nearness of rows, median"] for file in files for each in candidates
    ]
    assert after == pytest.approx(before, abs=1e-2)
