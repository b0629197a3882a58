"""The tables that can be reproduced: runs, measures, the paper's figures, and its conclusions from them."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, Literal

from keyss.many.paper import published
from keyss.many.paper.claims import TIE, Claim, Part, above
from keyss.many.paper.published import Figure

TableName = Literal["single", "multi", "masks", "combined", "pruning", "sinkhorn", "speed"]

SSIM_WEIGHT = 0.5  # of the loss, for plain models too
BEST_MASK = "op,ro,sc,xyz"
BOTH = "both"
_HALF = 0.5  # dB
_LABELS = {
    "3dgs": "3DGS",
    "3dgs-sh": "3DGS+SH",
    "3dgs-decoder": "3DGS+Decoder",
    "gs-hider": "GS-Hider",
    "watergs": "WaterGS",
    "keyss": "KeySS",
}


@dataclass(frozen=True, kw_only=True)
class Run:
    """A hiding with the paper's settings, except `changes` of the method's options, and its row."""

    name: str
    label: str
    figures: Mapping[str, Figure]  # published, by measure; none of ours
    method: str = "keyss"
    changes: Mapping[str, Any] = field(default_factory=dict)
    secrets: int = 1
    kept: bool = False  # not run for this table, but shown if it was


@dataclass(frozen=True, kw_only=True)
class Table:
    """One table of the paper."""

    name: TableName
    title: str  # and where it stands in the paper
    measures: tuple[str, ...] = ()  # beyond those of every hiding
    runs: Sequence[Run]
    claims: Sequence[Claim]

    @property
    def secrets(self) -> int:
        """Number of secrets of a group of scenes."""
        return max(each.secrets for each in self.runs)


# KeySS with its default design, whose figures nobody has published.
_OURS: dict[str, Any] = {"figures": {}, "changes": {"design": "carriers"}}


def _of_methods(figures: Mapping[str, Mapping[str, Figure]]) -> list[Run]:
    return [Run(name=name, label=_LABELS[name], figures=own, method=name) for name, own in figures.items()]


def _of_masks(figures: Mapping[str, Mapping[str, Figure]], run: Collection[str]) -> list[Run]:
    """KeySS with several masks; those that are not to be run are kept."""
    changes = {mask: {"mask": tuple(mask.split(","))} if mask != BEST_MASK else {} for mask in figures}
    return [
        Run(name=_masked(mask), label=mask, figures=own, changes=changes[mask], kept=mask not in run)
        for mask, own in figures.items()
    ]


def _masked(mask: str) -> str:
    return "keyss" if mask == BEST_MASK else f"keyss-{mask.replace(',', '-')}"


def _combined_from(points: str, poses: str, gradients: str) -> str:
    """The name of KeySS with points, poses and gradients of some scenes only."""
    whose = (points, poses, gradients)
    return "keyss" if set(whose) == {BOTH} else f"keyss-of-{'-'.join(whose)}"


def _wrong_keys(run: str, secret: str) -> Claim:
    return Claim(
        "A wrong key shows the cover (at most 0.5 dB worse), and not the secret (10 dB worse or more)",
        (
            Part((run, "cover"), (run, "wrong key, cover"), most=_HALF),
            Part((run, secret), (run, "wrong key, secret"), least=10.0),
        ),
    )


def _single() -> Table:
    rivals = ("gs-hider", "3dgs-sh", "3dgs-decoder")
    return Table(
        name="single",
        title="One secret (Table 1)",
        runs=[*_of_methods(published.SINGLE), Run(name="keyss-ours", label="KeySS, ours", **_OURS)],
        claims=(
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


def _multi() -> Table:
    alone = published.SINGLE["keyss"]["cover"]
    assert isinstance(alone, Mapping)
    covers = {cover: alone[cover] for cover, *_ in published.TRIPLES}
    return Table(
        name="multi",
        title="Two secrets (Table 2)",
        runs=(
            Run(name="keyss", label="KeySS, the first secret alone", figures={"cover": covers}),
            Run(name="keyss-two", label="KeySS, two secrets", figures=published.MULTI, secrets=2),
            Run(name="keyss-ours", label="KeySS, ours, the first secret alone", **_OURS),
            Run(name="keyss-ours-two", label="KeySS, ours, two secrets", secrets=2, **_OURS),
        ),
        claims=(
            Claim(
                "A second secret costs the cover little (at most 0.5 dB)",
                (Part(("keyss", "cover"), ("keyss-two", "cover"), most=_HALF),),
            ),
            _wrong_keys("keyss-two", "secret 1"),
        ),
    )


def _masks() -> Table:
    others = [_masked(mask) for mask in published.MASKS if mask != BEST_MASK]
    alone = [_masked(mask) for mask in ("ro", "sc", "xyz", "sh")]
    without = ("op", "op,ro", "op,ro,xyz", BEST_MASK)
    harmonics = [((_masked(mask), "secret"), (_masked(f"{mask},sh"), "secret")) for mask in without]
    return Table(
        name="masks",
        title="Attributes that the decoder changes (Table 3)",
        measures=("sinkhorn",),
        runs=_of_masks(published.MASKS, published.MASKS),
        claims=(
            Claim(f"{BEST_MASK} has the best score", above("keyss", others, "score", least=0)),
            Claim(f"{BEST_MASK} has the best fidelity", above("keyss", others, "mean of both", least=0)),
            Claim("Opacity is the best single attribute", above(_masked("op"), alone, "mean of both")),
            Claim(
                "To change harmonics as well harms the secret",
                tuple(Part(*each, least=TIE) for each in harmonics),
            ),
        ),
    )


def _combined() -> Table:
    names = ("points", "poses", "densification")
    runs = [
        Run(
            name=_combined_from(*whose),
            label="points of {}, poses of {}, gradients of {}".format(*whose),
            figures=figures,
            changes={name: each for name, each in zip(names, whose, strict=True) if each != BOTH},
        )
        for whose, figures in published.COMBINED.items()
    ]
    others = [each.name for each in runs if each.name != "keyss"]

    def costs(points: str, poses: str, scene: str) -> Part:
        return Part(("keyss", scene), (_combined_from(points, poses, BOTH), scene), least=1.0)

    return Table(
        name="combined",
        title="Combined points, poses and densification (Table 4)",
        runs=runs,
        claims=(
            Claim("All combined is the best mean of both", above("keyss", others, "mean of both", least=0)),
            Claim(
                "Points of one scene alone cost the other 1 dB or more",
                (costs("cover", BOTH, "secret"), costs("secret", BOTH, "cover")),
            ),
            Claim(
                "Poses of one scene alone cost the other 1 dB or more",
                (costs(BOTH, "cover", "secret"), costs(BOTH, "secret", "cover")),
            ),
            Claim(
                "Combined densification is better than that by the cover's gradients",
                above("keyss", [_combined_from(BOTH, BOTH, "cover")], "mean of both"),
            ),
        ),
    )


def _pruning() -> Table:
    def lost(change: str, scene: str, most: float) -> Part:
        return Part(("keyss", f"whole, {scene}"), ("keyss", f"{change}, {scene}"), most=most)

    figures, scenes = published.PRUNING, ("cover", "secret")
    gentle = [name.rpartition(", ") for name in figures if "by opacity" in name]
    costs = {scene: figures[f"whole, {scene}"] - figures[f"25% random, {scene}"] for scene in scenes}
    return Table(
        name="pruning",
        title="What pruning leaves (supplement)",
        measures=("pruning",),
        runs=[
            Run(name="keyss", label="KeySS", figures=figures),
            Run(name="keyss-ours", label="KeySS, ours", **_OURS),
        ],
        claims=(
            Claim(
                "The Gaussians of lowest opacity can be pruned for at most 0.1 dB",
                tuple(lost(change, scene, TIE) for change, _, scene in gentle),
            ),
            Claim(
                "Random loss of a quarter costs at most 0.5 dB more than as published (2.24 and 2.02)",
                tuple(lost("25% random", scene, costs[scene] + _HALF) for scene in scenes),
            ),
        ),
    )


def _sinkhorn() -> Table:
    top = {mask: _masked(mask) for mask in ("op", "op,ro", BEST_MASK)}
    others = [f"sinkhorn {name}" for name in ("op", "ro", "xyz", "sh")]
    scales = [((run, name), (run, "sinkhorn sc")) for run in top.values() for name in others]
    nearer = [((run, "sinkhorn"), ("keyss", "sinkhorn")) for run in top.values() if run != "keyss"]
    return Table(
        name="sinkhorn",
        title="3D-Sinkhorn by attribute (supplement)",
        measures=("sinkhorn",),
        runs=_of_masks(published.SINKHORN, top),
        claims=(
            Claim(
                f"{BEST_MASK} is nearer to plain 3DGS than the other two of the best three masks",
                tuple(Part(*each, least=0) for each in nearer),
            ),
            Claim("Scales differ least of all attributes", tuple(Part(*each, least=0) for each in scales)),
        ),
    )


def _speed() -> Table:
    def times(run: str, least: float = 0.0, most: float = math.inf) -> tuple[Part, ...]:
        measures = [f"time over 3DGS, {scene}" for scene in ("cover", "secret")]
        return tuple(Part((run, measure), least=least, most=most) for measure in measures)

    return Table(
        name="speed",
        title="Speed of rendering (supplement)",
        measures=("rendering",),
        runs=_of_methods(published.SPEED),
        claims=(
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
