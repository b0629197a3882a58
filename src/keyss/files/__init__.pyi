from .models import read_model as read_model, write_model as write_model
from .scenes import load_scene as load_scene
