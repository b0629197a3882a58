from .live import LiveTraining as LiveTraining
from .look import Look as Look, look_of_model as look_of_model, look_of_scene as look_of_scene
from .page import asset as asset, export_html as export_html, page_with as page_with
from .serving import ModelServer as ModelServer
