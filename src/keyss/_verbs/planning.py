"""`plan`: what `hide` will do, and what it will take."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from keyss._verbs.asking import Secret, inputs_of, method_for
from keyss.core.gaussians import Gaussians
from keyss.core.scene import Scene
from keyss.methods.base import MethodOptions
from keyss.rendering import Backend, resolve_device
from keyss.runs.config import Background, PathLike
from keyss.runs.opening import as_scene
from keyss.runs.planning import Plan, check_disk, plan_hiding


def plan(
    cover: PathLike | Scene | Gaussians,
    secrets: Sequence[Secret],
    *,
    method: str | MethodOptions = "learned",
    width: int | None = None,
    background: Background = None,
    skip_missing: bool = False,
    cover_model: PathLike | Gaussians | None = None,
    bound: bool = False,
    device: Backend = "auto",
    out: PathLike | None = None,
) -> Plan:
    """What `hide` with these arguments will do, and what it will take: see `keyss.runs.planning`.

    Refuses what `hide` would refuse before its first step, renders and trains for some seconds to time it,
    and writes nothing. `out`: where the results would go; room for them is looked for. Raises
    KeyssError and its children.
    """
    chosen, options = method_for(method, secrets)
    target = resolve_device(device)
    sources = [cover, *(secret.scene for secret in secrets)]
    models = [cover_model, *(secret.model for secret in secrets)]
    inputs = inputs_of(sources, models)
    options = chosen.prepare(inputs, options)
    if out is not None:
        check_disk(Path(out), chosen, options, inputs)
    scenes = [
        as_scene(source, width, background, train_pictures=False, skip_missing=skip_missing)
        for source in sources
    ]
    place = None if out is None else Path(out)
    return plan_hiding(chosen, options, inputs, scenes, target, place, bound=bound)
