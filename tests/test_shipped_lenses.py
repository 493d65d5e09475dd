"""The shipped lenses: focal lengths as published, sources named, glasses found, rays that reach the image."""

import math
from dataclasses import dataclass, replace
from pathlib import Path

import pytest
import torch

from raytrace.io import read_lens
from raytrace.system.lens import Lens, media
from raytrace.system.rays import Rays
from raytrace.tracing.launch import launch
from raytrace.tracing.paraxial import first_order
from raytrace.tracing.trace import steps, trace_lens

LENSES = Path(__file__).parents[1] / "lenses"
FILES = sorted(LENSES.glob("*.zmx"))


@dataclass(frozen=True)
class Published:
    """What the source prints, in mm.

    focal_length, back_focus: (value, tolerance), the tolerance being what the printed digits allow (`why`).
    source: words that the notes of the file must hold.
    marginal: height on the image surface of the real ray through the rim of the entrance pupil, on axis at the
        primary wavelength, from a tracer that shares nothing with this package (numpy, Newton from the vertex plane).
    """

    focal_length: tuple[float, float]
    back_focus: tuple[float, float] | None
    source: str
    why: str
    marginal: float


PUBLISHED = {
    "cemented_achromat": Published(
        (100.1, 0.05),
        (97.1, 0.15),
        "AC254-100-A",
        "f printed to 0.1; radii printed to 0.1 (half a digit is up to 0.1 mm a surface in back focus)",
        -0.01750270410775734,
    ),
    "cooke_triplet": Published(
        (101.181, 0.0005),
        (77.405, 0.0005),
        "W. J. Smith, Modern Optical Engineering",
        "half of the last printed digit",
        0.007558905718930475,
    ),
    "double_gauss": Published(
        (99.5145515666, 1e-9),
        (57.4851290372, 1e-9),
        "differentiable optical models",
        "ten decimals of an independent calculation at 0.530 um",
        -0.2196599833184365,
    ),
    "double_gauss_28deg": Published(
        (100.0, 0.05),
        (58.914, 0.002),
        "US patent 4,123,144",
        "f printed as 100; back focus to 0.001, and the catalog glasses meet the printed indices to 2e-5",
        0.012596225431353858,
    ),
    "hubble": Published(
        (57600.0, 50.0),
        None,
        "Sinclair Optics",
        "57.6 m, three digits",
        -1.4336146332442428e-05,
    ),
    "kingslake_doublet": Published(
        (12.0, 0.00005),
        None,
        "R. Kingslake, Lens Design Fundamentals",
        "12.0000, half of the last printed digit",
        0.0013680664635649098,
    ),
    "petzval": Published(
        (100.0, 0.05),
        (56.5, 0.05),
        "US patent 2,500,046",
        "normalised to 100; indices printed to 0.001; back focus to 0.1",
        -0.031220685051414065,
    ),
    "phone": Published(
        (4.10, 0.005),
        None,
        "2016/0341934",
        "half of the last printed digit (its image distance is the best focus, not the paraxial one)",
        0.0024507108540926074,
    ),
    "retrofocus": Published(
        (25.0, 0.125),
        (37.1925, 0.0025),
        "DE 1 250 153",
        "f = 1.00 and back focus 1.4877, times 25; one last digit, as every input is rounded to it too",
        0.009953322056176717,
    ),
    "singlet": Published(
        (100.0, 0.001),
        (100.0, 0.001),
        "J. Sasian",
        "half of the last digit of the radius 51.680, over n - 1",
        -0.10725926239942662,
    ),
    "split_triplet": Published(
        (99.79, 0.005),
        (56.89, 0.005),
        "British patent 237,212",
        "half of the last printed digit",
        0.059147670760566484,
    ),
    "telephoto": Published(
        (99.9, 0.05),
        (32.46, 0.005),
        "W. J. Smith, Modern Optical Engineering",
        "half of the last printed digit",
        -0.014713121568385112,
    ),
    "tessar": Published(
        (100.0, 0.05),
        (79.831, 0.0005),
        "US patent 2,854,889",
        "f printed as 100; back focus: half of the last printed digit",
        0.1214257549317832,
    ),
}

WITH_BACK_FOCUS = [path.stem for path in FILES if path.stem in PUBLISHED and PUBLISHED[path.stem].back_focus]
NANOMETRE = 1e-6  # mm
DISTORTION = 0.04  # of f tan θ; no shipped lens is a fisheye


@pytest.fixture(params=[path.stem for path in FILES])
def name(request) -> str:
    return request.param


@pytest.fixture
def lens(name) -> Lens:
    return read_lens(LENSES / f"{name}.zmx", strict=True)


def test_every_lens_has_a_published_focal_length():
    assert {path.stem for path in FILES} == set(PUBLISHED)


def test_source_is_named(name, lens):
    notes = " ".join(lens.notes)
    assert "source" in notes.lower()
    assert PUBLISHED[name].source in notes


def test_focal_length_is_the_published_one(name, lens):
    value, tolerance = PUBLISHED[name].focal_length
    found = float(first_order(lens).effective_focal_length)
    assert abs(found - value) <= tolerance, f"{found} mm, published {value} ± {tolerance}: {PUBLISHED[name].why}"


@pytest.mark.parametrize("name", WITH_BACK_FOCUS, indirect=True)
def test_back_focus_is_the_published_one(name, lens):
    value, tolerance = PUBLISHED[name].back_focus
    found = float(first_order(lens).back_focal_distance)
    assert abs(found - value) <= tolerance, f"{found} mm, published {value} ± {tolerance}: {PUBLISHED[name].why}"


def test_glasses_are_found(lens):
    indices = torch.stack([n.expand(lens.wavelengths.shape) for n in media(lens, lens.wavelengths)])
    glass = (indices > 1.4) & (indices < 2.0)
    assert bool(((indices == 1) | glass).all())
    assert bool(glass.any()) or any(surface.is_mirror for surface in lens.surfaces)


def test_on_axis_marginal_ray_meets_the_image_where_it_should(name, lens):
    """Within a nanometre of where an independent tracer says, and within 2 % of the beam's radius of the axis."""
    radius = float(first_order(lens).entrance_pupil_diameter) / 2
    height = float(_at_image(lens, [1.0]).position[1])
    assert abs(height) < 0.02 * radius
    assert abs(height - PUBLISHED[name].marginal) < NANOMETRE


def test_semi_diameters_pass_the_axial_beam(lens):
    """The semi-diameter of every surface before the image holds the marginal ray; 2 % for stops sized paraxially."""
    indices = media(lens, lens.primary)
    crossings = steps(lens.surfaces[1:], _on_axis(lens, [1.0]), indices=indices)
    for surface, crossing in zip(lens.surfaces[1:-1], crossings, strict=False):
        height = float(crossing.rays.position[:2].norm(dim=0).max())
        assert surface.semi_diameter is not None
        assert height <= 1.02 * surface.semi_diameter


def test_every_field_reaches_the_image(lens):
    """The rim of the pupil, vignetted and aimed as the file asks, passes all surfaces at every field and wavelength.

    The bundle of the primary wavelength lands about where f tan θ says.
    """
    angle = 2 * math.pi * torch.arange(24, dtype=torch.float64) / 24
    rays = launch(lens, torch.stack([angle.cos(), angle.sin()]))
    rays = trace_lens(lens, rays, lens.wavelengths[:, None])
    assert bool(rays.valid.all()), f"rays lost at each field: {(~rays.valid).sum(dim=(1, 2)).tolist()}"
    expected = first_order(lens).effective_focal_length * torch.tan(torch.deg2rad(lens.fields.y))
    found = rays.position[1, :, lens.primary_wavelength - 1].mean(dim=-1)
    assert bool(((found - expected).abs() <= DISTORTION * expected.abs() + 0.1).all())


def test_hubble_is_obscured_in_the_centre():
    """The disc of 0.33 of the aperture stops what lies inside it, to either side of its edge, and nothing else."""
    lens = read_lens(LENSES / "hubble.zmx")
    assert _at_image(lens, [0.0, 0.329, 0.331, 1.0]).valid.tolist() == [False, False, True, True]


def test_phone_aspheres_matter():
    """The even aspheres of the phone lens bring its marginal ray to 3 µm of the axis; without them it misses by far."""
    lens = read_lens(LENSES / "phone.zmx")
    assert sum(s.coefficients is not None for s in lens.surfaces) == 12
    bare = replace(lens, surfaces=tuple(replace(s, coefficients=None) for s in lens.surfaces))
    assert abs(float(_at_image(lens, [1.0]).position[1])) < 0.003
    assert abs(float(_at_image(bare, [1.0]).position[1])) > 0.03


def _on_axis(lens: Lens, pupil: list[float]) -> Rays:
    """Rays (N,) through heights of the entrance pupil, 1 the rim, on axis at the primary wavelength, not aimed."""
    primary = lens.primary_wavelength - 1
    y = torch.tensor(pupil, dtype=torch.float64)
    rays = launch(
        lens,
        torch.stack([torch.zeros_like(y), y]),
        fields=torch.zeros(2, 1, dtype=torch.float64),
        wavelengths=lens.wavelengths[primary : primary + 1],
        ray_aiming="off",
    )
    return Rays(rays.position[:, 0, 0], rays.direction[:, 0, 0], rays.valid[0, 0])


def _at_image(lens: Lens, pupil: list[float]) -> Rays:
    return trace_lens(lens, _on_axis(lens, pupil), lens.primary)
