"""How well a hiding works: fidelity, stealth, leaks, robustness, speed."""

from typing import TYPE_CHECKING

from keyss._lazy import lazily

if TYPE_CHECKING:
    from keyss.measure.auc import (
        Auc as Auc,
        StegExposeAuc as StegExposeAuc,
        auc_between as auc_between,
        stegexpose_auc as stegexpose_auc,
    )
    from keyss.measure.distances import (
        AttributeDistance as AttributeDistance,
        against_controls as against_controls,
        attribute_distances as attribute_distances,
    )
    from keyss.measure.hiding import (
        BaselineQuality as BaselineQuality,
        HidingQuality as HidingQuality,
        PsnrRange as PsnrRange,
        RenderFidelity as RenderFidelity,
        WrongKeys as WrongKeys,
        measure_hiding as measure_hiding,
    )
    from keyss.measure.images import ImageComparison as ImageComparison, compare_images as compare_images
    from keyss.measure.leaks.attacks import (
        decoder_attack as decoder_attack,
        file_attacks as file_attacks,
        search_embeddings as search_embeddings,
    )
    from keyss.measure.leaks.looking import AttackResult as AttackResult, look_for_secret as look_for_secret
    from keyss.measure.robustness.changes import (
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
    from keyss.measure.robustness.conversions import Converter as Converter, converters as converters
    from keyss.measure.robustness.survival import (
        BreakdownPoint as BreakdownPoint,
        ChangeResult as ChangeResult,
        ChangedQuality as ChangedQuality,
        Reopened as Reopened,
        Reopener as Reopener,
        StrengthLosses as StrengthLosses,
        breakdown_points as breakdown_points,
        mean_over_draws as mean_over_draws,
        measure_robustness as measure_robustness,
    )
    from keyss.measure.sinkhorn import composite_score as composite_score, sinkhorn_3d as sinkhorn_3d
    from keyss.measure.speed import (
        FileSize as FileSize,
        ReaderResult as ReaderResult,
        SpeedResult as SpeedResult,
        measure_speed as measure_speed,
        readers as readers,
        render_time as render_time,
    )
    from keyss.measure.stealth.confirmation import (
        candidate_scores as candidate_scores,
        changed_low_bits as changed_low_bits,
    )
    from keyss.measure.stealth.judging import judge as judge, stealth_statistics as stealth_statistics
    from keyss.measure.stegexpose import (
        csv_bytes as csv_bytes,
        score_file as score_file,
        score_image as score_image,
        steganalyze as steganalyze,
    )
    from keyss.measure.two_sample import (
        two_sample_against_controls as two_sample_against_controls,
        two_sample_auc as two_sample_auc,
    )
else:
    __getattr__, __dir__, __all__ = lazily(
        __name__,
        {
            "keyss.measure.auc": ["Auc", "StegExposeAuc", "auc_between", "stegexpose_auc"],
            "keyss.measure.distances": ["AttributeDistance", "against_controls", "attribute_distances"],
            "keyss.measure.hiding": [
                "BaselineQuality",
                "HidingQuality",
                "PsnrRange",
                "RenderFidelity",
                "WrongKeys",
                "measure_hiding",
            ],
            "keyss.measure.images": ["ImageComparison", "compare_images"],
            "keyss.measure.leaks.attacks": ["decoder_attack", "file_attacks", "search_embeddings"],
            "keyss.measure.leaks.looking": ["AttackResult", "look_for_secret"],
            "keyss.measure.robustness.changes": [
                "Change",
                "cropping",
                "fewer_harmonics",
                "fine_tuning",
                "half_floats",
                "noise",
                "opacity_pruning",
                "purification",
                "random_pruning",
            ],
            "keyss.measure.robustness.conversions": ["Converter", "converters"],
            "keyss.measure.robustness.survival": [
                "BreakdownPoint",
                "ChangeResult",
                "ChangedQuality",
                "Reopened",
                "Reopener",
                "StrengthLosses",
                "breakdown_points",
                "mean_over_draws",
                "measure_robustness",
            ],
            "keyss.measure.sinkhorn": ["composite_score", "sinkhorn_3d"],
            "keyss.measure.speed": [
                "FileSize",
                "ReaderResult",
                "SpeedResult",
                "measure_speed",
                "readers",
                "render_time",
            ],
            "keyss.measure.stealth.confirmation": ["candidate_scores", "changed_low_bits"],
            "keyss.measure.stealth.judging": ["judge", "stealth_statistics"],
            "keyss.measure.stegexpose": ["csv_bytes", "score_file", "score_image", "steganalyze"],
            "keyss.measure.two_sample": ["two_sample_against_controls", "two_sample_auc"],
        },
    )
