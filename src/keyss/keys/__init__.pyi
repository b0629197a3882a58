from .clip import ClipKeys as ClipKeys
from .derivation import (
    DerivedKey as DerivedKey,
    MasterKey as MasterKey,
    random_embeddings as random_embeddings,
)
from .key_file import (
    ALPHABET as ALPHABET,
    generate_key as generate_key,
    key_guesses as key_guesses,
    length_for as length_for,
    normalized_key as normalized_key,
    read_key as read_key,
    weakness as weakness,
)
