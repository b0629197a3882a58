"""The upper bound: two plain 3DGS models (Kerbl et al. 2023), one published, one a companion file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

from keyss.core.gaussians import Gaussians
from keyss.lab.baselines.baseline import Baseline, CompanionTensors, Show
from keyss.lab.baselines.baseline_options import BaselineOptions, BoundOptions
from keyss.methods.method import Capabilities, Context, Plan, Prepared, Source, Stego

_NAMES = tuple(field.name for field in fields(Gaussians))


@dataclass(frozen=True)
class BoundMethod(Baseline):
    """See `keyss.methods.method.Method`."""

    def prepare(
        self, sources: Sequence[Source], options: BaselineOptions, earlier: Prepared | None = None
    ) -> Prepared:
        """Both models, unchanged."""
        fit = options.fit
        cover, secret = (
            fit.max_gaussians if source.given is None else len(source.given) for source in sources
        )
        degree = fit.sh_degree if sources[0].given is None else sources[0].given.sh_degree
        plan = Plan(gaussians=cover, sh_degree=degree, secret_gaussians=secret, capacity=secret)
        return Prepared.of(options, len(sources), plan)

    def hide(self, sources: Sequence[Source], prepared: Prepared, context: Context) -> Stego:
        """Write the secret's model to a companion file."""
        cover, secret = sources
        return self.stego(cover.model, CompanionTensors(vars(secret.model)))


def _open(companion: CompanionTensors) -> Show:
    model = Gaussians(*companion.take(_NAMES))
    return lambda stego: model


METHOD = BoundMethod(options=BoundOptions, capabilities=Capabilities(keys=False), open=_open)
