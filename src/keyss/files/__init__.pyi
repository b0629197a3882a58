from .atomic import (
    atomic_write as atomic_write,
    check_output_file as check_output_file,
    lock as lock,
    write_bytes as write_bytes,
)
from .file_kinds import identify_file as identify_file
from .model_formats import (
    DECODED_SUFFIX as DECODED_SUFFIX,
    FORMATS as FORMATS,
    known_suffixes as known_suffixes,
)
from .models import (
    check_model_output as check_model_output,
    is_model_path as is_model_path,
    keeps_low_bits as keeps_low_bits,
    model_bytes as model_bytes,
    model_of_bytes as model_of_bytes,
    read_model as read_model,
    write_model as write_model,
)
from .scenes import load_scene as load_scene
