"""Size and length of the joint training where nothing but models is given."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from keyss.methods.base import SceneInput
from keyss.methods.learned.options import LearnedOptions

ITERATIONS = 400  # at most
GENTLE = 0.1  # factor on the rates


def sized(options: LearnedOptions, inputs: Sequence[SceneInput]) -> LearnedOptions:
    """`options` for the cover and secrets of `inputs`; unchanged where one of them has photos.

    Where models are all there is, the published model holds the Gaussians of all of them unless
    `options.max_gaussians` says otherwise. If nothing has to be left out the start is right already: the
    training is short and gentle, for large steps would only do harm.
    """
    models = [each.model for each in inputs if each.model is not None and not each.photos]
    total = sum(len(model) for model in models)
    if len(models) < len(inputs) or (options.max_gaussians or total) < total:
        return options
    fit = replace(
        options.fit,
        iterations=options.iterations or min(options.fit.iterations, ITERATIONS),
        max_gaussians=options.max_gaussians or max(16, total),
        # Degree 1 is the least: spherical harmonics above the constant ones are where most low bits are.
        sh_degree=max(1, *(model.sh_degree for model in models)),
    )
    return replace(options, fit=fit, warm_rate=GENTLE * options.warm_rate)
