"""What the commands about spots share: points of the pupil, and how a field and a spot are told."""

import argparse

from torch import Tensor

from raytrace.cli.door import CommandError
from raytrace.maths import pupil
from raytrace.maths.result import cell, number, numbers
from raytrace.optics.spot import Spot
from raytrace.optics.streaming import StreamedSpot

_RINGS = 12
_IN_RINGS = ("gauss", "hexapolar")
_POINTS = {"square": 32, "sobol": 1024, "random": 1024}


def pupil_points(arguments: argparse.Namespace) -> tuple[Tensor, Tensor]:
    """Points and weights of the sampling asked for."""
    in_rings = arguments.sampling in _IN_RINGS
    if in_rings and arguments.points:
        raise CommandError(f"--points belongs to --sampling {', '.join(_POINTS)}; {arguments.sampling} takes --rings")
    if arguments.rings and not in_rings:
        raise CommandError(f"--rings belongs to --sampling {', '.join(_IN_RINGS)}; {arguments.sampling} takes --points")
    size = arguments.rings or _RINGS if in_rings else arguments.points or _POINTS[arguments.sampling]
    if arguments.sampling in ("sobol", "random"):
        return pupil.SAMPLINGS[arguments.sampling](size, seed=arguments.seed)
    return pupil.SAMPLINGS[arguments.sampling](size)


def spot_entry(fields: Tensor, wavelength: float, spots: Spot | StreamedSpot, f: int, w: int) -> dict:
    """What JSON says of any spot (F, W): null where no ray arrives."""
    return {
        "field": numbers(fields[:, f]),
        "wavelength": wavelength,
        "centroid": numbers(spots.centroid[:, f, w]),
        "rms_radius": number(spots.rms_radius[f, w]),
        "geometric_radius": number(spots.geometric_radius[f, w]),
        "rays": int(spots.rays[f, w]),
    }


def spot_cells(spots: Spot | StreamedSpot, at: tuple[int, ...]) -> str:
    """Centroid in mm, RMS and geometric radius in µm of one spot, as the table has them; - where no ray arrives."""
    x, y = spots.centroid[(slice(None), *at)].tolist()
    radii = (1000 * float(radius[at]) for radius in (spots.rms_radius, spots.geometric_radius))
    return " ".join([*(cell(v, ">13.7f") for v in (x, y)), *(cell(v, ">10.4f") for v in radii)])
