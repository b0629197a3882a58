from .adam import RowAdam as RowAdam
from .config import PRESETS as PRESETS, FitConfig as FitConfig
from .density import CappedStrategy as CappedStrategy
from .image_metrics import (
    ImageQuality as ImageQuality,
    mean_psnr as mean_psnr,
    psnr as psnr,
    quality as quality,
)
from .loop import (
    State as State,
    TrainingRun as TrainingRun,
    load_checkpoint as load_checkpoint,
    own_randomness as own_randomness,
    save_checkpoint as save_checkpoint,
    train as train,
)
from .losses import (
    Target as Target,
    photometric_loss as photometric_loss,
    ssim as ssim,
    ssim_torch as ssim_torch,
)
from .parameters import (
    Optimizers as Optimizers,
    Parameters as Parameters,
    make_optimizers as make_optimizers,
    to_parameters as to_parameters,
)
from .plain import PlainRun as PlainRun, fit_scene as fit_scene
from .schedule import Schedule as Schedule
