"""Hide a 3D Gaussian Splatting scene inside another one and open it only with a key.

    from keyss import Secret, hide, reveal

    hide("scenes/garden", [Secret("scenes/treasure", key)], width=400, out="runs/hidden")
    reveal("runs/hidden/publish/stego.ply", key, out="treasure.ply")

Each name below is loaded at its first use, so that `import keyss` is quick.
"""

from typing import TYPE_CHECKING

from keyss import _threads  # noqa: F401  before anything imports torch
from keyss._lazy import lazily
from keyss._version import __version__ as __version__

if TYPE_CHECKING:
    from keyss.api.asking import HideResult as HideResult, Secret as Secret
    from keyss.api.converting import convert as convert
    from keyss.api.fitting import fit as fit
    from keyss.api.hiding import hide as hide
    from keyss.api.looking import evaluate as evaluate, render as render
    from keyss.api.opening import reveal as reveal, verify as verify
    from keyss.audits.run import audit as audit
    from keyss.core import Gaussians as Gaussians, KeyssError as KeyssError, WrongKeyError as WrongKeyError
    from keyss.files import load_scene as load_scene, read_model as read_model, write_model as write_model
    from keyss.fitting import FitConfig as FitConfig
    from keyss.keys import generate_key as generate_key
    from keyss.many.batch import hide_batch as hide_batch
    from keyss.many.comparing import compare as compare
    from keyss.many.reproducing import reproduce as reproduce
    from keyss.many.sweeping import sweep as sweep
    from keyss.methods import CarryOptions as CarryOptions, KeyssOptions as KeyssOptions
    from keyss.runs.describe import info as info
    from keyss.runs.revealing import Revealed as Revealed
else:
    __getattr__, __dir__, __all__ = lazily(
        __name__,
        {
            "keyss.api.asking": ["HideResult", "Secret"],
            "keyss.api.converting": ["convert"],
            "keyss.api.fitting": ["fit"],
            "keyss.api.hiding": ["hide"],
            "keyss.api.looking": ["evaluate", "render"],
            "keyss.api.opening": ["reveal", "verify"],
            "keyss.audits.run": ["audit"],
            "keyss.core": ["Gaussians", "KeyssError", "WrongKeyError"],
            "keyss.files": ["load_scene", "read_model", "write_model"],
            "keyss.fitting": ["FitConfig"],
            "keyss.keys": ["generate_key"],
            "keyss.many.batch": ["hide_batch"],
            "keyss.many.comparing": ["compare"],
            "keyss.many.reproducing": ["reproduce"],
            "keyss.many.sweeping": ["sweep"],
            "keyss.methods": ["CarryOptions", "KeyssOptions"],
            "keyss.runs.describe": ["info"],
            "keyss.runs.revealing": ["Revealed"],
        },
    )
    __all__ += ["__version__"]
