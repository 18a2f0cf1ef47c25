from .build import build_evacuation as build_evacuation
from .evacuation import Evacuation as Evacuation
from .evacuation import load_evacuation as load_evacuation
from .place import Place as Place
from .place import load_place as load_place
