from .live import LiveTraining as LiveTraining
from .page import asset as asset, export_html as export_html, page_with as page_with
from .serving import ModelServer as ModelServer
