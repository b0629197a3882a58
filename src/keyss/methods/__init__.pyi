from .base import (
    Capabilities as Capabilities,
    CommandLineOption as CommandLineOption,
    Context as Context,
    MethodOptions as MethodOptions,
    Source as Source,
    Stego as Stego,
    Training as Training,
)
from .carry.options import CarryOptions as CarryOptions
from .carry.refit import most_contributing as most_contributing
from .carry.room import RecordRoom as RecordRoom, Wanted as Wanted
from .decoy import Decoy as Decoy
from .hidden_file import HiddenFile as HiddenFile
from .joint import JointTraining as JointTraining
from .keyss.clip_keys import ClipKeys as ClipKeys
from .keyss.decoder import (
    ATTRIBUTES as ATTRIBUTES,
    Decoder as Decoder,
    DecoderShape as DecoderShape,
    parse_mask as parse_mask,
)
from .keyss.options import DESIGNS as DESIGNS, DesignName as DesignName, KeyssOptions as KeyssOptions
from .keyss.secret import HiddenSecret as HiddenSecret, choose_anchors as choose_anchors
from .keyss.training import KeyssTraining as KeyssTraining
from .opened import Frame as Frame, Opened as Opened, Remains as Remains
from .peers.options import PeerOptions as PeerOptions
from .plain_models import Bound as Bound, with_plain_models as with_plain_models
from .poses import CombinedPoses as CombinedPoses, PlacedScene as PlacedScene
from .records.embedding import embed_models as embed_models, embed_whole as embed_whole
from .records.encoding import (
    encode_all as encode_all,
    most_visible as most_visible,
    record_degree as record_degree,
    record_request as record_request,
)
from .records.lines import Line as Line
from .records.opening import CarriedSecret as CarriedSecret
from .records.quantise import Codec as Codec, outliers as outliers
from .records.table import Table as Table
from .registry import open_model as open_model
