from .errors import (
    BackendError as BackendError,
    InputError as InputError,
    Interrupted as Interrupted,
    KeyssError as KeyssError,
    KeyssWarning as KeyssWarning,
    OutputError as OutputError,
    QualityError as QualityError,
    UsageError as UsageError,
    WrongKeyError as WrongKeyError,
    import_extra as import_extra,
    signal_of as signal_of,
)
from .gaussians import (
    DRAWN_OPACITY as DRAWN_OPACITY,
    OPPONENT as OPPONENT,
    SH_C0 as SH_C0,
    Gaussians as Gaussians,
)
from .picture_network import DecodedGaussians as DecodedGaussians, PictureNetwork as PictureNetwork
from .scene import (
    Camera as Camera,
    Scene as Scene,
    View as View,
    ViewOptions as ViewOptions,
    camera_positions as camera_positions,
    focus_point as focus_point,
)
from .similarity import Similarity as Similarity, align as align, up_direction as up_direction
