from ._version import __version__ as __version__
from .api.convert import convert as convert
from .api.fit import fit as fit
from .api.hide import hide as hide
from .api.hide_arguments import HideResult as HideResult, Secret as Secret, SecretFile as SecretFile
from .api.render import evaluate as evaluate, render as render
from .api.reveal import reveal as reveal, verify as verify
from .core import (
    Gaussians as Gaussians,
    KeyssError as KeyssError,
    ViewOptions as ViewOptions,
    WrongKeyError as WrongKeyError,
)
from .files import load_scene as load_scene, read_model as read_model, write_model as write_model
from .fitting import FitConfig as FitConfig
from .keys import generate_key as generate_key, read_key as read_key
from .lab.audits.audit_run import audit as audit
from .lab.many.comparison import compare as compare
from .lab.many.reproduction import reproduce as reproduce
from .lab.many.sweep_spec import sweep as sweep
from .methods import CarryOptions as CarryOptions, KeyssOptions as KeyssOptions
from .runs.describe import info as info
from .runs.revealing import Revealed as Revealed
