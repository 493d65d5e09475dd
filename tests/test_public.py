"""The public API: a lens from plain numbers, under other conditions, and the public names."""

import argparse
import functools
import importlib
import importlib.metadata
import inspect
import json
import pkgutil
import re
import subprocess
import sys

import pandas as pd
import pytest
import torch

import raytrace as rt
from raytrace.cli import main
from raytrace.cli.commands import COMMANDS
from raytrace.cli.options import add
from raytrace.maths.result import Result
from raytrace.system.lens import field_points
from raytrace.tracing.launch import launch
from raytrace.tracing.spot import spot_of
from raytrace.tracing.trace import trace_lens
from raytrace.words import in_command, option

ROWS = [
    {"radius": 61.47, "thickness": 6.0, "glass": "N-BK7"},
    {"radius": -44.64, "thickness": 2.5, "glass": "N-SF5"},
    {"radius": -129.94, "thickness": 95.9},
]


def test_every_public_name_matches_the_table_after_importing_all_modules():
    """No module may replace a function of the same name: `import raytrace.x` puts x into the package."""
    for found in pkgutil.walk_packages(rt.__path__, "raytrace."):
        if found.name != "raytrace.__main__":  # which runs the command
            importlib.import_module(found.name)
    for name, place in rt.PUBLIC.items():
        module, _, own = place.partition(":")
        found = rt.public_name(name)
        defined = getattr(importlib.import_module(f"raytrace.{module}"), own or name)
        assert (found.__wrapped__ if inspect.isfunction(found) else found) is defined, name
        assert not isinstance(found, type(sys)), name


@pytest.mark.slow
def test_eight_threads_call_functions_first_in_a_fresh_process():
    code = """if True:
        import threading
        import raytrace as rt
        values, gate = [], threading.Barrier(8)
        def call(function):
            gate.wait()
            values.append(getattr(rt, function)("cooke_triplet"))
        threads = [threading.Thread(target=call, args=(name,)) for name in 2 * ["spot", "psf", "wavefront", "mtf"]]
        for thread in threads: thread.start()
        for thread in threads: thread.join()
        print(len(values))
    """
    done = subprocess.run([sys.executable, "-W", "ignore", "-c", code], capture_output=True, text=True, timeout=300)
    assert done.stdout == "8\n", done.stderr


def test_all_warnings_are_of_one_category():
    for found in pkgutil.walk_packages(rt.__path__, "raytrace."):
        if found.name != "raytrace.__main__":
            importlib.import_module(found.name)

    kinds = [Warning]
    for kind in kinds:  # which grows
        kinds += kind.__subclasses__()
    categories = {kind for kind in kinds if kind.__module__.startswith("raytrace.")}
    assert len(categories) > 15
    assert all(issubclass(kind, rt.RaytraceWarning) for kind in categories)


PROGRAMS = {
    "any": "import warnings\nfrom raytrace.words import RaytraceWarning\n"
    + 3 * "warnings.warn('rays miss the stop', RaytraceWarning)\n",
    "a lens": "import raytrace as rt\nlens = rt.read_lens('double_gauss')\n"
    + 3 * "rt.spot(lens)\n"
    + "rt.ray_fan(lens)",
}


@pytest.mark.parametrize("name", ["any", pytest.param("a lens", marks=pytest.mark.slow)])
def test_a_warning_is_given_once_for_all_lines_that_call(name):
    done = subprocess.run([sys.executable, "-c", PROGRAMS[name]], capture_output=True, text=True, timeout=300)
    assert done.stderr.count(": rays miss the stop") == 1, done.stderr


def test_a_shipped_lens_is_known_by_its_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("cooke_triplet", "lenses/cooke_triplet.zmx", "cooke_triplet.zmx"):
        assert float(rt.first_order(rt.read_lens(name)).effective_focal_length) == pytest.approx(101.181, abs=1e-3)


@pytest.mark.parametrize("rows", [ROWS, pd.DataFrame(ROWS)], ids=["rows", "frame"])
def test_a_lens_is_made_from_plain_numbers(rows):
    lens = rt.lens(
        rows, stop=1, f_number=5, fields=[0, (1, 2)], wavelengths=[0.4861, 0.5876, 0.6563], primary_wavelength=2
    )
    assert len(lens.surfaces) == 5
    assert lens.primary_wavelength == 2
    assert lens.fields.kind == "angle"
    assert lens.fields.x.tolist() == [0, 1]
    assert lens.fields.y.tolist() == [0, 2]
    assert float(lens.surfaces[2].curvature) == pytest.approx(-1 / 44.64, rel=1e-15)
    assert lens.surfaces[2].glass.name == "N-SF5"
    assert lens.surfaces[3].glass is rt.materials.AIR
    assert float(rt.first_order(lens).f_number) == pytest.approx(5, rel=1e-12)


def test_media_are_names_indices_or_figures():
    rows = [
        {"radius": 50, "thickness": 5, "glass": 1.5},
        {"radius": float("inf"), "thickness": 5, "glass": (1.62, 36.3)},
        {"curvature": 0.0, "thickness": -5, "glass": "mirror"},
    ]
    lens = rt.lens(rows, stop=1, entrance_pupil_diameter=10)
    wavelength = torch.tensor(0.5875618, dtype=torch.float64)
    first, second = (float(rt.materials.refractive_index(lens.surfaces[k].glass, wavelength)) for k in (1, 2))
    assert first == 1.5
    assert second == pytest.approx(1.62, abs=1e-5)
    assert lens.surfaces[3].is_mirror
    assert lens.surfaces[2].curvature is None
    assert lens.surfaces[3].curvature is None


def test_a_number_is_replaced_by_a_variable():
    curvature = torch.tensor(1 / 61.47, dtype=torch.float64, requires_grad=True)
    lens = rt.lens(ROWS, stop=1, f_number=5)

    def power(c):
        return rt.first_order(lens.replace(1, curvature=c)).power

    power(curvature).backward()
    step = 1e-6
    with torch.no_grad():
        expected = (power(curvature + step) - power(curvature - step)) / (2 * step)
    assert float(curvature.grad) == pytest.approx(float(expected), rel=1e-8)
    assert float(lens.replace(1, radius=50.0).surfaces[1].curvature) == 1 / 50
    assert lens.surfaces[1].curvature is not curvature


def test_conditions_are_those_asked_for_and_the_rest_stays():
    lens = rt.read_lens("double_gauss")
    other = lens.at(object_distance=25e3, sensor_distance=57.0, f_number=4, wavelengths=[0.5], fields=[0, 7])
    assert float(other.surfaces[0].thickness) == 25e3
    assert float(other.surfaces[-2].thickness) == 57.0
    assert float(rt.first_order(other).f_number) == pytest.approx(4, rel=1e-12)
    assert other.wavelengths.tolist() == [0.5]
    assert other.fields.y.tolist() == [0, 7]
    assert other.surfaces[3] is lens.surfaces[3]
    assert float(lens.at(entrance_pupil_diameter=20).aperture.value) == 20


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda lens: lens.replace(1, curvatur=0.1), "did you mean curvature?"),
        (lambda lens: lens.replace(9, curvature=0.1), "surfaces 0 to 4"),
        (lambda lens: lens.replace(1, radius=0), "a plane has radius inf"),
        (lambda lens: lens.replace(1, radius=5, curvature=0.2), "leave one out"),
        (lambda lens: lens.replace(1, thickness="thick"), "'thick' is not a number"),
        (lambda lens: lens.at(f_number=4, entrance_pupil_diameter=3), "exclude each other"),
        (lambda lens: lens.at(wavelengths=[550.0]), "did you mean 0.55?"),
        (lambda lens: lens.at(fields=[(1, 2, 3)]), "pairs (x, y)"),
        (lambda lens: rt.lens(ROWS, stop=1), "none given; expected one of f_number"),
        (lambda lens: rt.lens(ROWS, stop=7, f_number=4), "the stop is surface 7"),
        (lambda lens: rt.lens([], stop=1, f_number=4), "no rows"),
        (lambda lens: rt.lens([{"radius": 5}], stop=1, f_number=4), "surface 1: no thickness"),
        (
            lambda lens: rt.lens([{"radius": 5, "thickness": 1, "glas": "SF5"}], stop=1, f_number=4),
            "did you mean glass?",
        ),
        (lambda lens: rt.lens(ROWS, stop=1, f_number=4, field_kind="angles"), "expected one of angle"),
    ],
)
def test_invalid_lenses_are_reported(call, said):
    lens = rt.lens(ROWS, stop=1, f_number=5)
    with pytest.raises(ValueError, match=re.escape(said)):
        call(lens)


# -- rays --------------------------------------------------------------------------------------------------------------


def test_rays_are_launched_traced_and_tabled():
    lens = rt.read_lens("cooke_triplet")
    rays = rt.tracing.rays(lens, fields=[0, 14], pupil=rt.maths.gauss_rings(6))
    assert rays.shape == (2, 3, 144)
    end = rt.trace(lens, rays)
    same = launch(lens, rt.maths.gauss_rings(6)[0], fields=field_points([0, 14], like=lens))
    kept = trace_lens(lens, same, rays.wavelength)
    assert torch.equal(end.position, kept.position)
    assert torch.equal(end.opl, kept.opl)
    assert float(spot_of(end).rms_radius[0, 0]) > 0  # what a trace gives is rays
    table = end.to_frame()
    assert [*table] == ["ray", "surface", "x", "y", "z", "l", "m", "n", "opl", "status"]
    last = table[table.surface == len(lens.surfaces) - 1]
    assert last.y.to_numpy() == pytest.approx(end.position[1].flatten()[rays.valid.flatten()].numpy(), abs=1e-12)
    assert {*table.status} <= {"ok", "vignetted"}


@pytest.mark.parametrize("words", ["", "--field 0 3,14 --object-distance 25000 inf --wavelength 0.5"])
def test_the_command_trace_writes_the_table_of_the_verb(words, capsys, tmp_path):
    given = {"fields": [0, (3, 14)], "object_distances": [25e3, float("inf")], "wavelengths": [0.5]}
    words, keywords = words.split(), given if words else {}
    lens = rt.read_lens("double_gauss").at(wavelengths=keywords.get("wavelengths"))  # they are conditions, too
    found = rt.trace(lens, **keywords)
    assert main(["trace", "double_gauss", *words]) == 0
    assert capsys.readouterr().out == f"{found}\n"
    assert main(["trace", "double_gauss", *words, "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == found.document()
    found.save(tmp_path / "rays.csv")
    assert (tmp_path / "rays.csv").read_text() == f"{found}\n"


def test_a_table_of_rays_is_traced_by_its_name(tmp_path):
    (tmp_path / "rays.csv").write_text("x,y,z,l,m,n,wavelength\n0,5,-5,0,0,1,0.55\n0,500,-5,0,0,1,0.6\n")
    lens = rt.read_lens("double_gauss")
    found = rt.trace(lens, tmp_path / "rays.csv")
    assert found.valid.tolist() == [True, False]
    assert found.lost() == [{"surface": 1, "status": "miss", "rays": 1}]
    same = rt.trace(lens, rt.io.read_rays(tmp_path / "rays.csv", lens))
    assert str(same) == str(found)


def test_a_spot_is_differentiable_and_a_table_and_draws_itself(tmp_path):
    lens = rt.read_lens("cooke_triplet")
    curvature = lens.surfaces[3].curvature.clone().requires_grad_()
    found = rt.spot(lens.replace(3, curvature=curvature), fields=[0, 14])
    assert found.rms_radius.shape == (2, 3)
    found.rms_radius.sum().backward()
    step = 1e-7

    def merit(c):
        return float(rt.spot(lens.replace(3, curvature=c), fields=[0, 14]).rms_radius.sum())

    slope = (merit(curvature.detach() + step) - merit(curvature.detach() - step)) / (2 * step)
    assert float(curvature.grad) == pytest.approx(slope, rel=1e-5)
    assert found.to_frame().rms_radius_um.tolist() == (1e3 * found.rms_radius).flatten().tolist()
    assert len(found.plot(tmp_path / "spot.png").axes) == 2
    assert (tmp_path / "spot.png").stat().st_size > 0
    found.save(tmp_path / "rays.csv")
    assert len(pd.read_csv(tmp_path / "rays.csv")) == found.arrivals.status.numel()
    many = rt.spot(lens, fields=[0, 14], rays=20_000)
    assert torch.allclose(many.rms_radius, found.rms_radius.double(), rtol=0.01)
    with pytest.raises(ValueError, match="keeps none"):
        many.plot()
    with pytest.warns(rt.LostRays, match=r"field 80 degrees, .* 648 rays .*missed surface"):
        rt.spot(lens, fields=[80])


@pytest.mark.slow
def test_a_lens_is_focused_by_every_criterion(tmp_path):
    lens = rt.read_lens("double_gauss").at(object_distance=25e3)
    found = rt.focus(lens)
    assert float(found.lens.surfaces[-2].thickness) == pytest.approx(57.66201, abs=1e-5)
    assert float(found.rms_radius()) < float(found.rms_radius(57.0))
    paraxial = rt.focus(lens, criterion="paraxial").sensor_distance
    assert float(paraxial) == pytest.approx(float(rt.first_order(lens).paraxial_image_distance), rel=1e-12)
    mean = rt.focus(lens, criterion="mean").sensor_distance
    assert 0 < abs(float(mean - found.sensor_distance)) < 0.2
    several = rt.focus(lens, object_distances=[10e3, float("inf")], distance_weights=[1, 3], fields=[0, 10])
    assert several.document()["object_distance"] == [10e3, None]
    assert several.to_frame().place.tolist()[:2] == ["before", "after"]
    found.save(tmp_path / "focused.zmx")
    assert float(rt.read_lens(tmp_path / "focused.zmx").surfaces[-2].thickness) == float(found.sensor_distance)
    assert found.plot().axes
    for wrong, said in (({"criterion": "best"}, "rms, paraxial, mean"), ({"field_weights": [1, 2]}, "expected 1, one")):
        with pytest.raises(ValueError, match=said):
            rt.focus(lens, **wrong)
    with pytest.raises(rt.NoFocus, match="no ray reaches the image"), pytest.warns(rt.LostRays):
        rt.focus(lens, fields=[80])


def test_every_function_has_a_derivative_with_respect_to_a_curvature():
    """lens.replace with a tensor that requires a gradient: every function carries it, or prints the lens unchanged."""
    lens = rt.read_lens("cooke_triplet")
    curvature = lens.surfaces[3].curvature.clone().requires_grad_()
    bent = lens.replace(3, curvature=curvature)
    for found in (
        rt.first_order(bent).power,
        rt.trace(bent).position,
        rt.trace(bent, rt.tracing.rays(bent, fields=[0, 14])).position,
        rt.focus(bent).sensor_distance,
        rt.spot(rt.focus(bent).lens).mean_square_radius,
        rt.psf(bent, "gaussian", fields=[0], tol=1e-2).covariance,
        rt.psf(bent, rt.psf_models.DRT(rays=256), fields=[0]).kernel.square(),
        rt.mtf(bent, fields=[10]).tangential,
        rt.ray_fan(bent, fields=[10]).tangential,
        rt.wavefront(bent, fields=[10]).rms,
        rt.distortion(bent, fields=[10]).f_tan,
    ):
        (slope,) = torch.autograd.grad(found.sum(), curvature)
        assert torch.isfinite(slope)
        assert slope != 0
    for shown in (rt.info(bent), rt.layout(bent), rt.trace(bent), rt.spot(bent), rt.focus(bent)):
        assert str(shown)
        json.dumps(shown.document())
    assert rt.layout(bent).plot().axes


def test_a_lens_shows_itself():
    lens = rt.read_lens("cooke_triplet")
    shown = str(lens)
    assert shown == str(rt.info(lens))
    assert "effective focal length" in shown
    assert len(shown.splitlines()) > len(lens.surfaces) + len(rt.tracing.FirstOrder.__dataclass_fields__) - 4
    page = lens._repr_html_()
    assert "<svg" in page
    assert page.count("<tr") == len(lens.surfaces) + 1
    table = rt.info(lens).to_frame()
    assert table.radius[1] == pytest.approx(float(1 / lens.surfaces[1].curvature))
    assert table.glass[1] == lens.surfaces[1].glass.name
    batch = rt.system.with_object_distance(lens, torch.tensor([[1e3], [2e3]], dtype=torch.float64))
    assert str(batch).startswith("Lens(")  # a batch of lenses shows its numbers
    assert "<pre>" in batch._repr_html_()


# -- functions and their commands --------------------------------------------------------------------------------------

#: Commands of one public function; not those of bench, codesign and wave.
VERBS = [command for command in COMMANDS if command.verb in rt.PUBLIC]
#: Those that need no merit function.
OF_A_LENS = [c for c in VERBS if c.run is None and c.name not in ("evaluate", "optimize", "search")]


def options_of(command) -> set[str]:
    parser = argparse.ArgumentParser(add_help=False)
    add(parser, command.options)
    return {action.dest for action in parser._actions}


def assert_alike(one, other) -> None:
    """The same document, to the rounding of sums that a machine forms in an order of its own."""
    if isinstance(one, dict):
        assert [*one] == [*other]
        for name in one:
            assert_alike(one[name], other[name])
    elif isinstance(one, list):
        assert len(one) == len(other)
        for entries in zip(one, other, strict=True):
            assert_alike(*entries)
    else:
        assert one == (pytest.approx(other, rel=1e-9, abs=1e-9) if isinstance(other, float) else other)


#: Options that a command needs for a lens that has no tolerances or variables of its own, and arguments.
NEEDED = {
    "jacobian": {"vary": "curvature:1"},
    "sag": {"surface": 3},
    "footprint": {"surface": 3},
    "depth-of-field": {"blur": 0.1},
    "tolerance": {"limits": "radius=0.1%", "trials": 20},
}


@pytest.mark.parametrize(
    "command",
    [
        pytest.param(c, id=c.name, marks=pytest.mark.slow if c.name in ("compare-models", "psf", "report") else ())
        for c in OF_A_LENS
    ],
)
def test_a_command_prints_the_result_of_its_function(command, capsys, monkeypatch):
    """As JSON by the function itself; as text the result already computed."""
    needed = NEEDED.get(command.name, {})
    words = [str(given) for name, given in needed.items() if name == "surface"]
    words += [word for name, given in needed.items() if name != "surface" for word in (f"--{name}", str(given))]
    assert main([command.name, "cooke_triplet", "--json", *words]) == 0
    printed = capsys.readouterr().out
    verb = rt.public_name(command.verb)
    with in_command({"grade": "--grade"}):  # in the words of a section that has nothing to show
        found = verb(rt.read_lens("cooke_triplet"), **needed)
    assert_alike(json.loads(printed), found.document())
    monkeypatch.setattr(rt, command.verb, functools.wraps(verb)(lambda *_, **options: found))
    assert main([command.name, "cooke_triplet", *words]) == 0
    assert capsys.readouterr().out == f"{found}\n"


# -- learning ----------------------------------------------------------------------------------------------------------


class Same(torch.nn.Module):
    """A network that restores nothing."""

    def forward(self, image):
        return image


def test_a_camera_is_variables_and_a_network():
    lens = rt.read_lens("double_gauss")
    module = rt.Variables(lens, "curvature:1-4 sensor")
    camera = rt.Camera(module, Same())
    optimizer = torch.optim.Adam(camera.parameters(), 1e-3)
    pictures = torch.rand(2, 40, 40, generator=torch.Generator().manual_seed(1))
    restored = camera(pictures, torch.tensor([10e3, 50e3]))
    loss = (restored - camera.target(pictures)).abs().mean() + module.violation()
    loss.backward()
    slopes = [float(getattr(module, name).grad) for name in module.numbers()]
    assert len(slopes) == 5
    assert all(abs(slope) > 1e-6 for slope in slopes)
    before = module.numbers()
    optimizer.step()
    assert all(module.numbers()[name] != before[name] for name in before)


def test_a_camera_sees_fields_as_plain_numbers():
    lens = rt.read_lens("double_gauss")
    camera = rt.Camera(rt.Variables(lens, "sensor"), Same(), fields=[0, 14], object_distances=(20e3, 30e3))
    assert camera.fields.tolist() == [[0, 0], [0, 14]]
    kernel = camera.kernels(torch.tensor([25e3], dtype=torch.float64), field=1)
    assert float(kernel.sum().detach()) == pytest.approx(1, abs=1e-9)


def test_a_picture_is_blurred_and_restored():
    picture = torch.rand(32, 32, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    kernel = rt.psf(rt.read_lens("double_gauss"), "gaussian", fields=torch.zeros(2, 1), normalise="window").kernel[0, 0]
    blurred = rt.imaging.blur(picture, kernel, boundary="circular")
    transfer = rt.imaging.transfer_functions(kernel, 32)
    restored = rt.imaging.restore(blurred, rt.imaging.wiener(transfer, 1e-6))
    errors = [rt.imaging.psnr(((estimate - picture) ** 2).mean()) for estimate in (restored, blurred)]
    assert float(errors[0] - errors[1]) > 5  # dB, of white noise, most of which the lens does not show


def test_a_valid_blur_is_restored_in_place():
    """In the picture that a blur without a margin returns, on a larger period against the jump at its borders."""
    rows = torch.arange(96, dtype=torch.float64)
    picture = (torch.exp(-((rows - 45) ** 2) / 40)[:, None] * torch.exp(-((rows - 50) ** 2) / 40)).clone()
    kernel = torch.ones(9, 9, dtype=torch.float64) / 81
    transfer = rt.imaging.transfer_functions(kernel, (88 + 16, 88 + 16))
    restored = rt.imaging.restore(rt.imaging.blur(picture, kernel), rt.imaging.wiener(transfer, 1e-8), boundary="taper")
    assert float((restored - picture[4:-4, 4:-4]).abs().max()) < 1e-3


def test_a_camera_is_converted_with_its_lens():
    lens = rt.read_lens("double_gauss")
    camera = rt.Camera(rt.Variables(lens, "curvature:1 sensor", hold="efl"), torch.nn.Conv2d(1, 1, 1))
    distances = torch.tensor([25e3], dtype=torch.float64)
    exact = camera.kernels(distances)
    state = camera.state_dict()
    with pytest.raises(ValueError, match=r"expected torch\.float32 or torch\.float64"):
        camera.half()
    assert {p.dtype for p in camera.variables.parameters()} == {torch.float64}
    single = camera.float()
    assert single.variables().surfaces[1].curvature.dtype == torch.float32
    kernel = single.kernels(distances)
    assert kernel.dtype == torch.float32
    assert float((kernel - exact).abs().sum().detach()) < 1e-3  # of 1
    single.load_state_dict(state)  # a lens has one identity in both precisions
    moved = single.to("meta")
    assert {moved.fields.device.type, moved.variables().surfaces[4].glass.coefficients.device.type} == {"meta"}
    plate = rt.imaging.PhaseVariables(rt.wave_optics.phase_elements("cubic")[0]).float()
    assert {plate.numbers().dtype, plate()[0].numbers.dtype, plate.start.dtype} == {torch.float32}


def test_variables_print_their_numbers_and_a_lens_refers_to_them():
    lens = rt.read_lens("double_gauss")
    assert repr(rt.Variables(lens, "sensor")) == "Variables(sensor=58.5)"
    with pytest.raises(AttributeError, match=r"rt\.Variables\(lens"):
        lens.parameters()
    with pytest.raises(AttributeError, match=r"rt\.to\(lens, dtype=…, device=…\)"):
        lens.to("cuda")
    assert not hasattr(lens, "curvatures")


def test_the_version_is_that_of_the_package():
    assert rt.__version__ == importlib.metadata.version("raytrace")


# -- waves -------------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_an_element_at_the_stop_of_a_lens_and_an_element_as_a_lens():
    """Without height the kernels are those of the lens; a smooth lens for 1 m brings 1 m to its sensor, as rays see."""
    lens = rt.read_lens("double_gauss")
    (singlet,) = rt.wave_optics.phase_elements("singlet", aperture=60.0)
    flat = singlet.with_numbers(0 * singlet.numbers)
    # Off the axis lateral colour is part of the kernels: one window for both wavelengths.
    how = {"fields": [0, 10], "object_distances": [25e3], "size": 9, "wavelengths": [0.46, 0.64]}
    expected = rt.psf(lens, rt.psf_models.Wave(order=0), **how, center="chief", per_wavelength=True)
    found = rt.wave_optics.hybrid_psf(lens, flat, **how)
    # A few more rays than without: 2e-7 on the axis, 2e-10 off it.
    assert float((found.kernel - expected.kernel).abs().max() / expected.kernel.max()) < 1e-6
    assert torch.allclose(found.grid.centre, expected.grid.centre, rtol=0, atol=1e-12)
    assert len(found.to_frame()) == 4
    assert "phase elements at the stop" in str(found)
    (small,) = rt.wave_optics.phase_elements("singlet", aperture=1.0)
    traced = rt.wave_optics.element_lens(small, sensor_distance=35.5, object_distance=1000.0, substrate=0.5)
    focus = rt.tracing.paraxial_image_distance(traced, traced.surfaces[0].thickness)
    assert float(focus) == pytest.approx(35.5, rel=2e-3)  # the plane face is half a millimetre in front of the thin one


# -- analyses ----------------------------------------------------------------------------------------------------------

#: Verb, its keywords in plain numbers, the same for the command, a column of the table and a word of the text.
ANALYSES = (
    ("ray_fan", {"fields": [0, (3, 9)], "points": 5}, "--field 0 3,9 --points 5", "sagittal", "pupil"),
    (
        "opd_fan",
        {"reference": "own", "points": 5, "wavelengths": [0.55, 0.5]},
        "--reference own --points 5 --wavelength 0.55 0.5",
        "tangential",
        "waves",
    ),
    (
        "wavefront",
        {"fields": [9], "size": 16, "terms": 9, "numbering": "fringe"},
        "--field 9 --size 16 --terms 9 --numbering fringe",
        "coefficient",
        "spherical",
    ),
    ("distortion", {"samples": 3}, "--samples 3", "f_theta_percent", "%"),
    ("field_curvature", {"fields": [5, 9]}, "--fields 5 9", "sagittal", "mm"),
    ("lateral_colour", {"wavelengths": [0.5, 0.6], "samples": 3}, "--wavelengths 0.5 0.6 --samples 3", "shift", "µm"),
    ("relative_illumination", {"fields": [3, 9]}, "--field 3 9", "illumination", "sr"),
    ("vignetting", {"fields": [3, 9]}, "--field 3 9", "passed_percent", "factors"),
    ("seidel", {"fields": [9], "kind": "waves"}, "--field 9 --kind waves", "W040", "optical invariant"),
    ("longitudinal_aberration", {"points": 5, "wavelengths": [0.55]}, "--points 5 --wavelength 0.55", "crossing", "mm"),
    (
        "chromatic_focal_shift",
        {"samples": 5, "wavelengths": [0.5, 0.6]},
        "--samples 5 --wavelength 0.5 0.6",
        "shift",
        "mm",
    ),
    ("distortion_grid", {"points": 3}, "--points 3", "distortion_percent", "largest"),
    ("incidence", {"samples": 3, "surfaces": True}, "--samples 3 --surfaces", "chief", "upper"),
    ("depth_of_field", {"blur": 0.1}, "--blur 0.1", "near", "hyperfocal"),
    ("intercepts", {"fields": [3, 9], "rays": ["chief", "upper"]}, "--field 3 9 --rays chief upper", "x", "height"),
    ("rms_over_field", {"samples": 3, "spot": True}, "--samples 3 --spot", "rms_um", "all, weighted"),
    ("mtf", {"frequencies": [10, 20], "fields": [9]}, "--frequency 10 20 --field 9", "tangential_limit", "1/mm"),
    (
        "mtf",
        {"frequencies": [20], "through_focus": 0.1, "geometric": True},
        "--frequency 20 --through-focus 0.1 --geometric",
        "sensor_distance",
        "mm",
    ),
    ("encircled_energy", {"radii": [0.01, 0.02], "geometric": True}, "--radius 0.01 0.02 --geometric", "share", "mm"),
    (
        "encircled_energy",
        {"radii": [0.01], "shape": "rectangle", "aspect": 2},
        "--half-width 0.01 --shape rectangle --aspect 2",
        "share",
        "half_width",
    ),
)


@pytest.mark.parametrize(("verb", "keywords", "words", "column", "said"), ANALYSES, ids=lambda value: str(value)[:24])
def test_an_analysis_takes_plain_numbers_and_tabulates_prints_and_draws_itself(
    verb, keywords, words, column, said, capsys, monkeypatch, tmp_path
):
    """As JSON by the function itself; as text and figure the result already computed."""
    lens = rt.read_lens("cooke_triplet")
    found = rt.public_name(verb)(lens, **keywords)
    frame = found.to_frame()
    assert frame[column].notna().any()
    assert len(frame) == len(found.document()["results"])
    assert said in str(found)
    assert found.plot().axes
    command = [verb.replace("_", "-"), "cooke_triplet", *words.split()]
    assert main([*command, "--json"]) == 0
    assert_alike(json.loads(capsys.readouterr().out), found.document())
    function = rt.public_name(verb)
    monkeypatch.setattr(rt, verb, functools.wraps(function)(lambda *_, **options: found))
    assert main([*command, "--plot", str(tmp_path / "command.png")]) == 0
    assert capsys.readouterr().out == f"{found}\n"
    assert (tmp_path / "command.png").stat().st_size > 10_000


def test_analyses_have_gradients_and_report_failed_fields():
    lens = rt.read_lens("cooke_triplet")
    curvature = lens.surfaces[3].curvature.clone().requires_grad_()
    found = rt.mtf(lens.replace(3, curvature=curvature), frequencies=[20], fields=[9])
    (slope,) = torch.autograd.grad(found.tangential.sum(), curvature)
    assert slope.isfinite()
    assert str(found)
    assert rt.ray_fan(lens.replace(3, curvature=curvature)).plot().axes
    with pytest.warns(rt.LostRays, match="no ray of field 80 degrees"):
        rt.ray_fan(lens, fields=[0, 80])
    with pytest.raises(rt.OutOfReach, match="no ray of field 80 degrees"):
        rt.wavefront(lens, fields=[0, 80])
    with pytest.raises(rt.NothingToShow, match="all fields are on the axis"):
        rt.distortion(lens, fields=[0])


def test_errors_speak_of_keywords_from_python_and_of_options_from_the_command(capsys):
    with pytest.raises(ValueError, match=r"`through_focus` .*give `frequencies`"):
        rt.mtf(rt.read_lens("cooke_triplet"), through_focus=0.1)
    assert main(["mtf", "cooke_triplet", "--through-focus", "0.1"]) == 1
    assert "--through-focus needs one spatial frequency: give --frequency" in capsys.readouterr().err
    assert main(["spot", "cooke_triplet", "--sampling", "sobol", "--rings", "4"]) == 1
    assert "--rings belongs to --sampling gauss, hexapolar; sobol takes --points" in capsys.readouterr().err


def test_a_switch_is_named_without_a_value():
    assert option("geometric", True) == "`geometric=True`"
    with in_command({"geometric": "--geometric"}):
        assert option("geometric", True) == "--geometric"


def test_completion_offers_the_names_that_are_typed():
    assert dir(rt) == sorted(rt.__all__)


def test_the_functions_of_tolerances_have_their_public_names():
    assert rt.tolerance.__name__ == "tolerance"
    assert rt.tolerances.__name__ == "tolerances"


def test_a_lens_says_how_it_is_written_and_drawn():
    pairs = {"save": r"rt\.write_lens\(lens, path\)", "plot": r"rt\.layout\(lens\)", "spot": r"rt\.spot\(lens\)"}
    for name, words in pairs.items():
        with pytest.raises(AttributeError, match=f"'Lens' object has no attribute '{name}'; {words}"):
            getattr(rt.read_lens("singlet"), name)


@pytest.mark.parametrize("name", ["efl", "focal_length", "effective_focal_length", "f_number"])
def test_first_order_data_that_a_lens_lacks_are_named_with_their_function(name):
    with pytest.raises(AttributeError, match=r"rt\.first_order\(lens\)\.(effective_focal_length|f_number)$"):
        getattr(rt.lens(ROWS, stop=1, f_number=5), name)


def test_a_result_without_columns_refuses_to_be_a_table():
    class Words(Result):
        """Of words alone."""

    with pytest.raises(TypeError, match=r"Words is no table; see its document\(\)"):
        Words().to_frame()
