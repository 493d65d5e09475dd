"""Figures: cross section, spot diagram, through-focus curve, focus report, PSFs and analyses, each a matplotlib Figure.

This folder is the only place that imports matplotlib, and it never touches pyplot: figures need no display and leave
nothing behind.
"""

from raytrace.plotting.layout import layout as layout
from raytrace.plotting.psf import model_grid as model_grid
from raytrace.plotting.psf import psf_grid as psf_grid
from raytrace.plotting.report import focus_report as focus_report
from raytrace.plotting.spots import airy_radius as airy_radius
from raytrace.plotting.spots import spot_diagram as spot_diagram
from raytrace.plotting.style import SUFFIXES as SUFFIXES
from raytrace.plotting.style import field_label as field_label
from raytrace.plotting.style import save as save
