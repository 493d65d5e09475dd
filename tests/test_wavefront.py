"""Wavefront: the path to the reference sphere of a perfect image is the same for every ray."""

import dataclasses

import pytest
import torch
from problems import double_gauss, lens, rays_of_problem, scalar, stigmatic_problems, surface, vector

from raytrace.maths.sampling import hexapolar
from raytrace.system.lens import media
from raytrace.tracing.launch import launch
from raytrace.tracing.trace import trace_lens, trace_surfaces
from raytrace.tracing.wavefront import path_to_reference_sphere

WAVE = 0.55e-3  # mm


@pytest.mark.parametrize("problem", stigmatic_problems(), ids=lambda problem: problem.name)
@pytest.mark.parametrize("radius", [1e3, 1e9, float("inf")])
def test_perfect_image_has_no_wavefront_error(problem, radius):
    rays = rays_of_problem(problem)
    last = trace_surfaces(problem.surfaces, rays, indices=[scalar(n) for n in problem.media])
    centre = vector(*problem.image)[:, None]
    W = path_to_reference_sphere(last, centre, 1 / scalar(radius), scalar(problem.media[-1]))
    assert ((W - W[0]) / WAVE).abs().max() <= (1e-8 if problem.name == "Cartesian oval" else 1e-10)  # waves


def test_path_does_not_depend_on_where_the_rays_are_taken():
    """Free propagation changes the foot on the plane, not the wavefront."""
    here = double_gauss()
    points, _ = hexapolar(3)
    surfaces = list(here.surfaces)
    surfaces[-2] = surface(float(surfaces[-2].curvature), 40.0)
    behind = dataclasses.replace(here, surfaces=tuple(surfaces))
    results = []
    for system, z in ((here, 0.0), (behind, 18.5)):
        rays = trace_lens(system, launch(system, points), system.wavelengths[:, None])
        centre = vector(0.0, 0.0, z).reshape(3, 1, 1, 1)
        W = path_to_reference_sphere(rays, centre, scalar(0.01), media(system, system.wavelengths[:, None])[-1])
        results.append(W[0] - W[0, :, :1])
    assert ((results[0] - results[1]) / WAVE).abs().max() <= 1e-9  # waves


def test_opd_gives_back_the_transverse_aberration():
    """∂W/∂y on the reference sphere is n ε_y / R: path and hit must be of one and the same ray."""
    system = lens([surface(0.02, 5.0, 1.5), surface(-0.01, 60.0)])
    height = torch.linspace(0.0, 1.0, 41, dtype=torch.float64)
    points = torch.stack([torch.zeros_like(height), height])
    rays = trace_lens(system, launch(system, points), system.wavelengths[:, None])
    radius = scalar(60.0)
    W = path_to_reference_sphere(rays, torch.zeros(3, 1, 1, 1, dtype=torch.float64), 1 / radius, scalar(1.0))[0, 0]
    y, direction, epsilon = rays.position[1, 0, 0], rays.direction[:, 0, 0], rays.position[1, 0, 0]
    along = y * direction[1] + torch.sqrt(radius**2 - y**2 + (y * direction[1]) ** 2)
    on_sphere = y - along * direction[1]
    slope = (W[2:] - W[:-2]) / (on_sphere[2:] - on_sphere[:-2])
    # Centred differences of 40 steps: relative error of second order, 1e-3 of the largest aberration.
    assert (slope - epsilon[1:-1] / radius).abs().max() <= 3e-3 * (epsilon.abs().max() / radius)


def test_no_subtraction_of_long_paths():
    """An object 10¹² mm away costs no digits: its wavefront tends to that of infinity as 1/distance."""
    points, _ = hexapolar(3)
    found = []
    for distance in (float("inf"), 1e12):
        system = double_gauss(object_distance=distance)
        rays = launch(system, points, fields=torch.zeros(2, 1, dtype=torch.float64))
        last = trace_lens(system, rays, system.wavelengths[:, None])
        W = path_to_reference_sphere(last, torch.zeros(3, 1, 1, 1, dtype=torch.float64), scalar(0.01), scalar(1.0))
        found.append(W - W[..., :1])
    assert ((found[0] - found[1]) / WAVE).abs().max() <= 1e-6  # waves: h²/2D = 1.4e-10 mm of sagitta
