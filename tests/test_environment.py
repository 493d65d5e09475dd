"""Environment: indices at a temperature and a pressure against figures of makers and of OpticStudio; derivatives."""

import dataclasses
import json
import warnings
from functools import partial

import pytest
import torch
from differences import gradcheck, gradgradcheck

import raytrace as rt
from raytrace.io import read_lens_with_report
from raytrace.materials.agf import parse_agf
from raytrace.materials.catalogs import SHIPPED, find_glass, shipped_catalog
from raytrace.materials.environment import Environment, NoThermalCoefficients, air_index, dn_dt, index_in, thermal
from raytrace.materials.glass import AIR, constant, from_table, model_glass, refractive_index
from raytrace.system.lens import index_behind, media
from raytrace.tracing.paraxial import first_order
from raytrace.tracing.spot import spot_of
from raytrace.tracing.trace import trace_lens

float64 = partial(torch.tensor, dtype=torch.float64)


def place(temperature, pressure):
    return Environment(float64(temperature), float64(pressure))


# -- air and glass ----------------------------------------------------------------------------------------------------


def test_air_has_the_index_that_opticstudio_takes():
    assert round(air_index(float64(0.55), 20.0, 1.0).item(), 8) == 1.00027308
    assert air_index(float64(0.55), 20.0, 0.0).item() == 1.0


#: dn/dT in 1e-6/K at 1060.0 nm, e and g, relative to air and to vacuum, from SCHOTT's data sheet of N-BK7.
LINES = (1.0600, 0.5460740, 0.4358343)
DATA_SHEET = {
    (-40, -20): ((2.4, 2.9, 3.3), (0.3, 0.8, 1.2)),
    (20, 40): ((2.4, 3.0, 3.5), (1.1, 1.6, 2.1)),
    (60, 80): ((2.5, 3.1, 3.7), (1.5, 2.1, 2.7)),
}


@pytest.mark.parametrize(("span", "printed"), DATA_SHEET.items(), ids=map(str, DATA_SHEET))
def test_change_of_index_is_that_of_the_data_sheet(span, printed):
    """To the last printed digit: a line keeps its wavelength in vacuum."""
    glass, lines = find_glass("N-BK7"), float64(LINES)
    ends = []
    for celsius in span:
        around = air_index(lines, celsius, 1.0)
        n = index_in(glass, lines * air_index(lines, 20.0, 1.0) / around, place(celsius, 1.0))
        ends.append(torch.stack([n, n * around]))
    slope = 1e6 * (ends[1] - ends[0]) / (span[1] - span[0])
    assert torch.round(slope, decimals=1).tolist() == [list(row) for row in printed]
    derivative = torch.stack(dn_dt(glass, lines, place(sum(span) / 2, 1.0)))
    assert (1e6 * derivative - slope).abs().max() < 4e-3  # what the third power of 10 K makes of it


def test_a_catalog_at_its_own_temperature_is_the_catalog():
    line = float64([0.45, 0.6, 1.0])
    for name, celsius in (("N-BK7", 20.0), ("S-BSL7", thermal(find_glass("S-BSL7")).reference), ("BSC7", 20.0)):
        glass = find_glass(name)
        assert thermal(glass).reference == celsius
        assert (index_in(glass, line, place(celsius, 1.0)) - refractive_index(glass, line)).abs().max() <= 3e-16
    assert thermal(find_glass("S-BSL7")).reference == 25.0


def test_pressure_alone_leaves_the_index_relative_to_vacuum():
    """The glass is as it was; the lens's wavelength and the lens's air are other ones."""
    glass, line = find_glass("SK16", catalogs=["SCHOTT"]), float64(0.55)
    air = air_index(line, 20.0, 1.0)
    beside_air = index_in(glass, line / air, place(20.0, 1.0))  # the same light: 0.55 µm long in vacuum
    assert index_in(glass, line, place(20.0, 0.0)).item() == pytest.approx((beside_air * air).item(), abs=1e-9)


@pytest.mark.parametrize(
    "catalog", [pytest.param(c, marks=() if c in ("INFRARED", "OHARA") else pytest.mark.slow) for c in SHIPPED]
)
def test_every_shipped_glass_has_an_index_at_every_temperature(catalog):
    for glass in shipped_catalog(catalog).glasses.values():
        line = float64(sum(glass.wavelength_range or (0.4, 0.7)) / 2)
        before, figures = refractive_index(glass, line), thermal(glass)
        for celsius, pressure in ((-40.0, 1.0), (80.0, 0.0)):
            after = index_in(glass, line, place(celsius, pressure))
            assert (after > 0) == (before > 0)
            assert abs(after - before) < 0.03, (glass.name, figures)  # germanium's, 4e-4/K


def test_no_index_stays_no_index_with_gradient_zero():
    celsius = float64(40.0, requires_grad=True)
    for glass, line in (
        (find_glass("N-BK7"), 9.5),
        (find_glass("N-BK7"), 0.0),
        (from_table([0.5], [1.5]), -1.0),
    ):
        n = index_in(glass, float64(line), Environment(celsius, float64(1.0)))
        assert n.item() == 0
        assert torch.autograd.grad(n, celsius, allow_unused=True)[0] in (None, 0)


def test_vacuum_of_the_catalog_is_vacuum_everywhere():
    vacuum, line = find_glass("VACUUM"), float64([0.4, 0.55, 1.0])
    for celsius, pressure in ((-40.0, 1.0), (100.0, 0.3), (20.0, 0.0)):
        n = index_in(vacuum, line, place(celsius, pressure)) * air_index(line, celsius, pressure)
        assert (n - 1).abs().max() < 2e-7  # the formula is a fit


@pytest.mark.parametrize("glass", [constant(1.333, "WATER"), model_glass(1.517, 64.2), AIR])
def test_a_medium_given_by_numbers_keeps_its_index_relative_to_air(glass):
    line = float64([0.45, 0.6])
    expected = refractive_index(glass, line)
    assert torch.equal(index_in(glass, line, place(60.0, 0.2)), expected)
    beside = index_in(glass, line, place(20.0, 1.0), place(20.0, 0.0)) * air_index(line, 20.0, 1.0)
    assert (beside - expected).abs().max() <= 3e-16


@pytest.mark.parametrize("name", ["N-BK7", "S-FPL53", "GERMANIUM", "H-ZF52"])
def test_derivatives_by_temperature_pressure_and_wavelength(name):
    glass = find_glass(name)
    line = float64([4.0, 9.0] if name == "GERMANIUM" else [0.45, 0.8], requires_grad=True)
    numbers = [float64(number, requires_grad=True) for number in (43.0, 0.7, -5.0, 0.2)]

    def index(line, *numbers):
        return index_in(glass, line, Environment(*numbers[:2]), Environment(*numbers[2:]))

    # A degree moves an index by 1e-6: what changes it is looked at a million times larger.
    assert gradcheck(lambda *given: 1e4 * index(*given), (line, *numbers), eps=1e-4, atol=1e-5)
    assert gradgradcheck(lambda *given: 1e4 * index(*given), (line, *numbers), eps=1e-3, atol=1e-5)


@pytest.mark.parametrize(
    ("record", "figures"),
    [
        ("TD - - - - - - -", (0.0,) * 6 + (20.0,)),
        ("TD 1e-6 _ - 0 0 - 25", (1e-6, 0.0, 0.0, 0.0, 0.0, 0.0, 25.0)),
        ("TD 1e-6 1e-8", (1e-6, 1e-8, 0.0, 0.0, 0.0, 0.0, 20.0)),
        ("TD", (0.0,) * 6 + (20.0,)),
        ("OD 1 1 1 1 1 1", (0.0,) * 6 + (20.0,)),
    ],
)
def test_thermal_figures_that_a_catalog_leaves_out_are_zero(record, figures):
    text = f"NM ONE 2 0 1.5 50.0 0 0\nCD 1.25 0 0 0 0 0\n{record}\nLD 0.3 2.5\n"
    assert tuple(thermal(parse_agf(text, "one.agf").glasses["ONE"])) == figures


# -- lenses -----------------------------------------------------------------------------------------------------------


def doublet_at_100_degrees():
    """A doublet of OpticStudio's short course, its radii and thicknesses as it stored them at 100 °C."""
    return rt.lens(
        [
            dict(curvature=9.3182801294216886e-3, thickness=6.0040176, glass="N-BAF51"),
            dict(curvature=-2.5613148408133123e-2, thickness=3.001944, glass="SF6"),
            dict(curvature=-9.8753907099957579e-3, thickness=97.5577196184),
        ],
        stop=1,
        entrance_pupil_diameter=20.0,
        wavelengths=[0.486, 0.589, 0.656],
        primary_wavelength=2,
        catalogs=["SCHOTT"],
    )


def image_radius(lens):
    rim = torch.tensor([[0.0, 0.0], [1.0, -1.0]], dtype=torch.float64)
    return rt.trace(lens, rt.tracing.rays(lens, pupil=rim)).position[:2].norm(dim=0).max().item()


def test_doublet_meets_the_radius_that_opticstudio_stored_at_100_degrees():
    """Wavelength 0.589 µm in air of 100 °C, in the catalog's air, at the resonance; other choices miss by 3e-9."""
    lens = doublet_at_100_degrees()
    hot = dataclasses.replace(lens, environment=place(100.0, 1.0))  # its numbers are those of 100 °C
    assert image_radius(hot) == pytest.approx(6.883934874082e-3, abs=1e-12)
    assert image_radius(lens) > 1.2e-2  # at the catalog's temperature it is another lens


def vacuum_cell():
    """A lens in a cell without air, behind windows (OpticStudio's sample, at 0.55 µm)."""
    rows = [(0.0, 5.0, ""), (0.0, 2.0, "SK16"), (0.0, 15.0, ""), (0.01, 5.0, "SK16"), (-0.01, 15.0, "")]
    rows += [(0.0, 2.0, "SK16"), (0.0, 63.25768502176, "")]
    rows = [dict(curvature=c, thickness=t, **({"glass": glass} if glass else {})) for c, t, glass in rows]
    lens = rt.lens(rows, stop=1, entrance_pupil_diameter=4.0, fields=[0, 15], wavelengths=[0.55], catalogs=["SCHOTT"])
    for gap in (3, 5):
        lens = lens.replace(gap, environment=place(20.0, 0.0))
    return lens


def test_vacuum_in_a_cell_is_thinner_than_the_air_around_it():
    """The solved image distance that OpticStudio stored with 13 digits, and the radius of its image."""
    lens = vacuum_cell()
    assert media(lens, lens.wavelengths)[3].item() == pytest.approx(1 / 1.00027308, abs=1e-8)
    assert first_order(lens).paraxial_image_distance.item() == pytest.approx(63.25768502176, abs=1e-11)
    rim = torch.tensor([[0.0, 0.0], [1.0, -1.0]], dtype=torch.float64)
    height = rt.trace(lens, rt.tracing.rays(lens, pupil=rim)).position[1].abs().max().item()
    assert height == pytest.approx(21.2820365547, abs=4e-8)
    in_vacuum = lens.at(pressure=0.0)  # all of it: the windows are as they were, the gaps as their surroundings
    assert media(in_vacuum, lens.wavelengths)[3].item() == 1.0


def test_without_an_environment_nothing_is_computed_for_it(monkeypatch):
    lens = rt.read_lens("double_gauss")
    before = media(lens, lens.wavelengths)
    monkeypatch.setattr("raytrace.system.lens.index_in", None)
    assert all(torch.equal(a, b) for a, b in zip(before, media(lens, lens.wavelengths), strict=True))
    assert lens.environment is None
    assert lens.at(f_number=4).environment is None


def test_unspecified_conditions_of_an_environment_stay():
    lens = rt.read_lens("double_gauss").at(temperature=40)
    assert lens.environment.pressure.item() == 1.0
    lens = lens.at(pressure=0.5).at(object_distance=1e4)
    assert (lens.environment.temperature.item(), lens.environment.pressure.item()) == (40.0, 0.5)
    assert rt.read_lens("double_gauss").at(pressure=0).environment.temperature.item() == 20.0


def test_a_medium_that_does_not_change_is_one_tensor():
    lens = rt.read_lens("double_gauss").at(temperature=40)
    indices = media(lens, lens.wavelengths)
    assert indices[0] is indices[1] or lens.surfaces[1].glass.name
    air = [n for n, surface in zip(indices, lens.surfaces, strict=True) if not surface.glass.name]
    assert len({id(n) for n in air}) == 1
    assert all(torch.equal(index_behind(lens, k, lens.wavelengths), n) for k, n in enumerate(indices))


def test_mirrors_keep_the_medium_before_them():
    rows = [dict(radius=-200.0, thickness=-95.0, glass="MIRROR"), dict(radius=-60.0, thickness=80.0, glass="MIRROR")]
    lens = rt.lens(rows, stop=1, entrance_pupil_diameter=20.0)
    assert [n.item() for n in media(lens.at(temperature=-30, pressure=0.3), lens.wavelengths[0])] == [1.0] * 4


@pytest.mark.parametrize("engine", ["eager", "compiled"])
def test_derivatives_of_a_spot_by_temperature_and_pressure(engine):
    lens = rt.read_lens("double_gauss")

    def spread(celsius, pressure):
        found = lens.at(temperature=celsius, pressure=pressure)
        rays = rt.tracing.rays(found, fields=[0, 10], pupil=rt.maths.gauss_rings(4))
        traced = trace_lens(found, rays, found.wavelengths[:, None])
        return spot_of(traced, rt.maths.gauss_rings(4)[1]).mean_square_radius

    with rt.tracing.trace_engine(engine):
        given = (float64(35.0, requires_grad=True), float64(0.6, requires_grad=True))
        # 1e-6 a degree: steps of a hundredth of a degree and of an atmosphere are far above rounding.
        assert gradcheck(spread, given, eps=1e-2, atol=1e-9, rtol=1e-4)
        found = torch.autograd.grad(spread(*given).sum(), given)
    with rt.tracing.trace_engine("eager"):
        expected = torch.autograd.grad(spread(*given).sum(), given)
    assert torch.allclose(torch.stack(found), torch.stack(expected), rtol=1e-9)


def test_temperatures_side_by_side():
    lens, several = doublet_at_100_degrees(), float64([-20.0, 20.0, 60.0])

    def focal_length(celsius):
        placed = dataclasses.replace(lens, environment=Environment(celsius, float64(1.0)))
        return first_order(placed).effective_focal_length

    found = torch.func.vmap(focal_length)(several)
    alone = [focal_length(celsius).item() for celsius in several]
    assert found.tolist() == pytest.approx(alone, rel=1e-15)
    assert len(set(alone)) == 3


# -- refusals and warnings -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("conditions", "said"),
    [
        (dict(temperature=-273.0), "`temperature=-273`: expected degrees Celsius above -272"),
        (dict(temperature=float("inf")), "`temperature=inf`: expected degrees"),
        (dict(pressure=-1e-3), "`pressure=-0.001`: expected atmospheres, 0 .vacuum. or more"),
        (dict(pressure=float("nan")), "`pressure=nan`"),
        (dict(temperature="warm"), "'warm' is not a number"),
    ],
)
def test_impossible_temperatures_and_pressures_are_refused(conditions, said):
    with pytest.raises(ValueError, match=said):
        rt.read_lens("double_gauss").at(**conditions)


def test_a_surface_in_an_air_that_there_is_not_is_refused():
    lens = rt.read_lens("double_gauss").replace(3, environment=place(20.0, -1.0))
    with pytest.raises(ValueError, match="surface 3: `pressure=-1`"):
        lens.at(f_number=4)


def test_a_glass_whose_change_is_not_known_is_reported_once_with_its_surface():
    rows = [dict(radius=50.0, thickness=5.0, glass=glass) for glass in ("LZ_K8", (1.6, 40.0), "LZ_K8", "N-BK7")]
    lens = rt.lens(rows, stop=1, f_number=8)
    with pytest.warns(NoThermalCoefficients) as caught:
        lens.at(temperature=40)
    messages = [str(warning.message) for warning in caught]
    assert len(messages) == 2
    assert messages[0].startswith("surface 1: LZ_K8 (LZOS) has no thermal coefficients: at 40 °C it keeps its index")
    assert messages[1].startswith("surface 2: the medium of index 1.6 is not of a catalog")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        lens.at(temperature=20, pressure=1)
        doublet_at_100_degrees().at(temperature=-40, pressure=0)


# -- the command ------------------------------------------------------------------------------------------------------


def test_temperature_and_pressure_are_conditions_of_a_command(command):
    words = ("info", "double_gauss", "--json")
    plain = json.loads(command(*words)[1])
    found = json.loads(command(*words, "--temperature", 40, "--pressure", 0)[1])
    lens = rt.read_lens("double_gauss").at(temperature=40, pressure=0)
    assert found["effective_focal_length"] == first_order(lens).effective_focal_length.item()
    assert found["environment"] == {"temperature": 40.0, "pressure": 0.0}
    assert [*plain] == [key for key in found if key != "environment"]
    assert (
        "environment              40 °C and 0 atm"
        in command("info", "double_gauss", "--temperature", 40, "--pressure", 0)[1]
    )
    assert "in 20 °C and 0 atm" in str(rt.info(vacuum_cell()))
    assert rt.info(vacuum_cell()).document()["surfaces"][3]["environment"] == {"temperature": 20.0, "pressure": 0.0}


def test_the_command_prints_a_glass_at_a_temperature(command):
    code, out, err = command("glass", "N-BK7", "--temperature", 30, "--wavelength", *LINES)
    assert code == 0, err
    headings, units, *rows = out.splitlines()[-2 - len(LINES) :]
    assert headings.split() == ["wavelength", "index", "dn/dT,", "air", "dn/dT,", "vacuum", "internal"]
    assert units.split() == ["µm", "1/K", "1/K", "transmittance,", "10", "mm"]
    slopes = [line.split()[2:4] for line in rows]
    assert [tuple(round(1e6 * float(number), 1) for number in column) for column in zip(*slopes, strict=True)] == [
        *DATA_SHEET[20, 40]
    ]
    found = json.loads(command("glass", "N-BK7", "--pressure", 0, "--json")[1])
    assert found["dn_dt"] == pytest.approx(found["dn_dt_absolute"])
    assert [*json.loads(command("glass", "N-BK7", "--json")[1])][-1] == "indices"
    code, out, err = command("glass", "LZ_K8", "--temperature", -300)
    message = "raytrace: error: LZ_K8: --temperature -300: expected degrees Celsius above -272; thermal coefficients"
    assert (code, err.strip()) == (1, f"{message} of catalogs hold from -100 to 140")
    assert "no thermal coefficients" in command("glass", "LZ_K8", "--temperature", 30)[2]


# -- tables -----------------------------------------------------------------------------------------------------------


def same_environments(one, other):
    pairs = zip((one, *one.surfaces), (other, *other.surfaces), strict=True)
    for a, b in ((a.environment, b.environment) for a, b in pairs):
        assert (a is None) == (b is None)
        if a is not None:
            assert torch.equal(a.temperature, b.temperature)
            assert torch.equal(a.pressure, b.pressure)


@pytest.mark.parametrize("suffix", [".csv", ".txt"])
def test_a_table_brings_environments_back_bit_for_bit(tmp_path, suffix):
    path = tmp_path / f"lens{suffix}"
    for lens in (vacuum_cell(), vacuum_cell().at(temperature=-40.1, pressure=1 / 3)):
        rt.write_lens(lens, path)
        same_environments(lens, rt.read_lens(path))
    rt.write_lens(rt.read_lens("double_gauss"), path)
    assert "temperature" not in path.read_text()


TABLE = "# temperature: {}\n# wavelengths: 0.55\n# fields: 0\n# aperture: EPD 5\n# stop: 1\nradius,thickness,glass{}\n"


@pytest.mark.parametrize(
    ("temperature", "rest", "said"),
    [
        ("40 °C", "\n50,5,N-BK7\ninf,90,\ninf,0,", ""),
        ("40 C", "\n50,5,N-BK7\ninf,90,\ninf,0,", ""),
        ("104 F", "\n50,5,N-BK7\ninf,90,\ninf,0,", r"lens.csv:1: temperature is '104 F', expected a finite number"),
        ("-300", "\n50,5,N-BK7\ninf,90,\ninf,0,", r"lens.csv:1: temperature=-300: expected degrees Celsius above -272"),
        (
            "40",
            ",pressure\n50,5,N-BK7,\ninf,90,,0\ninf,0,,",
            r"lens.csv:8, surface 2: a pressure alone; give temperature and",
        ),
        (
            "40",
            "\n50,5,LZ_K8\ninf,90,\ninf,0,",
            r"lens.csv:7, surface 1: LZ_K8 \(LZOS\) has no thermal coefficients: at 40 °C",
        ),
    ],
)
def test_a_table_reports_columns_that_it_cannot_read(tmp_path, temperature, rest, said):
    path = tmp_path / "lens.csv"
    path.write_text(TABLE.format(temperature, rest), encoding="utf-8")
    if said:
        with pytest.raises(rt.LensFileError, match=said):
            rt.read_lens(path, strict=True)
    else:
        assert rt.read_lens(path, strict=True).environment.temperature.item() == 40


# -- .zmx files -------------------------------------------------------------------------------------------------------

#: A cell without air, as a file of OpticStudio tells one: the gaps 3 and 5 stand between two pressures.
CELL = """MODE SEQ
UNIT MM
ENPD 4.0
ENVD {environment}
GCAT SCHOTT MISC
FTYP 0 0 2 1 0 0 0
XFLN 0 0
YFLN 0 15
WAVM 1 0.55 1
PWAV 1
{surfaces}MNUM 1 1
{operands}
"""
ROWS = [
    (0, "INFINITY", ""),
    (0, 5, ""),
    (0, 2, "SK16"),
    (0, 15, ""),
    (0.01, 5, "SK16"),
    (-0.01, 15, ""),
    (0, 2, "SK16"),
]
ROWS += [(0, 63.25768502176, ""), (0, 0, "")]
OPERANDS = """PRES 0 1 0.0 0 0 0 1 1 1.0 0.0 0
GLSS 3 1 "" 0 0 0 1 1 0 0.0
GLSS 4 1 "SK16" 0 0 0 1 1 0 0.0
GLSS 5 1 "" 0 0 0 1 1 0 0.0
PRES 0 1 1.0 0 0 0 1 1 1.0 0.0 0"""


def cell_file(folder, environment="20 1 1", operands=OPERANDS, glass="SK16"):
    surfaces = ""
    for k, (curvature, thickness, name) in enumerate(ROWS):
        stop, medium = "  STOP\n" * (k == 1), f"  GLAS {glass} 0 0 1.5 40\n" if name else ""
        surfaces += f"SURF {k}\n{stop}  CURV {curvature}\n  DISZ {thickness}\n{medium}"
    path = folder / "cell.zmx"
    path.write_text(CELL.format(environment=environment, surfaces=surfaces, operands=operands), encoding="utf-8")
    return path


def test_a_file_stores_surfaces_at_another_pressure(tmp_path):
    lens, report = read_lens_with_report(cell_file(tmp_path))
    assert not report.warnings
    assert [k for k, surface in enumerate(lens.surfaces) if surface.environment] == [3, 4, 5]
    assert lens.environment.pressure.item() == 1.0
    assert first_order(lens).paraxial_image_distance.item() == pytest.approx(63.25768502176, abs=1e-11)


def test_pressures_with_no_surface_between_them_hold_for_none(tmp_path):
    operands = "PRES 0 1 0.0 0 0 0 1 1 1.0 0.0 0\nMOFF 0 1\nPRES 0 1 1.0 0 0 0 1 1 1.0 0.0 0"
    lens, report = read_lens_with_report(cell_file(tmp_path, operands=operands))
    assert not any(surface.environment for surface in lens.surfaces)
    assert "PRES 0 atm (pressure of configuration 1): not followed" in report.warnings[0]


@pytest.mark.parametrize(
    ("environment", "kept", "said"),
    [
        ("20 1 0", None, ""),
        ("100 1 0", None, r"cell.zmx:4: environment of 100 °C and 1 atm, which indices do not follow .*third number 0"),
        ("1.0E+2 0.5 1", (100.0, 0.5), ""),
        ("-300 1 1", None, r"cell.zmx:4: temperature=-300: expected degrees Celsius above -272"),
        ("20 -1 1", None, r"cell.zmx:4: pressure=-1: expected atmospheres, 0 \(vacuum\) or more"),
        ("20 1 x", None, r"cell.zmx:4: .*whether indices follow the environment is 'x', expected a finite number"),
        ("hot 1 1", None, r"cell.zmx:4: .*temperature is 'hot', expected a finite number"),
    ],
)
def test_environment_of_a_file_is_followed_or_reported(tmp_path, environment, kept, said):
    path = cell_file(tmp_path, environment, "")
    if said:
        with pytest.raises(rt.LensFileError, match=said):
            rt.read_lens(path, strict=True)
    else:
        found = rt.read_lens(path, strict=True).environment
        assert (found and (found.temperature.item(), found.pressure.item())) == kept


def test_a_file_names_the_glasses_whose_change_is_not_known(tmp_path):
    """Once each, with the line of its first surface."""
    warnings_ = read_lens_with_report(cell_file(tmp_path, "40 1 1", "", "LZ_K8"))[1].warnings
    assert len(warnings_) == 1
    assert "cell.zmx:21, surface 2: LZ_K8 (LZOS) has no thermal coefficients" in warnings_[0]


@pytest.mark.parametrize("conditions", [{}, {"temperature": -40.1, "pressure": 1 / 3}])
def test_a_file_brings_environments_back_bit_for_bit(tmp_path, conditions):
    path, copy = tmp_path / "one.zmx", tmp_path / "two.zmx"
    first = rt.read_lens(cell_file(tmp_path))
    for lens in (first, vacuum_cell().at(pressure=0.7), doublet_at_100_degrees()):
        lens = lens.at(**conditions)
        rt.write_lens(lens, path)
        again = rt.read_lens(path, strict=True)
        same_environments(lens, again)
        assert torch.equal(torch.stack(media(lens, lens.wavelengths)), torch.stack(media(again, lens.wavelengths)))
        rt.write_lens(again, copy)
        same_environments(lens, rt.read_lens(copy, strict=True))
    rt.write_lens(rt.read_lens("double_gauss"), path)
    assert "\nENVD 20 1 0\n" in path.read_text()


def test_a_surface_in_an_environment_of_a_lens_without_one_is_not_written(tmp_path):
    with pytest.raises(rt.LensFileError, match=r"surface 3: .*environment of its own"):
        rt.write_lens(vacuum_cell(), tmp_path / "cell.zmx")
    assert not [*tmp_path.iterdir()]


THERMAL = """MNUM 2 2
TEMP 0 1 20 0 0 0 1 1 1.0 0.0 0
TEMP 0 2 100 0 0 0 1 1 1.0 0.0 0
PRES 0 1 1.0 0 0 0 1 1 1.0 0.0 0
PRES 0 2 0.5 0 0 0 1 1 1.0 0.0 0"""


def test_configurations_have_their_temperatures_and_pressures(tmp_path):
    path = cell_file(tmp_path, "100 0.5 1", "")
    path.write_text(path.read_text().replace("MNUM 1 1\n", THERMAL))
    lens = rt.read_lens(path)
    for found, place_ in zip(lens.configurations, [(20.0, 1.0), (100.0, 0.5)], strict=True):
        assert (found.environment.temperature.item(), found.environment.pressure.item()) == place_
        alone = lens.at(temperature=place_[0], pressure=place_[1])
        assert torch.equal(torch.stack(media(found, lens.wavelengths)), torch.stack(media(alone, lens.wavelengths)))
    rt.write_lens(lens, tmp_path / "copy.zmx")
    again = rt.read_lens(tmp_path / "copy.zmx")
    for one, other in zip(lens.configurations, again.configurations, strict=True):
        same_environments(one, other)


def test_temperatures_at_which_no_glass_is_one_are_refused_and_extrapolated_ones_reported():
    """The polynomials of third order in T make a focal length of 10⁻²³ mm at 10⁶ °C."""
    lens = rt.read_lens("cooke_triplet")
    with pytest.raises(ValueError, match=r"temperature=1e\+06.*up to 1000; .* -100 to 140"):
        lens.at(temperature=1e6)
    with pytest.warns(NoThermalCoefficients, match=r"200 °C; .* -100 to 140"):
        lens.at(temperature=200)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        lens.at(temperature=140)
