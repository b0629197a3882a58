from .run import (
    COMPARISON as COMPARISON,
    COVER as COVER,
    FOLDER as FOLDER,
    KEY as KEY,
    OPTIONS as OPTIONS,
    SCENES as SCENES,
    SECRET as SECRET,
    SECRET_PLY as SECRET_PLY,
    VIEWER as VIEWER,
    WRONG_KEYS as WRONG_KEYS,
    run_demo as run_demo,
)
