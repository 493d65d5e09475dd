"""A number has one unit: the text of a result prints the numbers of its table, its CSV and its JSON."""

import dataclasses
import functools
import html
import math
import re

import pytest
import torch

import raytrace as rt
from raytrace.analysis import compare_models as compare
from raytrace.maths.result import Result

_NUMBER = re.compile(r"(?<![\w.])-?\d+(?:\.\d+)?(?:e[+-]?\d+)?(?![\w.])")
_POWERS = (-6, -3, -2, 2, 3, 6)  # of ten, between units: mm and µm or m, parts and per cent, 1/K and 10⁻⁶/K
_DIGITS = 4  # a printed number with fewer may agree with another one by chance
_UNITS_UNPRINTED = ("evaluate", "info", "trace")  # units of rows by operand; mm and degrees of a prescription, of CSV
#: Rays that `spot` saves as CSV, samples of curves whose text lists the widths, counts of keywords, and numbers each in
#: the unit of its row or its criterion.
_WITHOUT_LENGTHS = {
    "Arrivals",
    "CrossSection",
    "Drawings",
    "GlassList",
    "ImportReport",
    "Jacobian",
    "LensComparison",
    "MeritsOfBatch",
    "Report",
    "StockList",
    "ToleranceTable",
    "ToleranceAnalysis",
}


#: Results of seconds, and their types.
DEAR = {"abilities": "Abilities", "compare_models": "Comparison"}


def results() -> dict[str, tuple]:
    """Every public result with a table: how to compute a small one, and columns that its text prints."""
    colours, fields = {"wavelengths": [0.5, 0.6]}, {"fields": [0, 10]}
    double, single = rt.read_lens("double_gauss"), rt.read_lens("singlet")
    over_field = {"samples": 3, **colours}
    row, column = torch.meshgrid(torch.arange(64.0), torch.arange(48.0), indexing="ij")
    edge = torch.sigmoid(column - 24 - 0.09 * (row - 32))
    return {
        "distortion": (lambda: rt.distortion(double, **over_field), "height f_tan_percent f_theta_percent"),
        "field_curvature": (lambda: rt.field_curvature(double, **over_field), "tangential sagittal"),
        "lateral_colour": (lambda: rt.lateral_colour(double, **over_field), "shift"),
        "chromatic": (lambda: rt.chromatic_focal_shift(double, samples=5, **colours), "wavelength shift"),
        "encircled_energy": (lambda: rt.encircled_energy(double, geometric=True, **fields), "radius share"),
        "ray_fan": (lambda: rt.ray_fan(double, points=5, **fields), "tangential sagittal"),
        "opd_fan": (lambda: rt.opd_fan(double, points=5, **fields), "tangential sagittal"),
        "distortion_grid": (lambda: rt.distortion_grid(double, points=3), "distortion_percent"),
        "illumination": (lambda: rt.relative_illumination(double, samples=3), "illumination projected_solid_angle"),
        "incidence": (lambda: rt.incidence(double, samples=3, surfaces=True), "lower chief upper"),
        "vignetting": (
            lambda: rt.vignetting("double_gauss_28deg", rims=True, samples=2, wavelengths=[0.55]),
            "passed_percent surface_7_percent",
        ),
        "footprint": (
            lambda: rt.footprint(double, 3, **fields),
            "x_low x_high y_low y_high centroid_y reach passed_percent",
        ),
        "intercepts": (
            lambda: rt.intercepts(double, each=True, rays="chief right", **fields),
            "x y z l m n incidence refraction",
        ),
        "depth of field": (
            lambda: rt.depth_of_field(double.at(object_distance=3000), blur=3.5),
            "near far depth blur_um",
        ),
        "longitudinal": (lambda: rt.longitudinal_aberration(double, points=5), "crossing"),
        "mtf": (lambda: rt.mtf(double, frequencies=[10, 20], geometric=True), "tangential sagittal"),
        "through_focus": (
            lambda: rt.mtf(double, frequencies=[10], through_focus=0.1, geometric=True),
            "sensor_distance tangential sagittal",
        ),
        "slanted edge": (lambda: rt.imaging.slanted_edge_mtf(edge, 0.004), "frequency mtf"),
        "rms of wavefronts": (lambda: rt.rms_over_field(double, samples=3), "rms"),
        "rms of spots": (lambda: rt.rms_over_field(double, samples=3, spot=True), "rms_um"),
        "sag": (lambda: rt.sag("phone", 3, step=0.2), "radius sag slope vertex_departure_um best_fit_departure_um"),
        "seidel": (lambda: rt.seidel(double), "S1 S2 S3 S4 S5 marginal_yni chief_yni"),
        "seidel in waves": (lambda: rt.seidel(double, kind="waves"), "W040 W131"),
        "wavefront": (lambda: rt.wavefront(double, size=16, terms=9, **fields), "coefficient"),
        "spot": (lambda: rt.spot(double, rings=4, **colours), "centroid_y rms_radius_um geometric_radius_um"),
        "spot of many rays": (lambda: rt.spot(double, rays=1000), "centroid_y rms_radius_um geometric_radius_um"),
        "focus": (lambda: rt.focus(double, object_distances=[3000]), "sensor_distance rms_radius_um"),
        "compare_models": (
            lambda: rt.compare_models(single, object_distances=[10e3, 20e3]),
            "object_distance sigma_um difference",
        ),
        "abilities": (lambda: compare.abilities(single), "conic anisotropy"),
        "psf": (
            lambda: rt.psf(single, "fourier", tol=1e-2),
            "centroid_y sigma_x_um sigma_y_um ray_sigma_x_um ray_sigma_y_um energy",
        ),
        "psfs": (
            lambda: rt.psf(double, "gaussian", tol=1e-2, per_wavelength=True, **colours),
            "wavelength centroid_y sigma_x_um sigma_y_um energy",
        ),
        "wave_psf": (
            lambda: rt.wave_optics.wave_psf("fresnel", depths=[1000, math.inf], wavelengths=[0.55], size=16),
            "depth wavelength energy peak half_energy_radius_um",
        ),
        "evaluate": (lambda: rt.evaluate(double, merit="spot", each=True), "value weight contribution_percent"),
        "optimize": (lambda: rt.optimize(double, merit="spot", vary=["curvature"], cycles=1), "before after"),
        "search": (
            lambda: rt.search(single, merit="spot", vary=["sensor"], starts=1, seconds=5),
            "merit efl rms_1_um rms_2_um rms_3_um",
        ),
        "first_order": (lambda: rt.first_order(double), "power effective_focal_length optical_invariant"),
        "info": (lambda: rt.info(double), "radius thickness semi_diameter index"),
        "trace": (lambda: rt.trace(double), "x y z opl"),
        "thermal": (
            lambda: rt.thermal(single, samples=2),
            "temperature effective_focal_length focus_shift_um rms_fixed_um modulation_fixed",
        ),
        "glass": (lambda: rt.glass("N-BK7", temperature=40), "wavelength index dn_dt dn_dt_absolute"),
    }


def printed(text: str) -> list[tuple[float, float]]:
    """Numbers of a text, and half a unit of their last digit."""
    text = text.replace("%", " ").replace("/K", " ")
    found = []
    for word in _NUMBER.findall(text):
        mantissa, _, power = word.partition("e")
        found.append((float(word), 0.51 * 10.0 ** (int(power or 0) - len(mantissa.partition(".")[2]))))
    return found


def is_listed(number: float, error: float, numbers: list[float]) -> bool:
    return any(abs(abs(number) - abs(other)) <= error + 1e-9 * abs(other) for other in numbers)


def entries(document, column: str) -> list[float]:
    """Numbers of this name in the rows of a document, at any depth."""
    if isinstance(document, list):
        return [number for part in document for number in entries(part, column)]
    if not isinstance(document, dict):
        return []
    numbers = [number for part in document.values() for number in entries(part, column)]
    return numbers + [number for number in [document.get(column)] if isinstance(number, float)]


@functools.cache
def computed(name: str):
    return results()[name][0]()


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", [pytest.param(n, marks=pytest.mark.slow if n in DEAR else ()) for n in results()])
def test_text_table_and_document_have_the_same_units(name):
    result, columns = computed(name), results()[name][1].split()
    frame, document, shown = result.to_frame(), result.document(), printed(str(result))
    assert frame.attrs["units"].items() <= result.units().items()
    every = [float(number) for column in frame.select_dtypes("number") for number in frame[column]]
    every = [number for number in every if math.isfinite(number)]
    for column in columns:
        numbers = [float(number) for number in frame[column] if abs(number) > 1e-12]
        assert any(number and is_listed(number, error, numbers) for number, error in shown), column
        unit = frame.attrs["units"].get(column, "")
        assert unit.removeprefix("1") in str(result) or name in _UNITS_UNPRINTED, f"{column}: {unit}"
        for number in entries(document.get("results", document.get("operands", [])), column):
            assert is_listed(number, 1e-12, [float(number) for number in frame[column]]), column
    for number, error in shown:
        if abs(number) > 10**_DIGITS * error and not is_listed(number, error, every):
            for power in _POWERS:
                scaled = [other * 10.0**power for other in every if other]
                assert not is_listed(number, error, scaled), f"text: {number:g}, table: this times 1e{-power}"


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", [n for n in results() if n not in DEAR and n != "trace"])  # whose text is CSV
def test_a_notebook_shows_the_words_and_numbers_of_the_text(name):
    page = computed(name)._repr_html_()
    shown = html.unescape(re.sub(r"<br>|<[^>]*>", " ", page)).split()
    written = str(computed(name)).split()
    assert sorted(shown) == sorted(written)
    assert page.count("<table>") == len([table for table in computed(name).tables() if table.columns])


def test_a_long_table_is_cut_in_a_notebook():
    rays = rt.trace("double_gauss", rt.tracing.rays("double_gauss"))
    assert rays._repr_html_().count("<tr>") == 1 + 100
    assert f"and {len(rays.to_frame()) - 100:,} rows" in rays._repr_html_()


def test_x_of_fields_is_printed_where_it_is_not_0_under_the_names_of_the_frame():
    lens = rt.read_lens("double_gauss")
    axis, beside = (rt.distortion(lens, fields=fields) for fields in ([0, 5], [(0, 0), (3, 5)]))
    assert str(axis).split()[0] == "field_y"
    assert str(beside).split()[:2] == ["field_x", "field_y"]
    assert {"field_x", "field_y"} <= {*beside.to_frame()}


@pytest.mark.filterwarnings("ignore")
def test_rounding_errors_are_printed_as_0_and_returned_as_they_are():
    """A ball with the stop at its centre has no coma; a stop 1e-7 mm from the centre of a mirror has its own."""
    half = dict(thickness=10.3, glass="N-BK7")
    ball = rt.lens([dict(radius=10.3, **half), half, dict(radius=-10.3, thickness=5)], stop=2,
        entrance_pupil_diameter=4, fields=[0, 13.3], wavelengths=[0.55, 0.48, 0.65])  # fmt: skip
    sums = rt.seidel(ball)
    coma, chief = float(sums.contributions[1].abs().max()), float(sums.chief_yni.abs().max())
    assert 0 < coma < 1e-17
    assert 0 < chief < 1e-15
    assert "e-" not in str(sums)
    assert max(abs(row["chief_yni"]) for row in sums.document()["results"]) == chief
    mirror = [dict(thickness=198.7 + 1e-7), dict(radius=-198.7, thickness=-99.35, glass="MIRROR")]
    sums = rt.seidel(rt.lens(mirror, stop=1, entrance_pupil_diameter=40, fields=[0, 3.3]))
    assert f"{float(sums.contributions[1].sum()):.6g}" in str(sums)
    triplet = rt.read_lens("cooke_triplet")
    noise = dataclasses.replace(
        rt.distortion(triplet), f_tan=1e-17 * torch.ones(11, 3), height=torch.full((11, 3), -3e-17)
    )
    printed = [line.split()[2:4] for line in str(noise).splitlines()[2:]]
    assert printed == [["0", "0"]] * 33
    single = dataclasses.replace(noise, f_tan=torch.full((11, 3), 1e-7), ideal=noise.ideal.float())
    assert {line.split()[3] for line in str(single).splitlines()[2:]} == {"0"}  # 1e-5 %, in single precision


def test_differences_below_the_rounding_of_their_terms_are_printed_as_0():
    lens = rt.read_lens("double_gauss")
    frequencies = torch.linspace(0, 100, 7).double()
    both = rt.compare(lens, lens, "mtf", frequencies=frequencies)
    other = dataclasses.replace(both.second, **{
        name: getattr(both.second, name) + 4e-16 for name in ("tangential", "sagittal")})  # fmt: skip
    noise = dataclasses.replace(both, second=other)
    assert "e-1" not in str(noise)
    assert 0 < noise.to_frame()["tangential_change"].abs().max() < 1e-15
    larger = dataclasses.replace(
        both, second=dataclasses.replace(both.second, tangential=both.second.tangential + 1e-12)
    )
    assert "e-12" in str(larger)
    layouts = rt.compare(lens, rt.edit.scale(lens, 1 + 1e-15))
    assert 0 < layouts.to_frame()["value_change"].abs().max() < 1e-11
    assert "e-" not in str(layouts)


def test_values_and_batches_print_large_tensors_by_shape_and_range():
    lens = rt.read_lens("double_gauss")
    batch = rt.system.batch([lens.replace(1, radius=60.0 + k) for k in range(50)])
    values = [lens, batch, *lens.surfaces, *batch.surfaces, lens.fields, lens.aperture]
    values += [
        rt.tracing.rays(lens),
        rt.spot(lens).whole,
        rt.base_ray(lens),
        rt.trace(lens),
        rt.first_order(batch),
    ]
    chip = rt.Sensor(size=(1, 1), pixels=(16, 16))
    values += [rt.render("singlet", torch.rand(1, 16, 16), sensor=chip, model="gaussian", tol=0.3)]
    for value in values:
        assert "tensor(" not in repr(value), type(value)
        assert len(repr(value)) < 2500, type(value)
    assert repr(batch).startswith("<Lens: ")
    assert "50 lenses of 13 surfaces" in repr(batch)
    number, radii = batch.surfaces[2].thickness, batch.surfaces[1].curvature
    assert f"thickness={float(number):.6g}, " in repr(batch.surfaces[2])
    assert f"curvature=<(50,) float64, {float(radii.min()):.6g} … {float(radii.max()):.6g}>" in repr(batch.surfaces[1])
    assert "first-order data of 50 lenses" in repr(rt.first_order(batch))
    shown = []
    torch.func.vmap(lambda k: shown.append(repr(dataclasses.replace(lens.surfaces[1], curvature=k))) or k)(radii)
    assert shown[0].startswith("Surface(")


@pytest.mark.filterwarnings("ignore")
def test_every_table_is_compared():
    def below(kind: type) -> set[type]:
        return {kind}.union(*map(below, kind.__subclasses__()))

    assert callable(rt.tolerance)  # its results are loaded with it
    assert callable(rt.jacobian)
    assert callable(rt.draw)
    assert callable(rt.glasses)
    assert rt.psf("singlet", "gaussian", fields=[0]).cross_section().columns()
    assert callable(rt.compare)
    assert callable(rt.report)
    assert callable(rt.stock_find)
    known = {type(computed(name)).__name__ for name in results() if name not in DEAR} | {*DEAR.values()}
    tables = {kind.__name__ for kind in below(Result) - {Result} if "columns" in vars(kind)}
    assert tables == known | _WITHOUT_LENGTHS


def test_a_result_is_saved_as_its_suffix_says(tmp_path):
    import json

    import raytrace as rt

    result = rt.mtf("double_gauss", [10.0], fields=[0], geometric=True)
    result.save(tmp_path / "mtf.json")
    assert (
        json.loads((tmp_path / "mtf.json").read_text())["results"]
        == json.loads(json.dumps(result.document()))["results"]
    )
    result.save(tmp_path / "mtf.csv")
    assert (tmp_path / "mtf.csv").read_text().count("\n") == 1 + len(result.to_frame())
    with pytest.raises(ValueError, match=r"mtf\.npz: .*\.csv or \.json"):
        result.save(tmp_path / "mtf.npz")
    assert not (tmp_path / "mtf.npz").exists()
