"""Misspelt commands and options."""

from __future__ import annotations

import pytest

from cli.harness import Run, assert_refused


@pytest.mark.parametrize(
    ("arguments", "meant"),
    [
        (("revael", "x"), "did you mean `keyss reveal`?"),
        (("Hide",), "did you mean `keyss hide`?"),
        (("--quiet", "inof", "x"), "did you mean `keyss info`?"),
        (("frobnicate",), "see `keyss --help`"),
        (("convert", "a.ply", "-o", "b.spz"), "name OUT after IN"),
        (("audit", "run", "-o", "x"), "results go into the folder of the run"),
    ],
)
def test_misspelt_command(keyss: Run, arguments: tuple[str, ...], meant: str) -> None:
    assert_refused(keyss(*arguments), 2, meant)


@pytest.mark.parametrize(
    ("arguments", "meant"),
    [
        (("reveal", "a", "--keyfile", "k", "-o", "b"), "--key-file FILE"),
        (("hide", "--cover", "a", "--seckret=b", "-o", "c"), "--secret SCENE"),
        (("hide", "--method", "carry", "--min-psnrr", "-o", "c"), "--min-psnr"),
    ],
)
def test_misspelt_option(keyss: Run, arguments: tuple[str, ...], meant: str) -> None:
    result = keyss(*arguments)
    assert (result.status, result.out) == (2, "")
    assert meant in result.err.partition("Perhaps you meant")[2]
