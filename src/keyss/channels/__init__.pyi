from .appended.appended_channel import (
    APPENDED as APPENDED,
    AppendedReader as AppendedReader,
    appended_count as appended_count,
)
from .appended.words import is_appended as is_appended
from .base import Capacity as Capacity, Channel as Channel, PreparedCover as PreparedCover
from .colours.colours_channel import (
    COLOURS as COLOURS,
    ColoursCover as ColoursCover,
    ColoursReader as ColoursReader,
)
from .colours.fountain import Fountain as Fountain
from .container import (
    Parameters as Parameters,
    Payload as Payload,
    pack_payload as pack_payload,
    seal as seal,
    sealed_size as sealed_size,
    unpack_payload as unpack_payload,
    unseal as unseal,
)
from .foreign import copies as copies
from .lsb.bits import (
    DEEPEST as DEEPEST,
    DEPTHS as DEPTHS,
    LEAST as LEAST,
    Layout as Layout,
    gaussian_ids as gaussian_ids,
    read_low_bits as read_low_bits,
    used_words as used_words,
    write_low_bits as write_low_bits,
)
from .lsb.fields import Field as Field, in_counted_order as in_counted_order, last_bits as last_bits
from .lsb.low_bits import LOW_BITS as LOW_BITS, LowBitsCover as LowBitsCover, LowBitsReader as LowBitsReader
from .lsb.low_bits_capacity import (
    TYPICAL_SHARE as TYPICAL_SHARE,
    LowBitsCapacity as LowBitsCapacity,
    check_payload_fits as check_payload_fits,
)
from .lsb.quantised import (
    QuantisedCover as QuantisedCover,
    QuantisedReader as QuantisedReader,
    quantised_channel as quantised_channel,
)
from .lsb.salts import salt_rows as salt_rows
from .lsb.shards import Message as Message, Shards as Shards
from .lsb.usable import (
    Carriers as Carriers,
    chance_of_bits as chance_of_bits,
    usable_carriers as usable_carriers,
)
from .names import ConvertedChannel as ConvertedChannel, Format as Format, Publish as Publish
from .publishing import (
    SUFFIXES as SUFFIXES,
    channel_for as channel_for,
    open_payload as open_payload,
    suffix_of as suffix_of,
)
from .reed_solomon import Codewords as Codewords
