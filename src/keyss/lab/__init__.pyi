from .auc import Auc as Auc, auc_between as auc_between
from .baselines.baseline_options import BaselineOptions as BaselineOptions
from .distances import (
    against_controls as against_controls,
    attribute_distances as attribute_distances,
    composite_score as composite_score,
    sinkhorn_3d as sinkhorn_3d,
)
from .leaks.attacks import (
    Attack as Attack,
    decoder_attack as decoder_attack,
    file_attacks as file_attacks,
    search_embeddings as search_embeddings,
)
from .leaks.leak_scores import (
    AttackResult as AttackResult,
    fit_colours as fit_colours,
    gradient_correlation as gradient_correlation,
    leak_scores as leak_scores,
    look_for_secret as look_for_secret,
)
from .render_time import RenderTime as RenderTime, measure_render_time as measure_render_time
from .robustness.changes import (
    Change as Change,
    cropping as cropping,
    fewer_harmonics as fewer_harmonics,
    fine_tuning as fine_tuning,
    half_floats as half_floats,
    noise as noise,
    opacity_pruning as opacity_pruning,
    purification as purification,
    random_pruning as random_pruning,
)
from .robustness.converters import Converter as Converter, converters as converters, transform as transform
from .robustness.survival import ChangedQuality as ChangedQuality, measure_robustness as measure_robustness
from .stealth.judging import (
    changed_low_bits as changed_low_bits,
    judge as judge,
    stealth_statistics as stealth_statistics,
)
from .stegexpose import score_image as score_image, stegexpose_auc as stegexpose_auc
from .two_sample import features as features, two_sample_auc as two_sample_auc
