from .clip import ClipKeys as ClipKeys
from .derivation import DerivedKey as DerivedKey, random_embeddings as random_embeddings
from .key_file import (
    ALPHABET as ALPHABET,
    generate_key as generate_key,
    length_for as length_for,
    normalized_key as normalized_key,
    read_key as read_key,
)
from .master import MasterKey as MasterKey
from .strength import ENOUGH_GUESSES as ENOUGH_GUESSES, key_guesses as key_guesses, weakness as weakness
