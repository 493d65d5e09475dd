"""Expansion: a lens at another temperature against OpticStudio's stored numbers, closed forms, laws and differences."""

import dataclasses
import math
import re
import warnings
from functools import partial

import pytest
import torch
from differences import gradcheck, gradgradcheck

import raytrace as rt
from raytrace.materials.catalogs import find_glass
from raytrace.materials.environment import Environment, NoThermalCoefficients, index_in
from raytrace.materials.mounts import MOUNTS, expansion_of
from raytrace.system.expansion import expanded
from raytrace.system.surface import sag_at

float64 = partial(torch.tensor, dtype=torch.float64)


def doublet():
    """A doublet of OpticStudio's short course at 20 °C, in an aluminium barrel (23.5e-6/K), held at 15 mm."""
    rows = [
        dict(curvature=9.324519649796e-3, thickness=6.0, glass="N-BAF51", semi_diameter=15.0),
        dict(curvature=-2.562974572830e-2, thickness=3.0, glass="SF6", semi_diameter=15.0),
        dict(curvature=-9.881789963176e-3, thickness=97.376047, semi_diameter=15.0, expansion=23.5),
    ]
    wavelengths = dict(wavelengths=[0.486, 0.589, 0.656], primary_wavelength=2)
    return rt.lens(rows, stop=1, entrance_pupil_diameter=20.0, catalogs=["SCHOTT"], **wavelengths)


def test_doublet_has_the_numbers_that_opticstudio_stored_at_100_degrees():
    """To the 13 digits of the file: cemented face as the glass behind it, spacer between edges that expand with it."""
    hot = doublet().at(temperature=100)
    curvatures = [surface.curvature.item() for surface in hot.surfaces[1:4]]
    assert curvatures == pytest.approx([9.318280129422e-3, -2.561314840813e-2, -9.875390709996e-3], rel=1e-12)
    thicknesses = [surface.thickness.item() for surface in hot.surfaces[1:4]]
    assert thicknesses == pytest.approx([6.0040176, 3.001944, 97.55771961840], abs=1e-11)
    sizes = [surface.semi_diameter for surface in hot.surfaces[1:4]]
    assert sizes == pytest.approx([15.010044, 15.00972, 15.00972], abs=1e-12)
    rim = float64([[0.0, 0.0], [1.0, -1.0]])
    radius = rt.trace(hot, rt.tracing.rays(hot, pupil=rim)).position[:2].norm(dim=0).max().item()
    assert radius == pytest.approx(6.883934874082e-3, abs=1e-11)


@pytest.mark.parametrize("stated", [{}, {"mount": 23.5}, {"mount": "23.5"}])
def test_a_mount_is_that_of_all_spaces_that_state_none(stated):
    lens = doublet() if not stated else doublet().replace(3, expansion=None)
    assert lens.at(temperature=100, **stated).surfaces[3].thickness.item() == pytest.approx(97.5577196184, abs=1e-11)
    assert doublet().at(mount="invar").surfaces[3].expansion.item() == 23.5
    without = doublet().replace(3, expansion=None).at(temperature=100)
    assert without.surfaces[3].thickness.item() == pytest.approx(97.3767790, abs=1e-7)  # its spacer keeps its length


# -- closed forms -----------------------------------------------------------------------------------------------------

#: SCHOTT's data sheets: D0, D1, D2, E0, E1, λ_TK, and the expansion from -30 to 70 °C.
DATA = {
    "N-BK7": (1.86e-6, 1.31e-8, -1.37e-11, 4.34e-7, 6.27e-10, 0.170, 7.1e-6),
    "F2": (1.51e-6, 1.56e-8, -2.78e-11, 9.34e-7, 1.04e-9, 0.250, 8.2e-6),
}


def opto_thermal(name, wavelength):
    """γ = (dN/dT)/(N - 1) - α in vacuum at 20 °C by hand (Jamieson, Opt. Eng. 20, 156 (1981)), and N."""
    D0, _, _, E0, _, resonance, expansion = DATA[name]
    n = index_in(find_glass(name, catalogs=["SCHOTT"]), float64(wavelength), Environment(float64(20.0), float64(0.0)))
    n = n.item()
    slope = (n * n - 1) / (2 * n) * (D0 + E0 / (wavelength**2 - resonance**2))
    return slope / (n - 1) - expansion, n


def per_kelvin(quantity, lens, step=1.0):
    """The derivative of a quantity by temperature at 20 °C, by differences."""
    warm, cold = (quantity(lens.at(temperature=20 + side * step)).item() for side in (1, -1))
    return (warm - cold) / (2 * step)


def focal_length(lens):
    return rt.first_order(lens).effective_focal_length


def thin(*rows, sensor=100.0):
    """Thin elements of curvatures and a glass in vacuum at 20 °C, the last face a plane."""
    listed = [dict(curvature=c, thickness=0.0, glass=glass) for c, glass in rows]
    lens = rt.lens(
        [*listed, dict(thickness=sensor)],
        stop=1,
        entrance_pupil_diameter=1.0,
        wavelengths=[0.5875618],
        catalogs=["SCHOTT"],
    )
    return lens.at(temperature=20, pressure=0)


def test_focal_length_of_a_thin_achromat_moves_by_the_opto_thermal_coefficients():
    """df/dT = -f² Σ γ_i φ_i (Smith, Modern Optical Engineering), of φ_i by the Abbe numbers in vacuum."""
    lines, powers, γ = (0.5875618, 0.4861327, 0.6562725), {}, {}
    for name in DATA:
        d, blue, red = (opto_thermal(name, line)[1] for line in lines)
        powers[name], γ[name] = (d - 1) / (blue - red), opto_thermal(name, lines[0])[0]
    (v1, v2), f = powers.values(), 100.0
    φ1, φ2 = v1 / (v1 - v2) / f, -v2 / (v1 - v2) / f
    n1, n2 = (opto_thermal(name, lines[0])[1] for name in DATA)
    back = φ2 / (n2 - 1)
    lens = thin((φ1 / (n1 - 1) + back, "N-BK7"), (back, "F2"))
    assert focal_length(lens).item() == pytest.approx(f, rel=1e-12)
    # In contact, yet each element expands by itself: the cemented face has the radius of the flint.
    apart = [dict(curvature=φ1 / (n1 - 1), thickness=0.0, glass="N-BK7"), dict(thickness=0.0)]
    apart += [dict(curvature=back, thickness=0.0, glass="F2"), dict(thickness=f)]
    options = dict(stop=1, entrance_pupil_diameter=1.0, wavelengths=lines[:1], catalogs=["SCHOTT"])
    lens = rt.lens(apart, **options).at(temperature=20, pressure=0)
    expected = -f * f * (γ["N-BK7"] * φ1 + γ["F2"] * φ2)
    assert per_kelvin(focal_length, lens) == pytest.approx(expected, rel=1e-3)


def test_a_singlet_in_aluminium_leaves_its_sensor_by_both_coefficients():
    """d(focus - sensor)/dT = -f (γ + α) of glass and mount."""
    γ, n = opto_thermal("N-BK7", 0.5875618)
    lens = thin((0.01 / (n - 1), "N-BK7")).at(mount="aluminium")

    def defocus(lens):
        return rt.first_order(lens).back_focal_distance - lens.surfaces[-2].thickness

    expected = -100.0 * (γ + 23.6e-6)
    assert per_kelvin(defocus, lens) == pytest.approx(expected, rel=1e-3)
    invar = lens.replace(2, expansion="invar")
    assert per_kelvin(defocus, invar) == pytest.approx(expected + 100.0 * (23.6e-6 - 1.3e-6), rel=1e-3)


# -- laws -------------------------------------------------------------------------------------------------------------


def test_a_lens_of_one_material_is_scaled():
    """Constant indices and one expansion everywhere: all lengths grow by s, whatever the shapes and edges."""
    rows = [
        dict(radius=40.0, thickness=6.0, glass=1.6, conic=-0.5, coefficients=[0.0, 2e-6, -3e-9], expansion=20.0),
        dict(radius=-55.0, thickness=9.0, expansion=20.0),
        dict(radius=-30.0, thickness=2.0, glass=1.7, expansion=20.0),
        dict(radius=-60.0, thickness=60.0, expansion=20.0),
    ]
    lens, s = rt.lens(rows, stop=2, entrance_pupil_diameter=10.0, fields=[0, 6]), 1 + 20e-6 * 80
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NoThermalCoefficients)
        hot = lens.at(temperature=100)
    assert focal_length(hot).item() == pytest.approx(s * focal_length(lens).item(), rel=1e-13)
    for before, after in zip(lens.surfaces[1:], hot.surfaces[1:], strict=True):
        assert after.thickness.item() == pytest.approx(s * before.thickness.item(), rel=1e-13)


_FIELDS = dict(
    odd=dict(kind="odd asphere", radius=50.0, coefficients=[1e-3, 1e-4, 1e-5]),
    toroidal=dict(kind="toroidal", radius=50.0, coefficients=[0.01, 1e-4, 1e-7]),
    biconic=dict(kind="biconic", radius=50.0, conic=0.2, coefficients=[0.01, -0.4]),
    zernike=dict(sag_terms=rt.system.sag_terms.ZernikeSag(float64([0.0, 1e-3, 2e-3, 3e-3, 4e-3]), float64(8.0))),
    tilt=dict(sag_terms=rt.system.sag_terms.TiltSag(float64(0.01), float64(-0.02))),
    grid=dict(sag_terms=rt.system.sag_terms.GridSag(1e-3 * torch.ones(6, 6).double().cumsum(0), float64(4.0))),
)


@pytest.mark.parametrize("name", _FIELDS)
def test_every_surface_keeps_its_shape(name):
    """z′(s x, s y) = s z(x, y)."""
    rows = [dict(thickness=3.0, glass="N-BK7", **_FIELDS[name]), dict(thickness=50.0)]
    surfaces = rt.lens(rows, stop=1, entrance_pupil_diameter=5.0).surfaces
    warmer = float64(500.0)
    s, grown = 1 + 7.1e-6 * 500, expanded(surfaces, warmer, {1: float64(4.0)})[1]
    x, y = float64([0.0, 1.0, -2.0, 3.0]), float64([1.0, 2.0, 2.5, -3.0])
    assert torch.allclose(sag_at(grown, s * x, s * y), s * sag_at(surfaces[1], x, y), rtol=1e-12, atol=1e-15)


def test_phases_poses_and_apertures_grow():
    rim = rt.system.Aperture("circular", (0.0, 5.0), centre=(0.0, 1.0))
    grating = rt.system.phases.Grating(float64(0.3), float64(1.0))
    rows = [
        dict(thickness=3.0, glass="N-BK7", y=0.5, tilt_x=2.0, phase=grating, apertures=(rim,)),
        dict(thickness=50.0),
    ]
    lens, s = rt.lens(rows, stop=1, entrance_pupil_diameter=5.0), 1 + 7.1e-6 * 100
    hot = lens.at(temperature=120).surfaces[1]
    assert hot.before.y.item() == pytest.approx(0.5 * s, rel=1e-15)
    assert hot.before.tilt_x.item() == 2.0
    assert hot.phase.frequency.item() == pytest.approx(0.3 / s, rel=1e-15)
    assert (hot.apertures[0].extent[1], hot.apertures[0].centre[1]) == pytest.approx((5.0 * s, s), rel=1e-15)


def test_a_gap_in_an_environment_of_its_own_keeps_its_temperature():
    lens = doublet().replace(3, environment=Environment(float64(20.0), float64(0.0)))
    hot = lens.at(temperature=100)
    assert hot.surfaces[1].thickness.item() == pytest.approx(6.0040176, abs=1e-12)
    assert hot.surfaces[3].thickness.item() < 97.38


def test_configurations_expand_each_from_its_own_numbers():
    lens = doublet().with_configurations(thickness={3: [97.376047, 110.0]})
    hot = lens.at(temperature=100)
    assert [len(lens.configurations), len(hot.configurations)] == [2, 2]
    alone = [doublet().at(sensor_distance=t).at(temperature=100) for t in (97.376047, 110.0)]
    for one, other in zip(hot.configurations, alone, strict=True):
        assert one.surfaces[3].thickness.item() == other.surfaces[3].thickness.item()
        assert one.surfaces[1].curvature.item() == other.surfaces[1].curvature.item()


# -- derivatives ------------------------------------------------------------------------------------------------------


def test_derivatives_by_temperature_curvature_and_expansion():
    """First and second, also of the edges where rays reach, against differences."""
    rows = [dict(radius=50.0, thickness=6.0, glass="N-BK7"), dict(radius=-80.0, thickness=4.0)]
    rows += [dict(radius=-60.0, thickness=2.0, glass="F2"), dict(radius=-150.0, thickness=90.0)]
    base = rt.lens(rows, stop=1, entrance_pupil_diameter=12.0, fields=[0, 3], catalogs=["SCHOTT"])

    def lengths(temperature, curvature, expansion):
        lens = base.replace(2, curvature=curvature, expansion=expansion)
        lens = lens.at(temperature=20 + 100 * temperature)
        return lens.surfaces[2].thickness + lens.surfaces[1].thickness + 1e-2 * focal_length(lens)

    given = [float64(number, requires_grad=True) for number in (0.6, -1 / 80, 23.6)]
    assert gradcheck(lengths, given, eps=1e-5, atol=1e-9, rtol=1e-5)
    assert gradgradcheck(lengths, given, eps=1e-4, atol=1e-7, rtol=1e-4)


def test_lenses_of_a_batch_expand_as_each_of_them():
    lenses = [doublet().replace(3, expansion=α, curvature=c) for α, c in ((23.5, -0.01), (1.3, -0.011), (9.9, -0.009))]
    several = rt.system.batch(lenses).at(temperature=100)
    for k, lens in enumerate(lenses):
        for one, other in zip(several[k].surfaces[1:], lens.at(temperature=100).surfaces[1:], strict=True):
            assert one.thickness.item() == pytest.approx(other.thickness.item(), abs=1e-12)


# -- materials, files, warnings ---------------------------------------------------------------------------------------


def test_mounts_are_found_by_name_or_number():
    assert expansion_of("Stainless-304") == MOUNTS["stainless 304"].expansion
    assert expansion_of("aluminum") == 23.6
    assert (expansion_of(1.5), expansion_of("1.5")) == (1.5, 1.5)
    with pytest.raises(ValueError, match=r"mount 'inver': expected one of aluminium.*did you mean invar\?"):
        doublet().at(mount="inver")
    assert all(mount.grade and mount.source for mount in MOUNTS.values())


@pytest.mark.parametrize("suffix", [".zmx", ".csv", ".seq"])
def test_a_file_keeps_the_expansion_of_its_spaces(suffix, tmp_path):
    rt.write_lens(doublet(), tmp_path / f"doublet{suffix}")
    again = rt.read_lens(tmp_path / f"doublet{suffix}")
    assert [s.expansion if s.expansion is None else s.expansion.item() for s in again.surfaces] == [
        *[None] * 3,
        23.5,
        None,
    ]
    assert "expansion 23.5e-6/K" in str(rt.info(again))


def test_configurations_of_a_file_may_have_other_spacers(tmp_path):
    rt.write_lens(doublet(), tmp_path / "doublet.zmx")
    text = (tmp_path / "doublet.zmx").read_text()
    text = re.sub(
        r"MNUM 1 1\n.*", "MNUM 2 1\nTCEX 3 1 23.5 0 0 0 1 1 1.0 0.0 0\nTCEX 3 2 1.3 0 0 0 1 1 1.0 0.0 0", text
    )
    (tmp_path / "two.zmx").write_text(text)
    lens = rt.read_lens(tmp_path / "two.zmx")
    assert [each.surfaces[3].expansion.item() for each in lens.configurations] == [23.5, 1.3]


def test_a_glass_without_an_expansion_is_reported():
    lens = rt.lens([dict(radius=50.0, thickness=5.0, glass=1.5), dict(thickness=90.0)], stop=1, f_number=8)
    with pytest.warns(NoThermalCoefficients, match="no expansion is listed: its radii and thickness stay"):
        hot = lens.at(temperature=60)
    assert hot.surfaces[1].thickness.item() == 5.0
    with pytest.warns(NoThermalCoefficients) as caught:
        hot = lens.replace(1, expansion=8.0).at(temperature=60)
    assert "expansion" not in str(caught[0].message)
    assert hot.surfaces[1].thickness.item() == pytest.approx(5.0 * (1 + 8e-6 * 40), rel=1e-15)


def test_a_stop_that_sizes_the_beam_grows():
    lens = dataclasses.replace(doublet(), aperture=rt.system.SystemAperture("float_by_stop", float64(15.0)))
    assert lens.at(temperature=100).aperture.value.item() == pytest.approx(15.010044, abs=1e-12)
    assert math.isinf(lens.at(temperature=100).surfaces[0].thickness.item())
