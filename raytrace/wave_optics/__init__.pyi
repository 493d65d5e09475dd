# ruff: noqa: I001
from raytrace.wave_optics.compute import elements as phase_elements
from raytrace.wave_optics.compute import wave_psf as wave_psf
from raytrace.wave_optics.element import element as phase_element
from raytrace.wave_optics.element_files import read_element as read_element
from raytrace.wave_optics.element_files import write_element as write_element
from raytrace.wave_optics.fabrication import as_pixels as as_pixels
from raytrace.wave_optics.fabrication import as_rings as as_rings
from raytrace.wave_optics.fabrication import fabricated as fabricated
from raytrace.wave_optics.hybrid import element_lens as element_lens
from raytrace.wave_optics.hybrid import hybrid_psf as hybrid_psf
