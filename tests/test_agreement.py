"""One quantity, one value: what two functions of the package give of one lens agrees, for a zoo of lenses.

Each test is a law between public functions. Lenses differ in what has made such values disagree: the medium in front
of the sensor, obscurations and apertures that are not round, finite objects, tilts, mirrors, aspheres, configurations,
and units of length other than mm.
"""

import dataclasses
import functools
import math
import warnings
from pathlib import Path

import pytest
import torch
from problems import MICROMETRE, PICOMETRE, own_fields

import raytrace as rt
from raytrace.analysis.setting import scene_of
from raytrace.imaging.built_lens import lens_as_built
from raytrace.optimization.conditions import conditions_of
from raytrace.system.lens import Lens, media
from raytrace.tolerancing.criteria import CRITERIA
from raytrace.tolerancing.study import Study, View, sampling_of
from raytrace.tracing.paraxial import largest_field
from raytrace.tracing.scene import beam_share
from raytrace.tracing.spot import chief_reference, image_rays
from raytrace.tracing.trace import is_bent, without_apertures
from raytrace.tracing.wavefront import clear_wavefront, wavefront_of, without
from raytrace.viewer.compute import spots_of

CASES = Path(__file__).parent / "cases"
EXAMPLES = Path(__file__).parents[1] / "lenses" / "examples"
GLASS = 1.5168
SINGLE = {"wavelengths": [0.5876]}


def _triplet(**conditions) -> Lens:
    return rt.read_lens("cooke_triplet").at(**{"fields": [0, 8], "ray_aiming": "real", **conditions})


def _in_glass() -> Lens:
    """A singlet whose sensor is cemented to its thick window."""
    rows = [
        dict(radius=40.0, thickness=6.0, glass=1.6),
        dict(radius=-90.0, thickness=30.0),
        dict(radius=math.inf, thickness=42.0, glass=GLASS),
    ]
    return rt.lens(rows, stop=1, entrance_pupil_diameter=8.0, fields=[0, 3], **SINGLE)


def _with_aperture(aperture: rt.system.Aperture) -> Lens:
    rows = [
        dict(thickness=0.0, apertures=(aperture,)),
        dict(radius=50.0, thickness=5.0, glass=1.5),
        dict(radius=-50.0, thickness=48.0),
    ]
    return rt.lens(rows, stop=1, entrance_pupil_diameter=8.0, fields=[0, 4], **SINGLE)


def _tilted() -> Lens:
    lens = _triplet(wavelengths=[0.5876])
    return lens.replace(3, tilt_x=0.4, y=0.05, tilt_x_after=-0.4, y_after=-0.05)


def _inches() -> Lens:
    lens = rt.read_lens(CASES / "inches.zmx")
    assert float(lens.surfaces[-2].thickness) > 25.4
    return lens


def _zoom() -> Lens:
    return _triplet(wavelengths=[0.5876]).with_configurations(thickness={2: [12.93, 12.8], 7: [77.4, 77.3]})


#: Lenses that form an image; every field of each is lit.
ZOO = {
    "triplet": _triplet,
    "finite object": lambda: _triplet(object_distance=400.0, sensor_distance=108.9, fields=[0, 7]),
    "sensor in glass": _in_glass,
    "immersed ellipsoid": lambda: rt.read_lens(CASES / "immersed_ellipsoid.zmx"),
    "obscured": lambda: rt.read_lens("hubble"),
    "obscured asphere": lambda: rt.read_lens(CASES / "obscured_asphere.zmx"),
    "annulus": lambda: _with_aperture(rt.system.Aperture("circular", (2.0, 4.0))),
    "rectangular stop": lambda: _with_aperture(rt.system.Aperture("rectangular", (3.51, 1.49))),
    "vane": lambda: _with_aperture(rt.system.Aperture("rectangular", (0.5, 6.5), obscures=True)),
    "tilted element": _tilted,
    "mirrors off the axis": lambda: rt.read_lens(EXAMPLES / "off_axis_telescope.zmx"),
    "folded": lambda: rt.read_lens(EXAMPLES / "folded_relay.zmx"),
    "aspheres": lambda: rt.read_lens("phone"),
    "vignetting factors": lambda: rt.read_lens("double_gauss_28deg").at(wavelengths=[0.546]),
    "clipped": lambda: _triplet(**SINGLE).replace(6, apertures=(rt.system.Aperture("circular", (0.0, 11.0)),)),
    "one configuration of two": lambda: dataclasses.replace(
        _zoom().configuration(2), operands=(), current_configuration=1
    ),
    "inches": _inches,
}


#: Lenses whose beams apertures clip.
CLIPPED = "obscured", "obscured asphere", "annulus", "rectangular stop", "vane", "clipped"
#: Lenses whose last space above is only near the focus.
UNFOCUSED = "finite object", "sensor in glass", "annulus", "rectangular stop", "vane", "inches"


@functools.cache
def member(name: str) -> Lens:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        lens = ZOO[name]()
        return rt.focus(lens).lens if name in UNFOCUSED else lens


@pytest.fixture(params=ZOO)
def lens(request) -> Lens:
    return member(request.param)


def relative_fields(lens: Lens) -> list[list[float]]:
    """Hx, Hy of the lens's fields, as operands take them."""
    fields = own_fields(lens)
    largest = torch.hypot(*fields).max()
    return (fields / torch.where(largest > 0, largest, 1.0)).T.tolist()


def operand(lens: Lens, name: str, integers: tuple = (), numbers: tuple = ()) -> float:
    """The value of one operand, in its unit."""
    return rt.evaluate(lens, merit=rt.Merit([rt.system.Row(name, integers, numbers, weight=1.0)])).values.item()


def rule_of(lens: Lens) -> float:
    """The relative error of the default quadratures: 12 rings, whose arms end at edges where the beam is clipped."""
    return 1e-6 if bool(rt.spot(lens).arrivals.rays.valid.all()) else 1e-3


def quiet(law):
    """A law is checked with warnings off: lost rays and unfilled stops are not its subject."""
    return pytest.mark.filterwarnings("ignore")(law)


def close(value, expected, **tolerance):
    """Whether tensors agree, compared as lists: `pytest.approx` prints those entry by entry."""
    return torch.as_tensor(value).flatten().tolist() == pytest.approx(
        torch.as_tensor(expected).flatten().tolist(), **tolerance
    )


# -- spots ------------------------------------------------------------------------------------------------------------


@quiet
def test_spot_radii(lens):
    """The radius about the centroid by `spot`, along the field, and in the viewer."""
    spots = rt.spot(lens)
    radii, rel = spots.whole.rms_radius, rule_of(lens)
    curve = rt.rms_over_field(lens, spot=True, fields=own_fields(lens))
    assert close(curve.polychromatic, radii, rel=rel, abs=PICOMETRE)
    assert close(curve.rms, spots.each.rms_radius, rel=rel, abs=PICOMETRE)
    assert close(spots_of(lens, own_fields(lens))["rms"], radii / MICROMETRE, rel=1e-6, abs=1e-6)


@quiet
def test_fields_are_independent():
    """A field has the same spot, radii and all, whether or not another one is clipped.

    To 5e-14 mm, a few units in the last place of a path of 100 mm: torch rounds the slopes of several fields otherwise.
    """
    lens = rt.read_lens("cooke_triplet").replace(6, apertures=(rt.system.Aperture("circular", (0.0, 13.0)),))
    alone, together = rt.spot(lens, fields=[0]), rt.spot(lens, fields=[0, 20])
    assert bool(alone.arrivals.rays.valid.all())
    assert not bool(together.arrivals.rays.valid.all())
    for name in ("rms_radius", "geometric_radius", "centroid"):
        for spots in ("each", "whole"):
            numbers = [getattr(getattr(found, spots), name) for found in (alone, together)]
            axis = 1 if name == "centroid" else 0
            torch.testing.assert_close(*(number.select(axis, 0) for number in numbers), rtol=0, atol=5e-14)


@quiet
@pytest.mark.parametrize(
    "model", [rt.psf_models.Gaussian(order=16), rt.psf_models.DRT(order=5)], ids=["gaussian", "drt"]
)
def test_moments_of_kernels(lens, model):
    """Centroid and second moments of PSFs are those of spots."""
    lens = lens.at(wavelengths=lens.primary[None])
    spots, kernels = rt.spot(lens).whole, rt.psf(lens, model)
    size = float(spots.geometric_radius.max())
    covariance = kernels.ray_covariance[:, 0]
    assert close((covariance[0] + covariance[2]).sqrt(), spots.rms_radius, rel=1e-2, abs=PICOMETRE)
    assert close(kernels.ray_centroid[:, 0], spots.centroid, abs=2e-3 * size + PICOMETRE)


@quiet
def test_spot_merit(lens):
    """The default merit function of spots is the root mean square of their radii, where nothing clips."""
    if not bool(rt.spot(lens).arrivals.rays.valid.all()):
        pytest.skip("rows of a default merit function do not integrate up to the edge of an aperture")
    merit = rt.evaluate(lens, merit=rt.optimization.DefaultMerit("spot", rings=14, arms=24)).merit
    squares = rt.spot(lens).whole.mean_square_radius
    weights = lens.fields.weight / lens.fields.weight.sum()
    assert float(merit) == pytest.approx(float((weights * squares).sum().sqrt()), rel=1e-4, abs=PICOMETRE)


@quiet
def test_spot_of_tolerances(lens):
    """The nominal lens of a tolerance analysis without compensators has the spots of `rt.spot`."""
    rows = [rt.system.Tolerance("surface_tilt_x", (len(lens.surfaces) - 2,), -1e-3, 1e-3)]
    nominal = rt.tolerance(lens, rt.tolerancing.ToleranceTable(tuple(rows)), trials=0).nominal
    squares = rt.spot(lens).whole.mean_square_radius
    weights = lens.fields.weight / lens.fields.weight.sum()
    expected = float((weights * squares).sum().sqrt()) / MICROMETRE
    assert float(nominal) == pytest.approx(expected, rel=1e-4, abs=1e-6)  # by the fewest rings that give 1e-4


def less_mean_and_tilt(map_) -> torch.Tensor:
    """RMS (F,) in waves of maps of one wavelength less the plane that fits each best."""
    side = (2 * torch.arange(map_.opd.shape[-1], dtype=torch.float64) + 1) / map_.opd.shape[-1] - 1
    radii = []
    for opd, valid in zip(map_.opd[:, 0], map_.valid[:, 0], strict=True):
        y, x = valid.nonzero().T
        planes = torch.stack([torch.ones_like(side[x]), side[x], side[y]], 1)
        fitted = planes @ torch.linalg.lstsq(planes, opd[valid]).solution
        radii.append((opd[valid] - fitted).square().mean().sqrt())
    return torch.stack(radii)


@quiet
def test_wavefront_of_tolerances(lens):
    """The nominal lens of a tolerance analysis has the RMS wavefront of its maps, less mean and tilt."""
    lens = lens.at(wavelengths=lens.primary[None])
    sampling = sampling_of(lens)
    nominal = CRITERIA["wavefront"].quantity(lens, sampling).sqrt()
    weights = lens.fields.weight / lens.fields.weight.sum()
    expected = (weights * less_mean_and_tilt(rt.wavefront(lens, size=401)).square()).sum().sqrt()
    assert close(nominal, expected, rel=5e-3, abs=1e-6)


def clipped_and_moved(name: str) -> tuple[Lens, rt.tolerancing.ToleranceTable]:
    """A lens of one wavelength, and the decentre of the surface that clips its beams."""
    lens = member(name)
    lens = lens.at(wavelengths=lens.primary[None], fields=own_fields(lens)[:, -1:])
    surface = next(k for k, surface in enumerate(lens.surfaces) if surface.apertures)
    size = 0.02 * max(lens.surfaces[surface].apertures[0].extent)
    row = rt.system.Tolerance("surface_decenter_y", (surface,), -size, size)
    return lens, rt.tolerancing.ToleranceTable((row,))


@quiet
@pytest.mark.parametrize("name", [*CLIPPED[:-1], pytest.param(CLIPPED[-1], marks=pytest.mark.slow)])
def test_perturbed_lenses_of_tolerances(name):
    """A lens with errors has the RMS wavefront and the spot radius of its own clear pupil, whose edge has moved."""
    lens, rows = clipped_and_moved(name)
    sampling = sampling_of(lens)
    errors = torch.tensor([[-1.0], [0.0], [0.6]], dtype=torch.float64) * rows[0].maximum
    lenses, singles = (
        rt.tolerancing.perturbed(lens, rows, errors),
        [rt.tolerancing.perturbed(lens, rows, row) for row in errors],
    )
    waves = CRITERIA["wavefront"].quantity(lenses, sampling).sqrt()
    radii = CRITERIA["rms"].quantity(lenses, sampling).sqrt()
    expected = [variance_less_tilt(single, sampling).sqrt() for single in singles]
    assert close(waves, expected, rel=1e-4)
    spots = [rt.spot(single, fields=sampling.fields, rings=24).whole.mean_square_radius for single in singles]
    assert close(radii, [1e3 * (sampling.field_weights * square).sum().sqrt() for square in spots], rel=1e-4)


@quiet
def test_errors_that_clip_a_beam():
    """A rim that clips nothing of the nominal lens clips the beam of a lens in which it is decentred."""
    lens = rt.focus(_with_aperture(rt.system.Aperture("circular", (0.0, 4.05)))).lens
    rows, errors = (
        rt.tolerancing.ToleranceTable((rt.system.Tolerance("surface_decenter_y", (1,), -0.3, 0.3),)),
        torch.tensor([[0.0], [0.3]]),
    )
    sampling = sampling_of(lens)
    radii = CRITERIA["rms"].quantity(rt.tolerancing.perturbed(lens, rows, errors.double()), sampling).sqrt()
    spots = [
        rt.spot(rt.tolerancing.perturbed(lens, rows, row), fields=sampling.fields).whole for row in errors.double()
    ]
    expected = [1e3 * (sampling.field_weights * spot.mean_square_radius).sum().sqrt() for spot in spots]
    assert close(radii, expected, rel=1e-4)
    assert abs(float(radii[1] / radii[0]) - 1) > 0.01


def variance_less_tilt(lens: Lens, sampling) -> torch.Tensor:
    """Mean square () of the OPD of fields in waves², by the points of the clear pupil that `wavefront` has."""
    front = clear_wavefront(scene_of(lens, sampling.fields), 14, 96)
    flat = without(front, 3) / (1e-3 * lens.wavelengths[:, None])
    share = front.energy / front.energy.sum(-1, keepdim=True)
    return (sampling.field_weights * (share * flat * flat).sum(-1)[0, :, 0]).sum()


@quiet
@pytest.mark.parametrize("name", CLIPPED[1:4])
def test_derivatives_of_perturbed_lenses(name):
    """First and second derivatives of tolerances by a decentre include the motion of the edge."""
    lens, rows = clipped_and_moved(name)
    sampling = sampling_of(lens)
    study = Study([View(lens, CRITERIA["wavefront"], sampling)], dataclasses.replace(rows, compensators=()), loss=1.0)
    size, none = float(study.half), torch.zeros(1, 0, dtype=torch.float64)
    at = torch.tensor([[0.3 * size]], dtype=torch.float64)

    def variance(shift: float) -> float:
        return float(variance_less_tilt(rt.tolerancing.perturbed(lens, rows, at[0] + shift), sampling))

    step = 0.05 * size
    less, here, more = variance(-step), variance(0.0), variance(step)
    first, second = (more - less) / (2 * step), (more - 2 * here + less) / step**2
    _, slope, _ = study.slope(at, none)
    behind, ahead = (study.slope(at + side * step, none)[1] for side in (-1, 1))
    assert float(slope) == pytest.approx(first, rel=1e-3)
    assert float((ahead - behind) / (2 * step)) == pytest.approx(second, rel=1e-2)


@quiet
def test_angles_behind_an_afocal_lens():
    """The nominal criterion of tolerances is the default merit function of angles."""
    rows = [
        dict(radius=103.36, thickness=4.0, glass=1.5168),
        dict(radius=-103.36, thickness=147.0),
        dict(radius=51.68, thickness=4.0, glass=1.5168),
        dict(radius=-51.68, thickness=20.0),
    ]
    lens = rt.lens(rows, stop=1, entrance_pupil_diameter=10.0, fields=[0, 1], **SINGLE)
    lens = dataclasses.replace(lens, afocal=True)
    tilt = rt.system.Tolerance("surface_tilt_x", (2,), -1e-3, 1e-3)
    nominal = rt.tolerance(lens, rt.tolerancing.ToleranceTable((tilt,)), trials=0).nominal
    merit = rt.evaluate(lens, merit=rt.optimization.DefaultMerit("angular", rings=8, arms=24)).merit
    assert 1e-3 * float(nominal) == pytest.approx(float(merit), rel=2e-4)  # q of the criterion to 1e-4


@quiet
def test_energy_of_kernels(lens):
    """The light that reaches the sensor is one share of the entrance pupil, by the rays and by the kernels."""
    lens = lens.at(wavelengths=lens.primary[None])
    spots = rt.spot(lens, rings=48)
    share = torch.where(spots.arrivals.rays.valid, spots.arrivals.weight, 0.0).sum(-1)[:, 0]
    share = share * beam_share(scene_of(lens, own_fields(lens)))[0, :, 0]
    window = dict(pixel=2.5 * float(spots.whole.geometric_radius.max()) / 21 + 1e-3, size=21)
    assert close(rt.psf(lens, rt.psf_models.DRT(order=5), **window).energy[0], share, abs=2e-2)


@quiet
def test_light_that_passes(lens):
    """One share of the entrance pupil by `vignetting`, `footprint` and the rays of `spot`; of a slow lens also by
    `relative_illumination`: below."""
    lens = lens.at(wavelengths=lens.primary[None])
    fields = own_fields(lens)
    share = rt.vignetting(lens, fields=fields).passed
    last = len(lens.surfaces) - 1
    assert close(rt.footprint(lens, last, fields=fields).passed_by_lens[0, :, 0], share, rel=1e-9)
    spots = rt.spot(lens, rings=48)
    counted = torch.where(spots.arrivals.rays.valid, spots.arrivals.weight, 0.0).sum(-1)[:, 0]
    assert close(share, counted * beam_share(scene_of(lens, fields))[0, :, 0], abs=5e-3)


@quiet
def test_light_that_passes_and_illumination():
    """In a slow lens solid angles are areas of the pupil: apertures cut the same share of both."""
    whole = _triplet(f_number=40, wavelengths=[0.5876], fields=[0, 8]).at(ray_aiming="off")
    whole = dataclasses.replace(whole, fields=dataclasses.replace(whole.fields, vignetting=None))
    rim = rt.system.Aperture("circular", (0.0, 0.8), centre=(0.0, -0.2))
    clipped = whole.replace(whole.stop, apertures=(rim,))
    angles = [rt.relative_illumination(each, fields=[0, 8]).projected_solid_angle for each in (clipped, whole)]
    share = rt.vignetting(clipped, fields=[0, 8]).passed
    assert bool((share < 0.99).all())
    assert close(angles[0] / angles[1], share, rel=2e-3)


# -- wavefronts -------------------------------------------------------------------------------------------------------


@quiet
def test_wavefront_rms(lens):
    """RMS by `wavefront`, by its own map, along the field, and by the operand about the chief ray."""
    lens = lens.at(wavelengths=lens.primary[None])
    map_ = rt.wavefront(lens, size=401)
    light = map_.valid / map_.valid.sum((-2, -1), keepdim=True)
    mean = (light * map_.opd).sum((-2, -1), keepdim=True)
    assert close((light * (map_.opd - mean) ** 2).sum((-2, -1)).sqrt(), map_.rms, rel=5e-3, abs=1e-6)
    curve = rt.rms_over_field(lens, reference="own", fields=own_fields(lens))
    assert close(curve.rms, map_.rms, rel=rule_of(lens), abs=1e-7)


@quiet
def test_wavefront_along_the_axes_of_the_pupil(lens):
    """OPD fans are lines of the map; ray fans are the spot's points along them, from the chief ray's."""
    fan, rays = rt.opd_fan(lens, points=21, reference="own"), rt.ray_fan(lens, points=21)
    line = torch.linspace(-1, 1, 21, dtype=torch.float64)
    for section, axis, points in (
        ("tangential", 1, torch.stack([0 * line, line])),
        ("sagittal", 0, torch.stack([line, 0 * line])),
    ):
        front = wavefront_of(scene_of(lens, own_fields(lens)), points)
        valid = getattr(fan, f"{section}_valid")
        assert valid.any() or section == "tangential"  # the vane covers it
        assert torch.equal(valid, front.valid[0])
        waves = front.opd[0] / (1e-3 * lens.wavelengths[:, None])
        assert close(waves[valid], getattr(fan, section)[valid], rel=1e-9, abs=1e-7)
        places = image_rays(lens, points).position[axis]
        chief = chief_reference(lens, own_fields(lens))[axis]
        assert close((places - chief[..., None])[valid], getattr(rays, section)[valid], rel=1e-9, abs=PICOMETRE)


@quiet
def test_strehl_ratio(lens):
    """By `wavefront` and by the operand, at the primary wavelength."""
    lens = lens.at(wavelengths=lens.primary[None])
    ratio = rt.wavefront(lens).strehl[:, 0]
    assert bool((ratio <= 1 + 1e-9).all())
    rows = [operand(lens, "STRH", (0, 1), (f + 1,)) for f in range(len(ratio))]
    assert close(rows, ratio, rel=1e-6)


# -- transfer functions and energy ------------------------------------------------------------------------------------

#: Lenses whose diffraction kernels are small enough for a window of a few hundred pixels.
SHARP = "immersed ellipsoid", "obscured asphere", "mirrors off the axis", "vane", "sensor in glass"


@quiet
def test_geometric_transfer(lens):
    """The geometric MTF is the transform of the DRT kernel, 1 at frequency 0."""
    lens = lens.at(wavelengths=lens.primary[None])
    pitch = float(rt.spot(lens).whole.geometric_radius.max()) / 40 + 1e-4
    kernel = rt.psf(lens, rt.psf_models.DRT(order=5), pixel=pitch, size=99, center="chief").kernel[0]
    frequencies = torch.tensor([0.0, 0.02, 0.06], dtype=torch.float64) / pitch
    at = pitch * (torch.arange(99) - 49)
    wave = torch.exp(-2j * math.pi * frequencies[:, None] * at) / torch.sinc(frequencies * pitch)[:, None]
    curve = rt.mtf(lens, frequencies, geometric=True)
    for direction, axis in (("tangential", -1), ("sagittal", -2)):
        spread = kernel.sum(axis)
        expected = (spread.to(wave) @ wave.T).abs() / spread.sum(-1, keepdim=True)
        assert close(getattr(curve, direction), expected, abs=1e-2), direction


@quiet
@pytest.mark.parametrize("name", SHARP)
def test_diffraction_transfer_and_energy(name):
    """MTF and encircled energy of diffraction are those of the wave kernel, on the axis at the primary wavelength."""
    lens = member(name).at(fields=[0], wavelengths=member(name).primary[None])
    cutoff = _cutoff(lens)
    pitch, size = 0.25 / cutoff, 301
    psf = rt.psf(lens, "wave", pixel=pitch, size=size, tol=1e-3)
    kernel, at = psf.kernel[0, 0], pitch * (torch.arange(size, dtype=torch.float64) - size // 2)
    frequencies = torch.tensor([0.1, 0.3, 0.6], dtype=torch.float64) * cutoff
    wave = torch.exp(-2j * math.pi * frequencies[:, None] * at) / torch.sinc(frequencies * pitch)[:, None]
    light = float(rt.psf(lens, rt.psf_models.DRT(order=5), pixel=1.0, size=21).energy)
    expected = (wave @ kernel.sum(1).to(wave)).abs() / light
    curve = rt.mtf(lens, [0.0, *frequencies.tolist(), 1.001 * cutoff], geometric=False)
    assert close(curve.tangential[0, 1:-1], expected, abs=2e-2)
    assert close(curve.tangential[0, [0, -1]], [1.0, 0.0], abs=2e-4)
    radius = 20 * pitch
    inside = torch.hypot(at[:, None], at) <= radius
    energy = rt.encircled_energy(lens, [radius], geometric=False).share[0]
    assert close(energy, kernel[inside].sum() / light, abs=1e-2)


@quiet
def test_modulation_has_a_limit(lens):
    """No MTF exceeds that of its pupil without aberrations, tangential or sagittal, of any field and wavelength."""
    lens = lens.at(wavelengths=lens.primary[None])
    curve = rt.mtf(lens, (_cutoff(lens) * torch.linspace(0, 1.1, 12, dtype=torch.float64)).tolist())
    if curve.limit is None:
        pytest.skip("the blur leaves nothing to diffraction")
    for modulation, limit in zip((curve.tangential, curve.sagittal), curve.limit, strict=True):
        assert bool((modulation <= limit + 5e-4)[~curve.by_rays].all())


def test_a_perfect_lens_reaches_its_limit():
    """In glass: a stigmatic ellipsoid has the cutoff of its numerical aperture, 1029.7 cycles/mm, not 1000."""
    lens = member("immersed ellipsoid")
    assert _cutoff(lens) == pytest.approx(1029.7, abs=0.1)
    curve = rt.mtf(lens, [0.0, 250.0, 500.0, 1000.0, 1025.0, 1031.0])
    assert close(curve.tangential, curve.limit[0], abs=1e-6)
    assert close(curve.sagittal, curve.limit[1], abs=1e-6)
    assert float(curve.limit[0, 0, 4]) > 1e-5
    assert float(curve.limit[0, 0, 5]) == pytest.approx(0.0, abs=2e-4)


def _cutoff(lens: Lens) -> float:
    """Cycles/mm beyond which nothing of the axial field is resolved: the width of the pupil in directions over λ."""
    line = torch.linspace(-1, 1, 201, dtype=torch.float64)
    rays = image_rays(without_apertures(lens), torch.stack([0 * line, line]), wavelengths=lens.primary[None])
    slopes = rays.direction[1].flatten()
    index = float(media(lens, lens.primary)[-2])
    return float(slopes.max() - slopes.min()) * index / (1e-3 * float(lens.primary))


# -- chief rays, focus and first-order data ---------------------------------------------------------------------------


@quiet
def test_chief_rays(lens):
    """Distortion and lateral colour are differences of the chief rays that `rays` lands on the sensor."""
    fields = own_fields(lens)
    if is_bent(lens) or not fields.any():
        pytest.skip("distortion is that of fields off a straight axis")
    landed = image_rays(lens, fields.new_zeros(2, 1), fields=fields).position[:2, ..., 0]
    heights = rt.distortion(lens, fields=fields).height
    assert close(heights.abs(), torch.hypot(*landed), rel=1e-9, abs=PICOMETRE)
    if len(lens.wavelengths) > 1:
        shift = rt.lateral_colour(lens, fields=fields).shift
        primary = landed[..., lens.primary_wavelength - 1, None]
        assert close(shift.abs(), torch.hypot(*(landed - primary)), rel=1e-6, abs=PICOMETRE)


@quiet
def test_image_height(lens):
    """`image_height` of a condition is the height of the largest field that `distortion` lists, of bent axes, too."""
    if not own_fields(lens).any():
        pytest.skip("an image height is that of a field off the axis")
    (condition,) = conditions_of(lens, "image_height=1")
    height = rt.distortion(lens, fields=largest_field(lens)).height[0, lens.primary_wavelength - 1]
    assert operand(lens, *dataclasses.astuple(condition.row)[:3]) == pytest.approx(abs(float(height)), rel=1e-9)


@quiet
def test_focus(lens):
    """The spot has its least RMS radius at the sensor distance that `focus` reports."""
    lens = lens.at(fields=own_fields(lens)[:, :1], wavelengths=lens.primary[None])
    best = float(rt.focus(lens).lens.surfaces[-2].thickness)
    step = 1e-3 * float(rt.first_order(lens).f_number.abs())  # moves the rim by a micrometre
    squares = [float(rt.spot(lens.at(sensor_distance=best + s)).whole.mean_square_radius) for s in (-step, 0, step)]
    vertex = 0.5 * step * (squares[0] - squares[2]) / (squares[0] - 2 * squares[1] + squares[2])
    assert squares[1] <= min(squares[0], squares[2])
    assert abs(vertex) < 1e-3 * step


@quiet
@pytest.mark.parametrize("name", ["triplet", "rectangular stop"])
def test_focus_as_built(name):
    """A camera as built moves its sensor as the compensator of tolerances, and at one field and wavelength as focus."""
    lens = member(name).at(fields=[0, 2])
    sensor = len(lens.surfaces) - 2
    rows = [rt.system.Tolerance(kind, (k,), -0.3, 0.3) for kind, k in (("surface_tilt_x", 2), ("thickness", sensor))]
    rows = rt.tolerancing.ToleranceTable(tuple(rows), (rt.system.Compensator(sensor),))
    errors = torch.tensor([[0.2, 0.03], [-0.3, -0.05]], dtype=torch.float64)

    def shift(lens: Lens) -> torch.Tensor:
        lenses = lens_as_built(lens, rows, errors, own_fields(lens)), rt.tolerancing.perturbed(lens, rows, errors)
        built, before = (each.surfaces[-2].thickness.flatten() for each in lenses)
        return built - before

    sampling = sampling_of(lens, own_fields(lens))
    _, moved = Study([View(lens, CRITERIA["rms"], sampling)], rows, loss=1.0).refocused(
        torch.cat([errors, torch.zeros_like(errors[:1])])
    )
    assert close(shift(lens), moved[:2, 0] - moved[2], rel=1e-4)
    lens = lens.at(fields=[0], wavelengths=lens.primary[None])
    distances = [
        float(rt.focus(each).sensor_distance) - float(each.surfaces[-2].thickness)
        for each in (lens, *(rt.tolerancing.perturbed(lens, rows, row) for row in errors))
    ]
    assert close(shift(lens), [distance - distances[0] for distance in distances[1:]], rel=1e-4)


@quiet
def test_derivatives_of_the_focus_of_a_clipped_lens():
    """The sensor distance has the derivatives of itself, the motion of the clear pupil's edge included."""
    lens = _with_aperture(rt.system.Aperture("rectangular", (3.51, 1.49)))

    def distance(curvature):
        return rt.focus(lens.replace(2, curvature=curvature)).sensor_distance

    here, step = lens.surfaces[2].curvature.detach().clone().requires_grad_(), 1e-5
    middle = distance(here)
    (first,) = torch.autograd.grad(middle, here, create_graph=True)
    (second,) = torch.autograd.grad(first, here)
    behind, ahead = (distance(here.detach() + side * step) for side in (-1, 1))
    assert float(first) == pytest.approx(float(ahead - behind) / (2 * step), rel=1e-6)
    assert float(second) == pytest.approx(float(ahead + behind - 2 * middle.detach()) / step**2, rel=1e-5)


def test_focal_lengths_of_an_image_in_glass():
    """`info` prints the focal length in air, of which the F/# is, beside that of the image space."""
    lens = _in_glass()
    text, data = str(rt.info(lens)), rt.first_order(lens)
    in_air = float(text.split("; focal length in air ")[1].split(" mm")[0])
    assert in_air == pytest.approx(float(data.f_number * data.entrance_pupil_diameter), rel=1e-8)
    assert in_air == pytest.approx(float(data.effective_focal_length) / GLASS, rel=1e-8)
    assert "image space" not in str(rt.info(_triplet()))  # in air they are one


@quiet
def test_first_order_data(lens):
    """Focal length, F-number and magnification: first-order data, operands, and the report of the lens."""
    if is_bent(lens):
        pytest.skip("operands of first order are those of a straight axis")
    data, report = rt.first_order(lens), rt.info(lens).document()
    for name, row, integers in (
        ("effective_focal_length", "EFFL", (0, lens.primary_wavelength)),
        ("f_number", "ISFN", ()),
        ("magnification", "PMAG", (0, lens.primary_wavelength)),
        ("image_na", "ISNA", ()),
    ):
        value = float(getattr(data, name))
        assert report[name] == pytest.approx(value, rel=1e-12), name
        assert operand(lens, row, integers) == pytest.approx(value, rel=1e-9, abs=1e-12), name
