"""Tables as other programs read them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from keyss.lab.many import result_tables

NUMBERS = [(26.5, 0.91, 0.12), (27.5, 0.93, 0.10), (27.0, 0.92, 0.14)]


def cells(numbers: list[tuple[float, float, float]]) -> list[result_tables.CellNumbers]:
    """Seeds of one method on scenes with odd names, and one seed of another that failed to measure LPIPS."""
    found = [
        result_tables.CellNumbers(
            labels={"method": "carry", "mask": ["op", "ro"]},
            scenes=["a_b", "c&d"],
            seed=seed,
            cell=f"{seed}",
            numbers={
                **dict(zip(("cover.psnr", "cover.ssim", "cover.lpips"), each, strict=True)),
                "secrets.1.psnr": 20.0,
            },
        )
        for seed, each in enumerate(numbers)
    ]
    other = result_tables.CellNumbers(
        labels={"method": "3dgs"}, scenes=["a_b"], seed=0, cell="x", numbers={"cover.psnr": 1 / 3}
    )
    return [*found, other]


def test_a_row_for_each_scene_with_means_and_deviations_over_seeds(tmp_path: Path) -> None:
    pandas = pytest.importorskip("pandas")
    result_tables.write_scene_tables(tmp_path, "scenes", cells(NUMBERS))
    table = pandas.read_csv(
        tmp_path / "scenes.csv", keep_default_na=False, na_values={"psnr_std": "", "lpips": ""}
    )
    assert list(table["scene"]) == ["a_b", "c&d", "a_b"]
    assert list(table["seeds"]) == [3, 3, 1]
    assert table["mask"][0] == '["op", "ro"]'
    assert table["mask"][2] == ""
    cover = np.array(NUMBERS)
    shown = table.loc[0, ["psnr", "ssim", "lpips", "psnr_std", "ssim_std", "lpips_std"]].astype(float)
    assert list(shown) == pytest.approx([*cover.mean(0), *cover.std(0, ddof=1)], rel=1e-12)
    assert table["psnr"][2] == 1 / 3
    assert table["psnr_std"].isna().tolist() == [False, False, True]
    assert table["lpips"].isna().tolist() == [False, True, True]


def test_latex_has_equal_rows_and_no_bare_special_characters() -> None:
    lines = result_tables.latex(result_tables.scene_rows(cells(NUMBERS))).splitlines()
    rows = lines[lines.index(r"\midrule") + 1 : lines.index(r"\bottomrule")]
    names = r'carry & ["op", "ro"] & a\_b & cover'
    assert rows[0] == rf"{names} & 27.00 $\pm$ 0.50 & 0.920 $\pm$ 0.010 & 0.120 $\pm$ 0.020 \\"
    assert rows[1].split(" & ")[2] == r"c\&d"
    assert rows[2].endswith(r"0.33 & -- & -- \\")
    assert {row.replace(r"\&", "").count("&") for row in [*rows, lines[3]]} == {6}
    assert result_tables.latex([]).count("tabular") == 2
