"""How a secret becomes bits and Gaussians: one folder for each method."""

from typing import TYPE_CHECKING

from keyss._lazy import lazily

if TYPE_CHECKING:
    from keyss.methods.base import (
        Capabilities as Capabilities,
        CommandLineOption as CommandLineOption,
        Context as Context,
        MethodOptions as MethodOptions,
        Source as Source,
        Stego as Stego,
        Training as Training,
    )
    from keyss.methods.carry.options import CarryOptions as CarryOptions
    from keyss.methods.carry.refit import most_contributing as most_contributing
    from keyss.methods.carry.room import RecordRoom as RecordRoom, Wanted as Wanted
    from keyss.methods.decoy import Decoy as Decoy
    from keyss.methods.hidden_file import HiddenFile as HiddenFile
    from keyss.methods.joint import JointTraining as JointTraining
    from keyss.methods.keyss.clip_keys import ClipKeys as ClipKeys
    from keyss.methods.keyss.decoder import (
        ATTRIBUTES as ATTRIBUTES,
        Decoder as Decoder,
        DecoderShape as DecoderShape,
        parse_mask as parse_mask,
    )
    from keyss.methods.keyss.options import (
        DESIGNS as DESIGNS,
        DesignName as DesignName,
        KeyssOptions as KeyssOptions,
    )
    from keyss.methods.keyss.secret import HiddenSecret as HiddenSecret, choose_anchors as choose_anchors
    from keyss.methods.keyss.training import KeyssTraining as KeyssTraining
    from keyss.methods.opened import Frame as Frame, Opened as Opened, Remains as Remains
    from keyss.methods.peers.options import PeerOptions as PeerOptions
    from keyss.methods.plain_models import Bound as Bound, with_plain_models as with_plain_models
    from keyss.methods.poses import CombinedPoses as CombinedPoses, PlacedScene as PlacedScene
    from keyss.methods.records.embedding import embed_models as embed_models, embed_whole as embed_whole
    from keyss.methods.records.encoding import (
        encode_all as encode_all,
        most_visible as most_visible,
        record_degree as record_degree,
        record_request as record_request,
    )
    from keyss.methods.records.opening import CarriedSecret as CarriedSecret
    from keyss.methods.records.lines import Line as Line
    from keyss.methods.records.quantise import Codec as Codec, outliers as outliers
    from keyss.methods.records.table import Table as Table
    from keyss.methods.registry import open_model as open_model
else:
    __getattr__, __dir__, __all__ = lazily(
        __name__,
        {
            "keyss.methods.base": [
                "Capabilities",
                "CommandLineOption",
                "Context",
                "MethodOptions",
                "Source",
                "Stego",
                "Training",
            ],
            "keyss.methods.carry.options": ["CarryOptions"],
            "keyss.methods.carry.refit": ["most_contributing"],
            "keyss.methods.carry.room": ["RecordRoom", "Wanted"],
            "keyss.methods.decoy": ["Decoy"],
            "keyss.methods.hidden_file": ["HiddenFile"],
            "keyss.methods.joint": ["JointTraining"],
            "keyss.methods.keyss.clip_keys": ["ClipKeys"],
            "keyss.methods.keyss.decoder": ["ATTRIBUTES", "Decoder", "DecoderShape", "parse_mask"],
            "keyss.methods.keyss.options": ["DESIGNS", "DesignName", "KeyssOptions"],
            "keyss.methods.keyss.secret": ["HiddenSecret", "choose_anchors"],
            "keyss.methods.keyss.training": ["KeyssTraining"],
            "keyss.methods.opened": ["Frame", "Opened", "Remains"],
            "keyss.methods.peers.options": ["PeerOptions"],
            "keyss.methods.plain_models": ["Bound", "with_plain_models"],
            "keyss.methods.poses": ["CombinedPoses", "PlacedScene"],
            "keyss.methods.records.embedding": ["embed_models", "embed_whole"],
            "keyss.methods.records.encoding": [
                "encode_all",
                "most_visible",
                "record_degree",
                "record_request",
            ],
            "keyss.methods.records.opening": ["CarriedSecret"],
            "keyss.methods.records.lines": ["Line"],
            "keyss.methods.records.quantise": ["Codec", "outliers"],
            "keyss.methods.records.table": ["Table"],
            "keyss.methods.registry": ["open_model"],
        },
    )
