"""Plain data: Gaussians, cameras, scenes, similarity transforms, errors."""

from typing import TYPE_CHECKING

from keyss._lazy import lazily

if TYPE_CHECKING:
    from keyss.core.alignment import align as align, up_direction as up_direction
    from keyss.core.decoded import DecodedGaussians as DecodedGaussians, PictureNetwork as PictureNetwork
    from keyss.core.errors import (
        BackendError as BackendError,
        InputError as InputError,
        Interrupted as Interrupted,
        KeyssError as KeyssError,
        KeyssWarning as KeyssWarning,
        OtherProcessError as OtherProcessError,
        OutputError as OutputError,
        QualityError as QualityError,
        UsageError as UsageError,
        WrongKeyError as WrongKeyError,
        signal_of as signal_of,
    )
    from keyss.core.extras import import_extra as import_extra
    from keyss.core.gaussians import (
        DRAWN_OPACITY as DRAWN_OPACITY,
        Gaussians as Gaussians,
        SH_C0 as SH_C0,
        same_bits as same_bits,
    )
    from keyss.core.pruning_compensation import compensate_pruning as compensate_pruning
    from keyss.core.scene import (
        Camera as Camera,
        Scene as Scene,
        View as View,
        ViewOptions as ViewOptions,
        camera_positions as camera_positions,
        focus_point as focus_point,
    )
    from keyss.core.similarity import Similarity as Similarity
else:
    __getattr__, __dir__, __all__ = lazily(
        __name__,
        {
            "keyss.core.alignment": ["align", "up_direction"],
            "keyss.core.decoded": ["DecodedGaussians", "PictureNetwork"],
            "keyss.core.errors": [
                "BackendError",
                "InputError",
                "Interrupted",
                "KeyssError",
                "KeyssWarning",
                "OtherProcessError",
                "OutputError",
                "QualityError",
                "UsageError",
                "WrongKeyError",
                "signal_of",
            ],
            "keyss.core.extras": ["import_extra"],
            "keyss.core.gaussians": ["DRAWN_OPACITY", "Gaussians", "SH_C0", "same_bits"],
            "keyss.core.pruning_compensation": ["compensate_pruning"],
            "keyss.core.scene": ["Camera", "Scene", "View", "ViewOptions", "camera_positions", "focus_point"],
            "keyss.core.similarity": ["Similarity"],
        },
    )
