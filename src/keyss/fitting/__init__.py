"""Plain 3DGS: losses, density control, the training loop, checkpoints."""

from typing import TYPE_CHECKING

from keyss._lazy import lazily

if TYPE_CHECKING:
    from keyss.fitting.adam import RowAdam as RowAdam
    from keyss.fitting.checkpoint import (
        State as State,
        load_checkpoint as load_checkpoint,
        save_checkpoint as save_checkpoint,
        steps_done as steps_done,
    )
    from keyss.fitting.config import FitConfig as FitConfig, PRESETS as PRESETS
    from keyss.fitting.density import (
        CappedStrategy as CappedStrategy,
        Drawn as Drawn,
        combine_densification as combine_densification,
        draw_views as draw_views,
    )
    from keyss.fitting.image_metrics import (
        ImageQuality as ImageQuality,
        mean_psnr as mean_psnr,
        psnr as psnr,
        quality as quality,
        subsample_views as subsample_views,
    )
    from keyss.fitting.loop import Interrupted as Interrupted, TrainingRun as TrainingRun, train as train
    from keyss.fitting.reporting import Reporter as Reporter, SilentReporter as SilentReporter
    from keyss.fitting.losses import Target as Target, photometric_loss as photometric_loss, ssim as ssim
    from keyss.fitting.parameters import (
        Optimizers as Optimizers,
        Parameters as Parameters,
        initial_gaussians as initial_gaussians,
        initial_points as initial_points,
        make_optimizers as make_optimizers,
        to_gaussians as to_gaussians,
        to_parameters as to_parameters,
    )
    from keyss.fitting.plain import (
        FitResult as FitResult,
        PlainRun as PlainRun,
        fit_scene as fit_scene,
        refit_model as refit_model,
    )
    from keyss.fitting.ranks import Ranks as Ranks, here as here, joined as joined
    from keyss.fitting.sampling import Shuffle as Shuffle, own_randomness as own_randomness
    from keyss.fitting.side_by_side import Fit as Fit, fit_scenes as fit_scenes
else:
    __getattr__, __dir__, __all__ = lazily(
        __name__,
        {
            "keyss.fitting.adam": ["RowAdam"],
            "keyss.fitting.checkpoint": ["State", "load_checkpoint", "save_checkpoint", "steps_done"],
            "keyss.fitting.config": ["FitConfig", "PRESETS"],
            "keyss.fitting.density": ["CappedStrategy", "Drawn", "combine_densification", "draw_views"],
            "keyss.fitting.image_metrics": [
                "ImageQuality",
                "mean_psnr",
                "psnr",
                "quality",
                "subsample_views",
            ],
            "keyss.fitting.loop": ["Interrupted", "TrainingRun", "train"],
            "keyss.fitting.reporting": ["Reporter", "SilentReporter"],
            "keyss.fitting.losses": ["Target", "photometric_loss", "ssim"],
            "keyss.fitting.parameters": [
                "Optimizers",
                "Parameters",
                "initial_gaussians",
                "initial_points",
                "make_optimizers",
                "to_gaussians",
                "to_parameters",
            ],
            "keyss.fitting.plain": ["FitResult", "PlainRun", "fit_scene", "refit_model"],
            "keyss.fitting.ranks": ["Ranks", "here", "joined"],
            "keyss.fitting.sampling": ["Shuffle", "own_randomness"],
            "keyss.fitting.side_by_side": ["Fit", "fit_scenes"],
        },
    )
