"""What the commands about spots share: points of the pupil, and how a field and a spot are told."""

import argparse

from torch import Tensor

from raytrace import pupil
from raytrace.cli.door import number, numbers
from raytrace.spot import Spot
from raytrace.streaming import StreamedSpot

_RINGS = 12
_DEFAULT_SIZE = {"gauss": _RINGS, "hexapolar": _RINGS, "square": 32, "sobol": 1024, "random": 1024}


def pupil_points(arguments: argparse.Namespace) -> tuple[Tensor, Tensor]:
    """Points and weights of the sampling asked for."""
    size = arguments.size or _DEFAULT_SIZE[arguments.sampling]
    if arguments.sampling in ("sobol", "random"):
        return pupil.SAMPLINGS[arguments.sampling](size, seed=arguments.seed)
    return pupil.SAMPLINGS[arguments.sampling](size)


def spot_entry(fields: Tensor, wavelength: float, spots: Spot | StreamedSpot, f: int, w: int) -> dict:
    """What JSON says of any spot (F, W): null where no ray arrives."""
    arrived = int(spots.rays[f, w])
    return {
        "field": numbers(fields[:, f]),
        "wavelength": wavelength,
        "centroid": numbers(spots.centroid[:, f, w]) if arrived else [None, None],
        "rms_radius": number(spots.rms_radius[f, w]) if arrived else None,
        "geometric_radius": number(spots.geometric_radius[f, w]) if arrived else None,
        "rays": arrived,
    }


def field_label(field: Tensor) -> str:
    """A field point in words: its y alone on the axis of x."""
    x, y = field.tolist()
    return f"{y:g}" if x == 0 else f"{x:g},{y:g}"
