from .appended.channel import APPENDED as APPENDED, AppendedReader as AppendedReader
from .appended.lattice import is_appended as is_appended
from .base import (
    METHOD_BYTES as METHOD_BYTES,
    Channel as Channel,
    Content as Content,
    Payload as Payload,
    PreparedCover as PreparedCover,
    RecordRequest as RecordRequest,
    Records as Records,
    Room as Room,
    pack_method as pack_method,
    pack_payload as pack_payload,
    unpack_method as unpack_method,
    unpack_payload as unpack_payload,
)
from .codes.channel import (
    CodesChannel as CodesChannel,
    CodesCover as CodesCover,
    CodesReader as CodesReader,
    last_bits as last_bits,
)
from .codes.fields import Field as Field
from .codes.kept import in_counted_order as in_counted_order
from .colours.channel import COLOURS as COLOURS, Colours as Colours, ColoursCover as ColoursCover
from .colours.fountain import Fountain as Fountain
from .colours.reading import ColoursReader as ColoursReader
from .low_bits.bits import (
    Layout as Layout,
    identities as identities,
    read_low_bits as read_low_bits,
    used_words as used_words,
    write_low_bits as write_low_bits,
)
from .low_bits.cells import CellCipher as CellCipher
from .low_bits.channel import LOW_BITS as LOW_BITS, Embedded as Embedded, LowBitsCover as LowBitsCover
from .low_bits.contents import LowBitsReader as LowBitsReader
from .low_bits.layout import (
    TYPICAL_SHARE as TYPICAL_SHARE,
    LowBitsRoom as LowBitsRoom,
    check_payload_fits as check_payload_fits,
)
from .low_bits.parameters import key_cipher as key_cipher
from .low_bits.salts import salt_rows as salt_rows
from .low_bits.usable import chance_of_bits as chance_of_bits, usable_carriers as usable_carriers
from .publishing import (
    SUFFIXES as SUFFIXES,
    AnyChannel as AnyChannel,
    Publish as Publish,
    channel_for as channel_for,
    open_content as open_content,
    quick_attempt as quick_attempt,
    quiet_channel as quiet_channel,
    suffix_of as suffix_of,
)
from .reed_solomon import Codewords as Codewords
