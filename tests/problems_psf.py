"""A PSF of the double Gauss in every number that it depends on."""

import dataclasses

import torch
from problems import double_gauss, scalar, vector

from raytrace.materials.glass import model_glass
from raytrace.maths.sampling import Grid
from raytrace.system.lens import Lens, SystemAperture, with_object_distance, with_sensor_distance
from raytrace.system.surface import Aperture
from raytrace.tracing.scene import Scene, scene

#: Kind of parameter -> what one unit of it is; a millionth of that moves light by nanometres.
KINDS = {
    "curvature": 1e-3,  # 1/mm
    "conic": 0.1,
    "asphere": 1e-6,  # mm⁻³
    "thickness": 1.0,  # mm
    "index": 0.01,
    "abbe_number": 10.0,
    "sensor_distance": 1.0,  # mm
    "pitch": 0.01,  # mm
    "centre": 0.01,  # mm
    "object_distance": 1e3,  # mm
    "field_x": 0.1,  # degrees
    "field_y": 0.1,
    "aperture": 1.0,  # mm
    "wavelength": 0.1,  # µm
}

ANGLE = 2.0


def base() -> Lens:
    """The double Gauss at 10 m with a stop of 9 mm, which takes a third of the beam."""
    lens = with_object_distance(with_sensor_distance(double_gauss(), scalar(57.88)), scalar(1e4))
    return lens.replace(3, conic=scalar(0.0), coefficients=vector(0.0, 0.0), glass=model_glass(1.624, 60.0)).replace(
        5, apertures=(Aperture("circular", (0.0, 9.0)),)
    )


def moved(kind: str, unit: torch.Tensor, pixels: Grid) -> tuple[Scene, Grid]:
    """The scene and its pixels, one number of them moved by so many of its units."""
    lens, fields, distance, wavelength = base(), vector(0.0, ANGLE)[:, None], scalar(1e4), scalar(0.53)
    step, surface = unit * KINDS[kind], lens.surfaces[3]
    if kind == "curvature":
        lens = lens.replace(3, curvature=surface.curvature + step)
    elif kind == "conic":
        lens = lens.replace(3, conic=surface.conic + step)
    elif kind == "asphere":
        lens = lens.replace(3, coefficients=torch.stack([torch.zeros_like(step), step]))
    elif kind == "thickness":
        lens = lens.replace(4, thickness=lens.surfaces[4].thickness + step)
    elif kind in ("index", "abbe_number"):
        nd, vd, dpgf = surface.glass.coefficients
        numbers = (nd + step, vd, dpgf) if kind == "index" else (nd, vd + step, dpgf)
        lens = lens.replace(3, glass=dataclasses.replace(surface.glass, coefficients=torch.stack(numbers)))
    elif kind == "sensor_distance":
        lens = with_sensor_distance(lens, lens.surfaces[-2].thickness + step)
    elif kind == "aperture":
        lens = dataclasses.replace(lens, aperture=SystemAperture("entrance_pupil_diameter", 33.33 + step))
    elif kind == "pitch":
        pixels = Grid(pixels.pitch + step, pixels.rows, pixels.columns, pixels.centre)
    elif kind == "centre":
        pixels = Grid(pixels.pitch, pixels.rows, pixels.columns, pixels.centre + step)
    elif kind == "object_distance":
        distance = distance + step
    elif kind == "wavelength":
        wavelength = wavelength + step
    else:
        shift = torch.stack([step, 0 * step] if kind == "field_x" else [0 * step, step])
        fields = fields + shift[:, None]
    return scene(lens, fields, distance[None], wavelength[None]), pixels
