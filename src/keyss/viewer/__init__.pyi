from .look import (
    Look as Look,
    look_of_model as look_of_model,
    look_of_scene as look_of_scene,
    pose_of as pose_of,
)
from .page import asset as asset, export_html as export_html
from .serving import ModelServer as ModelServer
