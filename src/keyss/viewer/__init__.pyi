from .look import Look as Look, look_of_model as look_of_model
from .page import asset as asset, export_html as export_html
from .serving import ModelServer as ModelServer
