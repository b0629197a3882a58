"""The demo, and the two small synthetic scenes that it uses."""

from typing import TYPE_CHECKING

from keyss._lazy import lazily

if TYPE_CHECKING:
    from keyss.demo.run import (
        COMPARISON as COMPARISON,
        COVER as COVER,
        DemoResult as DemoResult,
        FOLDER as FOLDER,
        KEY as KEY,
        OPTIONS as OPTIONS,
        SCENES as SCENES,
        SECRET as SECRET,
        SECRET_PLY as SECRET_PLY,
        VIEWER as VIEWER,
        WRONG_KEYS as WRONG_KEYS,
        contact_sheet as contact_sheet,
        run_demo as run_demo,
    )
else:
    __getattr__, __dir__, __all__ = lazily(
        __name__,
        {
            "keyss.demo.run": [
                "COMPARISON",
                "COVER",
                "DemoResult",
                "FOLDER",
                "KEY",
                "OPTIONS",
                "SCENES",
                "SECRET",
                "SECRET_PLY",
                "VIEWER",
                "WRONG_KEYS",
                "contact_sheet",
                "run_demo",
            ],
        },
    )
