"""The baselines: where each focuses, at which wavelength, against closed forms and a direct integral along the axis."""

import math

import pytest
import torch
from differences import gradcheck
from problems import number
from scipy.special import j0, j1

from raytrace.materials.catalogs import find_glass
from raytrace.materials.glass import constant, index
from raytrace.wave_optics.designs import BASELINES, FOCI, achromat, aim, baseline, converging, encircled_energy
from raytrace.wave_optics.element import Element, EvenPowers, Pixels, Rings, Zernike, height, path
from raytrace.wave_optics.fabrication import as_rings, features

COLOURS = torch.tensor([0.46, 0.55, 0.64], dtype=torch.float64)
PMMA, SILICA = find_glass("PMMA"), find_glass("F_SILICA")
#: 1/z_f + 1/z_s of the default aim, 1/mm.
POWER = 1 / 1000 + 1 / 35.5
#: Rounding of paths of 0.1 mm.
ROUNDING = 1e-15


def spheres(r, *distances):
    return sum(r**2 / (z + torch.sqrt(r**2 + z**2)) for z in distances)


def power(elements, wavelengths, at=1e-3):
    """-2 dpath/d(r²) next to the axis, by a finite difference: the power of smooth elements, 1/mm."""
    r = number([0.0, at])
    added = path(elements, r, 0 * r, wavelengths)
    return -2 * (added[:, 1] - added[:, 0]) / at**2


def along_axis(elements, setting, wavelengths, vergences, count=40_000):
    """|U|² (W, V) on the axis at 1/z = vergences, 1 where all light is in phase: a sum over r² of even steps."""
    r = setting.radius * torch.sqrt((torch.arange(count, dtype=torch.float64) + 0.5) / count)
    added = path(elements, r, 0 * r, wavelengths) + 0.5 * r**2 / setting.focus
    sums = []
    for v in vergences:
        phase = 2 * math.pi / (1e-3 * wavelengths[:, None]) * (added + 0.5 * v * r**2)
        sums.append(phase.cos().mean(-1) ** 2 + phase.sin().mean(-1) ** 2)
    return torch.stack(sums, -1)


def brightest(elements, setting, wavelength, near):
    """1/z of the brightest point on the axis within ± 0.2 1/m of `near`, in steps of 2 1/km."""
    vergences = near + torch.linspace(-2e-4, 2e-4, 201, dtype=torch.float64)
    light = along_axis(elements, setting, wavelength[None], vergences, count=20_000)[0]
    return vergences[light.argmax()], light.max()


# -- the aim ----------------------------------------------------------------------------------------------------------


def test_the_default_is_the_camera_of_the_literature():
    setting = aim()
    assert [float(n) for n in (setting.radius, setting.sensor, setting.focus, setting.wavelength)] == [
        2.5, 35.5, 1000.0, 0.55,
    ]  # fmt: skip
    assert abs(float(converging(setting)[0]) + POWER / 2) < ROUNDING


@pytest.mark.parametrize(("radius", "sensor", "focus"), [(2.5, 35.5, 1000.0), (2.5, 35.5, math.inf), (8.0, 10.0, 9.5)])
def test_true_spheres_are_met_by_the_series(radius, sensor, focus):
    setting = aim(radius=radius, sensor=sensor, focus=focus, exact=True)
    r = torch.linspace(0, radius, 50, dtype=torch.float64)
    result = path((Element(EvenPowers(converging(setting)), setting.radius, constant(2.0)),), r, 0 * r, COLOURS[:1])[0]
    wanted = -spheres(r, *(z for z in (number(sensor), number(focus)) if math.isfinite(z)))
    assert (result - wanted).abs().max() < 1e-11  # mm; λ/50,000,000


@pytest.mark.parametrize(
    ("name", "wrong"),
    [("radius", 0.0), ("sensor", -1.0), ("focus", math.nan), ("wavelength", 0.0), ("sensor", math.inf)],
)
def test_numbers_that_make_no_camera_are_refused(name, wrong):
    with pytest.raises(ValueError, match=f"{name} .*expected a positive number"):
        aim(**{name: wrong})


def test_spheres_too_steep_for_a_series_are_refused():
    with pytest.raises(ValueError, match=r"3 mm .*too steep"):
        converging(aim(sensor=3.0, radius=2.9, exact=True))
    assert len(converging(aim(sensor=3.0, radius=2.9))) == 1


# -- the table --------------------------------------------------------------------------------------------------------


def test_a_name_that_is_no_baseline_is_refused_with_the_list():
    with pytest.raises(ValueError, match=r"'kubic'; .*ideal, singlet, fresnel"):
        baseline("kubic", aim())
    with pytest.raises(TypeError):
        baseline("ideal", aim(), levels=16)


def short(name, setting):
    return baseline(name, setting, **({"iterations": 2} if name == "achromat" else {}))


@pytest.mark.parametrize("name", BASELINES)
@pytest.mark.parametrize("exact", [False, True])
def test_every_baseline_is_a_row_of_elements_of_the_aperture(name, exact):
    setting = aim(radius=0.5, sensor=20.0, focus=300.0, wavelength=0.5, exact=exact)
    elements = short(name, setting)
    assert elements
    assert all(float(element.radius) == 0.5 for element in elements)
    x = torch.linspace(-0.35, 0.35, 31, dtype=torch.float64)
    added = path(elements, x, x, COLOURS)
    assert torch.isfinite(added).all()
    assert added.dtype == torch.float64
    assert added.std() > 1e-5


@pytest.mark.parametrize("name", ["ideal", "singlet", "fresnel", "hybrid"])
@pytest.mark.parametrize("exact", [False, True])
def test_at_the_design_wavelength_all_light_arrives_in_phase(name, exact):
    """Path and spheres make whole waves: everywhere, or at the middle of every ring."""
    setting = aim(exact=exact)
    r = (torch.arange(1250, dtype=torch.float64) + 0.5) * 0.002
    added = path(baseline(name, setting), r, 0 * r, COLOURS[1:2])[0]
    distances = setting.sensor, setting.focus
    total = added + (spheres(r, *distances) if exact else 0.5 * POWER * r**2)
    waves = total / (1e-3 * setting.wavelength)
    assert (waves - waves.round()).abs().max() < 1e-9


# -- powers and colours -----------------------------------------------------------------------------------------------


def test_the_ideal_lens_has_one_power():
    assert (power(baseline("ideal", aim()), COLOURS) / POWER - 1).abs().max() < 1e-9


def test_the_singlet_focuses_as_its_index():
    result = power(baseline("singlet", aim()), COLOURS)
    assert (result / POWER - (index(PMMA, COLOURS) - 1) / (index(PMMA, COLOURS[1]) - 1)).abs().max() < 1e-9
    near = result - 1 / 1000
    for k in (0, 2):  # 0.37 and -0.23 dioptres off
        place, light = brightest(baseline("singlet", aim()), aim(), COLOURS[k], near[k])
        assert abs(float(place - near[k])) <= 2e-6
        assert light > 0.999


def test_the_fresnel_lens_focuses_as_the_wavelength():
    """1/z_s(λ) = P λ/λ₀ - 1/z_f: 4.8 dioptres either way, at its efficiency there and for flat rings."""
    lens = baseline("fresnel", aim())
    for k, wavelength in enumerate(COLOURS):
        near = POWER * wavelength / 0.55 - 1 / 1000
        place, light = brightest(lens, aim(), wavelength, near)
        assert abs(float(place - near)) <= 2e-6
        # sinc²(order mismatch), and sinc² of the waves across a flat ring, averaged over the area as an amplitude
        mismatch = float(0.55 / wavelength * (index(SILICA, wavelength) - 1) / (index(SILICA, COLOURS[1]) - 1) - 1)
        r = torch.linspace(0, 2.5, 4001, dtype=torch.float64)
        flat = torch.trapezoid(torch.sinc(0.002 * r * POWER / 0.55e-3) * 2 * r / 2.5**2, r)
        expected = float(torch.sinc(number(mismatch)) * flat) ** 2
        assert abs(float(light) - expected) < (0.003 if k == 1 else 0.01)


def test_the_hybrid_has_one_power_at_both_ends():
    smooth, etched = baseline("hybrid", aim())
    middle, ends = COLOURS[1:2], COLOURS[[0, 2]]
    refracted = power((smooth,), COLOURS)
    # The height of the kinoform before it is wrapped is -φ_d r²/2(n₀ - 1), at the middle of its rings.
    r = number([1e-3, 0.501])
    h = etched.profile.heights[[0, 250]]
    diffracted = -2 * (h[1] - h[0]) / (r[1] ** 2 - r[0] ** 2) * (index(SILICA, middle) - 1)
    total = refracted + diffracted * COLOURS / 0.55
    assert abs(float(total[1]) / POWER - 1) < 1e-9
    assert abs(float(total[0] - total[2])) < 1e-9 * POWER
    # by hand: V_r = 0.49358/(1.50004 - 1.48971) and V_d = -0.55/0.18
    n = index(PMMA, ends)
    v_smooth, v_etched = (index(PMMA, middle) - 1) / (n[0] - n[1]), 0.55 / (0.46 - 0.64)
    assert abs(float(refracted[1] / v_smooth + diffracted / v_etched)) < 1e-9 * POWER
    assert 0.93 < refracted[1] / POWER < 0.945
    assert etched.profile.heights.min() < -4 * etched.period  # rings carry the kinoform whole; it is wrapped when made


def test_the_hybrid_sharpens_all_colours_at_the_sensor():
    place = number([1 / 35.5])
    names = ("ideal", "singlet", "fresnel", "hybrid")
    light = {name: along_axis(baseline(name, aim()), aim(), COLOURS, place)[:, 0] for name in names}
    assert (light["ideal"] > 1 - 1e-9).all()
    assert light["hybrid"].min() > 0.3  # its secondary spectrum, and what the kinoform sends into other orders
    assert light["hybrid"][1] > 0.999
    assert light["singlet"][[0, 2]].max() < 0.1
    assert light["fresnel"][[0, 2]].max() < 0.01


# -- depth ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("exact", [False, True])
def test_every_annulus_of_the_multifocal_lens_has_its_focus(exact):
    setting = aim(exact=exact)
    (lens,) = baseline("multifocal", setting)
    r = (torch.arange(1250, dtype=torch.float64) + 0.5) * 0.002
    share = 5 * r**2 / 2.5**2
    added = path((lens,), r, 0 * r, COLOURS[1:2])[0]
    for k, focus in enumerate(FOCI):
        here = (share > k) & (share < k + 1)
        assert abs(int(here.sum()) / (1250 * (math.sqrt((k + 1) / 5) - math.sqrt(k / 5))) - 1) < 0.01  # equal area
        distances = [z for z in (35.5, focus) if math.isfinite(z)]
        total = spheres(r, *map(number, distances)) if exact else 0.5 * r**2 * sum(1 / z for z in distances)
        waves = (added + total)[here] / 0.55e-3
        assert (waves - waves.round()).abs().max() < 1e-9


@pytest.mark.parametrize("exact", [False, True])
def test_the_refractive_multifocal_lens_has_the_same_foci_without_a_wrap(exact):
    setting = aim(exact=exact)
    elements = baseline("multifocal-refractive", setting)
    assert all(element.period is None for element in elements)
    r = (torch.arange(677, dtype=torch.float64) + 0.5) * 0.00369  # the 678th ring is cut by the rim
    heights = elements[1].profile.heights[:677]
    added = path(elements, r, 0 * r, COLOURS[1:2])[0]
    annulus = (5 * r**2 / 2.5**2).long().clamp(max=4)
    for k, focus in enumerate(FOCI):
        distances = [z for z in (35.5, focus) if math.isfinite(z)]
        total = spheres(r, *map(number, distances)) if exact else 0.5 * r**2 * sum(1 / z for z in distances)
        assert (added + total)[annulus == k].abs().max() < 1e-12
    # what is left to flat rings of 3.69 µm is less than a fiftieth of a wave across a ring
    assert (heights.diff()[annulus.diff() == 0].abs() * 0.494).max() < 0.55e-3 / 50


def test_the_multifocal_lens_takes_other_foci():
    (lens,) = baseline("multifocal", aim(), foci=(1000.0,), levels=16)
    (same,) = baseline("fresnel", aim(), levels=16)
    assert (lens.profile.heights - same.profile.heights).abs().max() < 1e-15
    assert lens.levels == same.levels == 16


@pytest.mark.parametrize(("name", "glass"), [("cubic", SILICA), ("cubic-refractive", PMMA)])
@pytest.mark.parametrize("strength", [5.0, 20.0])
def test_the_cubic_plate_is_cubic(name, glass, strength):
    plain = {"cubic": "fresnel", "cubic-refractive": "singlet"}[name]
    *lens, plate = baseline(name, aim(), strength=strength)
    x, y = torch.meshgrid(*[torch.linspace(-2.5, 2.5, 21, dtype=torch.float64)] * 2, indexing="xy")
    expected = strength * 0.55e-3 * (x**3 + y**3) / 2.5**3
    result = path((plate,), x, y, COLOURS)
    assert (result[1] - expected).abs().max() < 1e-15 * 1e3  # beyond the rim polynomials grow
    ratio = (index(glass, COLOURS) - 1) / (index(glass, COLOURS[1]) - 1)
    assert (result - ratio[:, None, None] * expected).abs().max() < 1e-12
    assert isinstance(plate.profile, Zernike)
    r = torch.linspace(0, 2.5, 101, dtype=torch.float64)
    assert torch.equal(path(lens, r, r, COLOURS), path(baseline(plain, aim()), r, r, COLOURS))


@pytest.mark.parametrize("name", ["fresnel", "multifocal", "cubic", "hybrid", "achromat"])
def test_etched_baselines_come_in_sixteen_levels(name):
    options = {"iterations": 2} if name == "achromat" else {}
    etched = next(e for e in baseline(name, aim(), levels=16, **options) if isinstance(e.profile, Rings))
    r = (torch.arange(1250, dtype=torch.float64) + 0.5) * 0.002
    h = height(etched, r, 0 * r)
    assert set((h / etched.period * 16).round().int().tolist()) <= set(range(16))
    assert (h / etched.period * 16 - (h / etched.period * 16).round()).abs().max() < 1e-9
    assert len(etched.profile.heights) == 1250


# -- the diffractive achromat -----------------------------------------------------------------------------------------


def test_encircled_energy_is_airys_for_rings_too_fine_to_see():
    setting = aim(radius=0.5, sensor=10.0)
    lens = Element(EvenPowers(converging(setting) / (index(SILICA, COLOURS[1]) - 1)), setting.radius, SILICA)
    fine = as_rings(lens, 1e-4)
    energy = encircled_energy(setting, COLOURS, spot=0.01, pitch=1e-4, inner=2)(fine)
    v = 2 * math.pi * 0.01 * 0.5 / (0.55e-3 * 10.0)
    assert abs(float(energy[1]) - (1 - j0(v) ** 2 - j1(v) ** 2)) < 1e-4  # a ring at the rim is 0.01 waves wide
    assert (energy - energy[1]).abs()[[0, 2]].min() > 0.01  # the others are blurred, and have other Airy discs


@pytest.mark.parametrize("exact", [False, True])
def test_encircled_energy_is_that_of_a_direct_sum(exact):
    """∬ over rings and spot by plain midpoint sums, 25 radii in each of 160 drawn rings."""
    setting = aim(radius=0.8, sensor=12.0, focus=200.0, exact=exact)
    draw = torch.rand(160, dtype=torch.float64, generator=torch.Generator().manual_seed(5))
    made = Element(Rings(2e-3 * draw, number(0.005)), setting.radius, SILICA)
    r = (torch.arange(4000, dtype=torch.float64) + 0.5) * 0.0002
    rho = (torch.arange(400, dtype=torch.float64) + 0.5) * (0.02 / 400)
    total = spheres(r, setting.sensor, setting.focus) if exact else 0.5 * r**2 * (1 / 12 + 1 / 200)
    expected = []
    for k, wavelength in enumerate((1e-3 * COLOURS).tolist()):
        phase = 2 * math.pi / wavelength * (path((made,), r, 0 * r, COLOURS)[k] + total)
        bessel = torch.from_numpy(j0((2 * math.pi / (wavelength * 12) * rho[:, None] * r).numpy()))
        u = 2 * math.pi / (wavelength * 12) * (bessel * torch.polar(r, phase) * 0.0002).sum(-1)
        expected.append((u.abs() ** 2 * 2 * math.pi * rho * 5e-5).sum() / (math.pi * 0.8**2))
    result = encircled_energy(setting, COLOURS, spot=0.02, pitch=0.005)(made)
    assert (result - torch.stack(expected)).abs().max() < 2e-3 * result.max()  # 32 parts of a ring against 25


def test_the_fresnel_lens_keeps_its_light_in_green_alone():
    energy = encircled_energy(aim(), COLOURS, spot=0.015, pitch=0.002)
    result = energy(baseline("fresnel", aim())[0])
    assert abs(float(result[1]) - 0.850) < 2e-3
    assert result[[0, 2]].max() < 2e-3


@pytest.mark.slow
def test_the_achromat_shares_its_light_among_the_colours():
    """0.30, 0.25, 0.27 of the light in 15 µm, measured once; a Fresnel lens has 0.0016, 0.85, 0.0013."""
    (made,) = baseline("achromat", aim())
    result = encircled_energy(aim(), COLOURS, spot=0.015, pitch=0.002)(made)
    assert result.min() > 0.24
    assert -torch.log(result).sum() < 3.92
    assert (made.profile.heights >= 0).all()
    assert (made.profile.heights <= made.period).all()
    assert not made.profile.heights.requires_grad


def small():
    return aim(radius=0.2, sensor=8.0)


def test_the_achromat_climbs_and_repeats():
    energy = encircled_energy(small(), COLOURS, spot=0.01, pitch=0.002)
    reached = [float(torch.log(energy(achromat(small(), spot=0.01, iterations=k)[0])).sum()) for k in (0, 20, 200)]
    assert reached[0] < reached[1] < reached[2]
    again = [achromat(small(), spot=0.01, iterations=20)[0].profile.heights for _ in range(2)]
    assert torch.equal(*again)


def test_the_achromat_takes_another_engine_and_leaves_grad_mode_alone():
    """An engine that likes half waves only gets them."""
    with torch.no_grad():
        (made,) = achromat(
            small(), iterations=300, encircled=lambda e: torch.exp(-((1e3 * e.profile.heights - 0.6) ** 2)).mean()[None]
        )
    assert (made.profile.heights - 0.6e-3).abs().max() < 0.02e-3
    assert len(made.profile.heights) == features(number(0.2), number(0.002)) == 100


# -- numbers ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", [name for name in BASELINES if name != "achromat"])
@pytest.mark.parametrize("exact", [False, True])
def test_gradients_reach_all_numbers_of_the_camera(name, exact):
    x = number([0.1, -0.23, 0.31])

    def waves(sensor, focus, wavelength):
        setting = aim(radius=0.5, sensor=sensor, focus=focus, wavelength=wavelength, exact=exact)
        elements = tuple(Element(e.profile, e.radius, e.glass) for e in baseline(name, setting))  # no jumps
        return path(elements, x, 0.7 * x, COLOURS)

    numbers = [number(n).requires_grad_() for n in (20.0, 300.0, 0.55)]
    assert gradcheck(waves, numbers, eps=1e-6, atol=1e-6)


@pytest.mark.parametrize("name", BASELINES)
def test_float32_stays_float32(name):
    double = short(name, aim(radius=0.5))
    single = short(
        name, aim(**{key: torch.tensor(n) for key, n in (("radius", 0.5), ("sensor", 35.5), ("focus", 1e3))})
    )
    for exact, result in zip(double, single, strict=True):
        assert result.radius.dtype == torch.float32
        kept = getattr(result.profile, "heights", getattr(result.profile, "coefficients", None))
        wanted = getattr(exact.profile, "heights", getattr(exact.profile, "coefficients", None))
        assert (kept - wanted).abs().max() < 1e-5 * wanted.abs().max()


def test_no_baseline_is_a_map_of_pixels():
    """2500² pixels would be slow to look up in every pupil sum: the two that are not radial are polynomials."""
    for name in BASELINES:
        assert not any(isinstance(element.profile, Pixels) for element in short(name, aim(radius=0.5)))
