from raytrace.materials.catalogs import find_glass as find_glass
from raytrace.materials.catalogs import nearest_glasses as nearest_glasses
from raytrace.materials.glass import AIR as AIR
from raytrace.materials.glass import MIRROR as MIRROR
from raytrace.materials.glass import Glass as Glass
from raytrace.materials.glass import internal_transmittance as internal_transmittance
from raytrace.materials.glass import refractive_index as refractive_index
from raytrace.materials.properties import glass as glass
