"""`comparison.json`: methods beside each other on the same scenes, as `keyss compare` found them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from keyss._version import __version__
from keyss.methods.base import Capabilities


@dataclass(frozen=True, kw_only=True)
class SceneScores:
    """A scene on its test views."""

    psnr: float  # dB
    ssim: float  # the 3DGS variant
    lpips: float | None  # with AlexNet; None where its weights are not installed
    render_ratio: float  # time of a picture over that of the plain model's
    pruned_loss: float | None = None  # dB after the loss of a random quarter; None: it does not open then


@dataclass(frozen=True, kw_only=True)
class ComparedMethod:
    """One method. What it could not do is in `error`, and then nothing else was measured."""

    version: int = 1
    name: str  # METHOD, or METHOD:PRESET where it is not the first
    error: str | None = None
    capabilities: Capabilities = field(default_factory=Capabilities)
    most_secrets: int = 1
    cover: SceneScores | None = None
    secret: SceneScores | None = None
    wrong_keys: float | None = None  # dB against the cover, mean; None where a wrong key opens nothing
    steps: int = 0  # of its own training, after plain models
    gaussians: int = 0  # that are published
    published_bytes: int = 0
    handed_bytes: int = 0  # beside what is published
    seconds: float = 0.0  # of hiding, without plain models


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """All of them."""

    version: int = 1
    keyss: str = __version__
    arguments: dict[str, Any]
    methods: tuple[ComparedMethod, ...] = ()


def table(found: Comparison) -> list[list[str]]:
    """Rows of text, the heads first: for terminals and for Markdown."""
    heads = ["method", "cover", "SSIM", "LPIPS", "secret", "SSIM", "LPIPS", "wrong keys", "published"]
    heads += ["handed over", "standard", "keys", "secrets", "render", "seconds", "a quarter lost"]
    return [heads, *(_row(each) for each in found.methods)]


def _row(each: ComparedMethod) -> list[str]:
    if each.cover is None or each.secret is None:
        return [each.name, f"not possible: {each.error}", *[""] * 14]
    able = each.capabilities
    losses = [scene.pruned_loss for scene in (each.cover, each.secret)]
    lost = ["gone" if loss is None else f"{-loss:+.1f} dB" for loss in losses]
    return [
        each.name,
        *_scores(each.cover),
        *_scores(each.secret),
        "open nothing" if able.keys and each.wrong_keys is None else _decibel(each.wrong_keys),
        _size(each.published_bytes),
        _size(each.handed_bytes) if each.handed_bytes else "nothing",
        "yes" if able.standard else "no",
        "yes" if able.keys else "no",
        f"{each.most_secrets}",
        f"{each.cover.render_ratio:.1f}x, {each.secret.render_ratio:.1f}x",
        f"{each.seconds:.0f}",
        f"{lost[0]}, {lost[1]}",
    ]


def _scores(scene: SceneScores) -> list[str]:
    return [f"{scene.psnr:.2f}", f"{scene.ssim:.3f}", "" if scene.lpips is None else f"{scene.lpips:.3f}"]


def _decibel(value: float | None) -> str:
    return "none" if value is None else f"{value:.2f}"


def _size(count: int) -> str:
    return f"{count / 1e6:,.2f} MB"


def markdown(found: Comparison) -> str:
    """The table in Markdown."""
    heads, *rows = (" | ".join(cell.replace("|", "/") for cell in row) for row in table(found))
    rule = " | ".join("---" for _ in heads.split(" | "))
    return "\n".join(f"| {line} |" for line in (heads, rule, *rows)) + "\n"
