from .auc import (
    Auc as Auc,
    StegExposeAuc as StegExposeAuc,
    auc_between as auc_between,
    stegexpose_auc as stegexpose_auc,
)
from .distances import (
    AttributeDistance as AttributeDistance,
    against_controls as against_controls,
    attribute_distances as attribute_distances,
)
from .hiding import (
    BaselineQuality as BaselineQuality,
    HidingQuality as HidingQuality,
    PsnrRange as PsnrRange,
    RenderFidelity as RenderFidelity,
    WrongKeys as WrongKeys,
    measure_hiding as measure_hiding,
)
from .images import ImageComparison as ImageComparison, compare_images as compare_images
from .leaks.attacks import (
    decoder_attack as decoder_attack,
    file_attacks as file_attacks,
    search_embeddings as search_embeddings,
)
from .leaks.looking import AttackResult as AttackResult, look_for_secret as look_for_secret
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
from .robustness.conversions import Converter as Converter, converters as converters
from .robustness.survival import (
    BreakdownPoint as BreakdownPoint,
    ChangedQuality as ChangedQuality,
    ChangeResult as ChangeResult,
    Reopened as Reopened,
    Reopener as Reopener,
    StrengthLosses as StrengthLosses,
    breakdown_points as breakdown_points,
    mean_over_draws as mean_over_draws,
    measure_robustness as measure_robustness,
)
from .sinkhorn import composite_score as composite_score, sinkhorn_3d as sinkhorn_3d
from .speed import (
    FileSize as FileSize,
    ReaderResult as ReaderResult,
    SpeedResult as SpeedResult,
    measure_speed as measure_speed,
    readers as readers,
    render_time as render_time,
)
from .stealth.confirmation import candidate_scores as candidate_scores, changed_low_bits as changed_low_bits
from .stealth.judging import judge as judge, stealth_statistics as stealth_statistics
from .stegexpose import (
    csv_bytes as csv_bytes,
    score_file as score_file,
    score_image as score_image,
    steganalyze as steganalyze,
)
from .two_sample import (
    two_sample_against_controls as two_sample_against_controls,
    two_sample_auc as two_sample_auc,
)
