"""Points of the pupil, as options ask for them."""

import argparse

from torch import Tensor

from raytrace.maths import pupil


def pupil_points(arguments: argparse.Namespace) -> tuple[Tensor, Tensor]:
    """Points and weights of the sampling asked for."""
    return pupil.sampled(arguments.sampling, rings=arguments.rings, points=arguments.points, seed=arguments.seed)
