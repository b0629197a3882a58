from .base import (
    Capabilities as Capabilities,
    CommandLineOption as CommandLineOption,
    Context as Context,
    MethodOptions as MethodOptions,
    Source as Source,
    Stego as Stego,
    Training as Training,
)
from .carry.capacity import record_request as record_request
from .carry.method import (
    embed_models as embed_models,
    encode_all as encode_all,
    most_contributing as most_contributing,
)
from .carry.options import CarryOptions as CarryOptions
from .hidden import Frame as Frame, HiddenFile as HiddenFile, HiddenScene as HiddenScene, Remains as Remains
from .keyss.decoder import DECODERS as DECODERS, Decoder as Decoder, LatentDecoder as LatentDecoder
from .keyss.options import (
    ATTRIBUTES as ATTRIBUTES,
    DESIGNS as DESIGNS,
    DecoderShape as DecoderShape,
    Design as Design,
    KeyssOptions as KeyssOptions,
    parse_mask as parse_mask,
)
from .keyss.secret import KeyssSecret as KeyssSecret, choose_anchors as choose_anchors
from .keyss.training import (
    CombinedPoses as CombinedPoses,
    KeyssTraining as KeyssTraining,
    PlacedScene as PlacedScene,
)
from .plain_models import fit_plain_models as fit_plain_models
from .records.carried_secret import CarriedSecret as CarriedSecret, unpack as unpack
from .records.lines import Line as Line, Table as Table
from .records.precision import (
    choose_precision as choose_precision,
    encode_to_size as encode_to_size,
    most_visible as most_visible,
    prune_to_size as prune_to_size,
)
from .records.quantise import Codec as Codec
from .registry import open_model as open_model
