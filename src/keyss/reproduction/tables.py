"""The tables that can be made again: runs, measures, the paper's figures, and what it concludes from them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, Literal

from keyss.reproduction import published
from keyss.reproduction.claims import TIE, Claim, Part, Place, above
from keyss.reproduction.published import Figure

TableName = Literal["single", "multi", "masks", "combined", "pruning", "sinkhorn", "speed"]
Measure = Literal["quality", "sinkhorn", "pruning", "speed"]

BEST_MASK = "op,ro,sc,xyz"
PRUNED = tuple(published.PRUNING)
_HALF = 0.5  # dB


@dataclass(frozen=True)
class Cell:
    """A hiding, by the settings of the paper but for `changes` of a method's options."""

    name: str
    method: str
    changes: Mapping[str, Any] = field(default_factory=dict)
    secrets: int = 1


@dataclass(frozen=True)
class Row:
    """Published figures of one run, by measure."""

    label: str
    cell: str
    figures: Mapping[str, Figure]


@dataclass(frozen=True)
class Table:
    """One table of the paper."""

    name: TableName
    title: str  # and where it stands in the paper
    cells: tuple[Cell, ...]
    measures: tuple[Measure, ...]
    rows: tuple[Row, ...]
    claims: tuple[Claim, ...]
    kept: tuple[Cell, ...] = ()  # not run for this table, and shown where another one ran them

    @property
    def secrets(self) -> int:
        """How many a pair of scenes must have."""
        return max(each.secrets for each in self.cells)


KEYSS = Cell("keyss", "learned")
BOUND, SH, DECODER, GS_HIDER, WATERGS = (
    Cell(name, name) for name in ("3dgs", "3dgs-sh", "3dgs-decoder", "gs-hider", "watergs")
)
TWO = Cell("keyss-two", "learned", secrets=2)


def mask_cell(mask: str) -> Cell:
    """KeySS with another mask."""
    if mask == BEST_MASK:
        return KEYSS
    return Cell(f"keyss-{mask.replace(',', '-')}", "learned", {"mask": tuple(mask.split(","))})


def combined_cell(whose: tuple[str, str, str]) -> Cell:
    """KeySS with points, poses and gradients of some scenes only."""
    if whose == ("both",) * 3:
        return KEYSS
    names = ("points", "poses", "densification")
    return Cell(f"keyss-of-{'-'.join(whose)}", "learned", dict(zip(names, whose, strict=True)))


def _single() -> Table:
    labels = {
        "3dgs": "3DGS, as many steps",
        "3dgs-sh": "3DGS+SH",
        "3dgs-decoder": "3DGS+Decoder",
        "gs-hider": "GS-Hider",
        "keyss": "KeySS",
    }
    rivals = ("gs-hider", "3dgs-sh", "3dgs-decoder")
    return Table(
        "single",
        "One secret (Table 1)",
        (BOUND, SH, DECODER, GS_HIDER, KEYSS),
        ("quality",),
        tuple(Row(label, cell, published.SINGLE[cell]) for cell, label in labels.items()),
        (
            Claim("KeySS's cover is better than those of its rivals", above("keyss", rivals, "cover")),
            Claim("KeySS's secret is better than those of its rivals", above("keyss", rivals, "secret")),
            Claim(
                "KeySS's cover is at most 0.64 dB below plain 3DGS (0.54 as published)",
                (Part(("3dgs", "cover"), ("keyss", "cover"), most=0.538 + TIE),),
            ),
            Claim(
                "GS-Hider's secret is better than 3DGS+SH's, and that better than 3DGS+Decoder's",
                tuple(Part((a, "secret"), (b, "secret"), least=TIE) for a, b in pairwise(rivals)),
            ),
            _wrong_keys("keyss", "secret"),
        ),
    )


def _wrong_keys(cell: str, secret: str) -> Claim:
    return Claim(
        "A wrong key shows the cover (at most 0.5 dB worse), and not the secret (10 dB worse or more)",
        (
            Part((cell, "cover"), (cell, "wrong key, cover"), most=_HALF),
            Part((cell, secret), (cell, "wrong key, secret"), least=10.0),
        ),
    )


def _multi() -> Table:
    covers = [cover for cover, *_ in published.TRIPLES]
    alone = published.SINGLE["keyss"]["cover"]
    assert isinstance(alone, Mapping)
    return Table(
        "multi",
        "Two secrets (Table 2)",
        (KEYSS, TWO),
        ("quality",),
        (
            Row("KeySS, the first secret alone", "keyss", {"cover": {name: alone[name] for name in covers}}),
            Row("KeySS, two secrets", "keyss-two", published.MULTI),
        ),
        (
            Claim(
                "A second secret costs the cover little (at most 0.5 dB)",
                (Part(("keyss", "cover"), ("keyss-two", "cover"), most=_HALF),),
            ),
            _wrong_keys("keyss-two", "secret 1"),
        ),
    )


def _masks() -> Table:
    cells = {mask: mask_cell(mask) for mask in published.MASKS}
    others = [cell.name for mask, cell in cells.items() if mask != BEST_MASK]
    alone = [cells[mask].name for mask in ("ro", "sc", "xyz", "sh")]
    harmonics = (("op", "op,sh"), ("op,ro", "op,ro,sh"), ("op,ro,xyz", "op,ro,xyz,sh"))
    pairs = [(cells[a].name, cells[b].name) for a, b in (*harmonics, (BEST_MASK, f"{BEST_MASK},sh"))]
    return Table(
        "masks",
        "Attributes that the decoder changes (Table 3)",
        tuple(cells.values()),
        ("quality", "sinkhorn"),
        tuple(Row(mask, cells[mask].name, figures) for mask, figures in published.MASKS.items()),
        (
            Claim(f"{BEST_MASK} has the best score", above("keyss", others, "score", least=0)),
            Claim(f"{BEST_MASK} has the best fidelity", above("keyss", others, "mean of both", least=0)),
            Claim("Opacity is the best single attribute", above(cells["op"].name, alone, "mean of both")),
            Claim(
                "To change harmonics as well harms the secret",
                tuple(Part((a, "secret"), (b, "secret"), least=TIE) for a, b in pairs),
            ),
        ),
    )


def _combined() -> Table:
    cells = {whose: combined_cell(whose) for whose in published.COMBINED}
    others = [cell.name for cell in cells.values() if cell is not KEYSS]
    both = "both"

    def costs(whose: tuple[str, str, str], scene: str) -> Part:
        return Part(("keyss", scene), (cells[whose].name, scene), least=1.0)

    return Table(
        "combined",
        "Combined points, poses and densification (Table 4)",
        tuple(cells.values()),
        ("quality",),
        tuple(
            Row(
                f"points of {whose[0]}, poses of {whose[1]}, gradients of {whose[2]}",
                cells[whose].name,
                row,
            )
            for whose, row in published.COMBINED.items()
        ),
        (
            Claim("All combined is the best mean of both", above("keyss", others, "mean of both", least=0)),
            Claim(
                "Points of one scene alone cost the other 1 dB or more",
                (costs(("cover", both, both), "secret"), costs(("secret", both, both), "cover")),
            ),
            Claim(
                "Poses of one scene alone cost the other 1 dB or more",
                (costs((both, "cover", both), "secret"), costs((both, "secret", both), "cover")),
            ),
            Claim(
                "Combined densification is better than that by the cover's gradients",
                above("keyss", [cells[both, both, "cover"].name], "mean of both"),
            ),
        ),
    )


def pruned(how: str, share: float, scene: str) -> str:
    """The name of a measure: PSNR after pruning."""
    return f"{share:.0%} {how}, {scene}"


def _pruning() -> Table:
    figures: dict[str, Figure] = dict(published.WHOLE)
    for share, row in published.PRUNING.items():
        names = [pruned(how, share, scene) for how in ("by opacity", "random") for scene in published.WHOLE]
        figures |= dict(zip(names, row, strict=True))

    def lost(how: str, share: float, scene: str, most: float) -> Part:
        return Part(("keyss", f"whole, {scene}"), ("keyss", pruned(how, share, scene)), most=most)

    figures |= {f"whole, {scene}": value for scene, value in published.WHOLE.items()}
    last = published.PRUNING[PRUNED[-1]]
    found = dict(zip(published.WHOLE, last[2:], strict=True))
    return Table(
        "pruning",
        "What pruning leaves (supplement)",
        (KEYSS,),
        ("quality", "pruning"),
        (
            Row(
                "KeySS",
                "keyss",
                {name: each for name, each in figures.items() if name not in published.WHOLE},
            ),
        ),
        (
            Claim(
                "The Gaussians of lowest opacity can be pruned for at most 0.1 dB",
                tuple(lost("by opacity", s, scene, TIE) for s in PRUNED for scene in published.WHOLE),
            ),
            Claim(
                "Random loss of a quarter costs at most 0.5 dB more than as published (2.24 and 2.02)",
                tuple(
                    lost("random", PRUNED[-1], scene, published.WHOLE[scene] - after + _HALF)
                    for scene, after in found.items()
                ),
            ),
        ),
    )


def _sinkhorn() -> Table:
    top = ("op", "op,ro", BEST_MASK)
    cells = {mask: mask_cell(mask) for mask in published.SINKHORN}
    others = [f"sinkhorn {name}" for name in ("op", "ro", "xyz", "sh")]
    return Table(
        "sinkhorn",
        "3D-Sinkhorn by attribute (supplement)",
        tuple(cells[mask] for mask in top),
        ("sinkhorn",),
        tuple(Row(mask, cells[mask].name, figures) for mask, figures in published.SINKHORN.items()),
        (
            Claim(
                f"{BEST_MASK} is nearer to plain 3DGS than the other two of the best three masks",
                tuple(
                    Part((cells[mask].name, "sinkhorn"), ("keyss", "sinkhorn"), least=0) for mask in top[:2]
                ),
            ),
            Claim(
                "Scales differ least of all attributes",
                tuple(
                    Part((cells[mask].name, name), (cells[mask].name, "sinkhorn sc"), least=0)
                    for mask in top
                    for name in others
                ),
            ),
        ),
        kept=tuple(cell for mask, cell in cells.items() if mask not in top),
    )


def _speed() -> Table:
    fastest = published.SPEED["3dgs"][0]
    rows = []
    for name, (cover, secret, opens) in published.SPEED.items():
        rates = {"cover": cover} | ({} if secret is None else {"secret": secret})
        figures: dict[str, Figure] = {f"pictures/s, {scene}": rate for scene, rate in rates.items()}
        figures |= {f"time over 3DGS, {scene}": fastest / rate for scene, rate in rates.items()}
        label = {"3dgs": "3DGS", "gs-hider": "GS-Hider", "watergs": "WaterGS", "keyss": "KeySS"}[name]
        rows.append(Row(label, name, figures | {"standard": float(opens)}))

    def times(cell: str, least: float = 0.0, most: float = math.inf) -> tuple[Part, ...]:
        places: list[Place] = [(cell, f"time over 3DGS, {scene}") for scene in ("cover", "secret")]
        return tuple(Part(place, least=least, most=most) for place in places)

    return Table(
        "speed",
        "Speed of rendering (supplement)",
        (BOUND, GS_HIDER, WATERGS, KEYSS),
        ("quality", "speed"),
        tuple(rows),
        (
            Claim("KeySS renders as fast as 3DGS (at most 1.1 times as long)", times("keyss", most=1.1)),
            Claim(
                "GS-Hider takes 1.5 times as long or more (2.9 as published)", times("gs-hider", least=1.5)
            ),
            Claim(
                "KeySS and WaterGS publish a standard model, and GS-Hider does not",
                (
                    Part(("keyss", "standard"), least=1),
                    Part(("watergs", "standard"), least=1),
                    Part(("gs-hider", "standard"), most=0),
                ),
            ),
        ),
    )


TABLES: Mapping[str, Table] = {
    each.name: each
    for each in (_single(), _multi(), _masks(), _combined(), _pruning(), _sinkhorn(), _speed())
}
