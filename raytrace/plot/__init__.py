"""Figures: cross section, spot diagram, through-focus curve, focus report, PSFs and analyses, each a matplotlib Figure.

This folder is the only place that imports matplotlib, and it never touches pyplot: figures need no display and leave
nothing behind.
"""

from raytrace.plot.aberrations import distorted_grid as distorted_grid
from raytrace.plot.aberrations import incidence_curves as incidence_curves
from raytrace.plot.aberrations import longitudinal_curves as longitudinal_curves
from raytrace.plot.aberrations import rms_curves as rms_curves
from raytrace.plot.aberrations import seidel_bars as seidel_bars
from raytrace.plot.analysis import curvature_curves as curvature_curves
from raytrace.plot.analysis import distortion_curves as distortion_curves
from raytrace.plot.analysis import encircled_curves as encircled_curves
from raytrace.plot.analysis import fan_plot as fan_plot
from raytrace.plot.analysis import illumination_curve as illumination_curve
from raytrace.plot.analysis import lateral_curves as lateral_curves
from raytrace.plot.analysis import mtf_curves as mtf_curves
from raytrace.plot.analysis import mtf_through_focus_curves as mtf_through_focus_curves
from raytrace.plot.analysis import wavefront_maps as wavefront_maps
from raytrace.plot.layout import layout as layout
from raytrace.plot.psf import model_grid as model_grid
from raytrace.plot.psf import psf_grid as psf_grid
from raytrace.plot.report import focus_report as focus_report
from raytrace.plot.spots import airy_radius as airy_radius
from raytrace.plot.spots import spot_diagram as spot_diagram
from raytrace.plot.style import SUFFIXES as SUFFIXES
from raytrace.plot.style import field_label as field_label
from raytrace.plot.style import save as save
