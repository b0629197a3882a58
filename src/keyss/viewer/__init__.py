"""The page in which a published model is looked at and a key can be typed; `web/` has its sources."""

from keyss.viewer.page import export_html
from keyss.viewer.serving import ModelServer

__all__ = ["ModelServer", "export_html"]
