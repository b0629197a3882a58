from .carry.carry_method import (
    CarriedSecret as CarriedSecret,
    embed_models as embed_models,
    most_contributing as most_contributing,
)
from .carry.carry_options import CarryOptions as CarryOptions
from .codec.precision import (
    choose_precision as choose_precision,
    encode_to_size as encode_to_size,
    most_visible as most_visible,
    prune_to_size as prune_to_size,
)
from .hidden import (
    Frame as Frame,
    HiddenFile as HiddenFile,
    HiddenScene as HiddenScene,
    Recovered as Recovered,
)
from .keyss.decoder import Decoder as Decoder
from .keyss.keyss_method import (
    KeyssSecret as KeyssSecret,
    choose_anchors as choose_anchors,
    publish as publish,
)
from .keyss.keyss_options import (
    ATTRIBUTES as ATTRIBUTES,
    DESIGNS as DESIGNS,
    DecoderShape as DecoderShape,
    Design as Design,
    KeyssOptions as KeyssOptions,
    parse_mask as parse_mask,
)
from .keyss.training import CombinedPoses as CombinedPoses, KeyssTraining as KeyssTraining
from .method import (
    Capabilities as Capabilities,
    CommandLineOption as CommandLineOption,
    Context as Context,
    MethodOptions as MethodOptions,
    Plan as Plan,
    Prepared as Prepared,
    Source as Source,
    Stego as Stego,
    Training as Training,
)
from .placed_scene import PlacedScene as PlacedScene
from .plain_models import fit_plain_models as fit_plain_models
from .registry import open_model as open_model
