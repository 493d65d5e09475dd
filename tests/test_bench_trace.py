"""`raytrace bench trace` runs end to end, and a tracer of 50 digits agrees with the package. No timings."""

import contextlib
import io
import json
import math

import pytest
import torch
from scripts import script
from systems_beyond import SYSTEMS, error_of, spectrometer

from raytrace.bench import trace
from raytrace.bench.measure import SAMPLE, Tracer, field_rays, squared_radius, variables, with_leaves
from raytrace.cli import main
from raytrace.files import shipped
from raytrace.io import read_lens
from raytrace.materials.glass import MIRROR, constant
from raytrace.system.rays import Rays
from raytrace.system.surface import Surface
from raytrace.tracing.trace import trace_lens, trace_surfaces

reference = script("bench_reference")
ReferenceSurface, errors_of, reference_of = reference.ReferenceSurface, reference.errors_of, reference.reference_of
spot_gradient, trace_reference = reference.spot_gradient, reference.trace_reference

pytestmark = pytest.mark.usefixtures("same_threads")

TINY = ["bench", "trace", "--rays", "300", "--repeats", "1", "--threads", "1"]


def tensor(*numbers: float) -> torch.Tensor:
    return torch.tensor(numbers if len(numbers) > 1 else numbers[0], dtype=torch.float64)


@pytest.fixture(scope="module")
def document():
    """The one JSON document of the default run."""
    out = io.StringIO()
    with contextlib.redirect_stdout(out):
        assert main([*TINY, "--json"]) == 0
    return json.loads(out.getvalue())


@pytest.mark.slow
def test_json_is_one_document_with_errors_of_float32(document):
    assert document["surfaces"] == 12
    assert document["machine"]["torch threads"] == 1
    rows = document["rows"]
    assert len(rows) == 8  # two dtypes, forward and forward+backward, with and without path
    for row in rows:
        assert row["tracer"] == "raytrace"
        assert row["rays"] == 300
        assert row["speed"] > 0
        if row["dtype"] == "float64":
            assert row["position"] is row["path_error"] is row["gradient"] is None
        else:
            assert 0 < row["position"] < 100  # nm
            assert 0 < row["gradient"] < 1e-3
            assert (row["path_error"] is None) == (not row["path"])
            assert not row["path"] or 0 < row["path_error"] < 0.1  # waves


def test_errors_of_float32_are_those_against_the_reference():
    """But for the rounding of the numbers of the lens, which the reference shares and float64 does not."""
    lens = read_lens("double_gauss")
    tracer = Tracer(lens, torch.float32, with_path=True)
    exact = errors_of(tracer, lens, field_rays(lens, SAMPLE), gradient=False)
    errors = trace.errors_of(tracer, lens)
    for name in ("position", "path_error"):
        assert 0.3 * exact[name] < errors[name] < 3 * exact[name], name


@pytest.mark.parametrize("name", SYSTEMS)
def test_errors_of_any_lens(name):
    """Also of those that the reference does not trace: toroids, tilts and gratings."""
    lens = SYSTEMS[name]()
    errors = trace.errors_of(Tracer(lens, torch.float32), lens)
    assert 0 < errors["position"] < 300  # nm
    assert 0 < errors["gradient"] < 1e-2
    assert errors["path_error"] is None


@pytest.mark.parametrize("name", SYSTEMS)
@pytest.mark.parametrize("backend", ["torch", "numpy"])
def test_a_second_program_traces_the_same_systems(name, backend):
    """Rays, paths and slopes of toroids, tilts and gratings agree with Optiland's, except for what it lacks."""
    peers = pytest.importorskip("posed_optiland", reason="needs the extra [bench]", exc_type=ImportError)
    lens = SYSTEMS[name]()
    tracer, peer = (
        Tracer(lens, torch.float64, with_path=True),
        peers.PosedOptiland(lens, torch.float64, backend=backend),
    )
    rays = field_rays(lens, 200)
    assert error_of(peer) < 1e-3  # nm
    (points, path), (_, other) = tracer.forward(rays), peer.forward(rays)
    paths = [1e3 * (length - length[0]) / peer.wavelength for length in (path, other)]
    differ = float((paths[0] - paths[1]).abs().max())
    assert differ > 1 if "grating's path" in peer.lacks(gradient=False) else differ < 1e-5  # waves
    if peer.has_gradient:
        slopes, others = (torch.stack(list(each.gradient(rays, points.mean(1)))) for each in (tracer, peer))
        known = others != 0
        assert (len(known) == known.sum()) == ("slopes" not in peer.lacks(gradient=True))
        assert torch.allclose(slopes[known], others[known], rtol=1e-9, atol=1e-12)
        assert peer.forward(rays)[1].requires_grad is False


def test_the_spectrometer_disperses_as_its_grating_says():
    """All light arrives, and the image of the slit moves by f · order · frequency · Δλ/cos θ, to aberrations."""
    lens = spectrometer()
    rays, moved = field_rays(lens, 200), []
    for wavelength in (0.549, 0.551):
        end = trace_lens(lens, rays, tensor(wavelength))
        assert end.valid.all()
        moved.append(float(end.position[1].mean()))
    sine = math.sin(math.radians(20.0)) + 0.3 * 0.55
    assert abs(moved[1] - moved[0]) == pytest.approx(150.0 * 0.3 * 0.002 / math.sqrt(1 - sine * sine), rel=0.02)


@pytest.mark.slow
def test_report_and_figure_are_written(tmp_path, capsys):
    report, figure = tmp_path / "bench.csv", tmp_path / "bench.png"
    assert main([*TINY, "-o", str(report), "--plot", str(figure)]) == 0
    assert len(report.read_text(encoding="utf-8").splitlines()) == 1 + 8
    assert capsys.readouterr().out.count("\n 300  ") == 8
    assert figure.read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("name", "bound"),
    [
        ("double_gauss", 1e-10),
        pytest.param("phone", 1e-10, marks=pytest.mark.slow),
        ("hubble", 1e-6),
        pytest.param("cooke_triplet", 1e-10, marks=pytest.mark.slow),
    ],
)
def test_package_agrees_with_the_reference(name, bound):
    """Spheres, planes, strong aspheres, conic mirrors: positions, paths and gradients in float64.

    The telescope's spot is a millionth of its focal length, and its gradient as much worse conditioned.
    """
    lens = read_lens(shipped("lenses") / f"{name}.zmx")
    errors = errors_of(Tracer(lens, torch.float64, with_path=True), lens, field_rays(lens, SAMPLE))
    assert errors["position"] < 1e-5, errors  # nm
    assert errors["path_error"] < 1e-7, errors  # waves
    assert errors["gradient"] < bound, errors


@pytest.mark.parametrize(
    ("conic", "coefficients"),
    [(0.0, ()), (-0.7, ()), (-1.0, ()), (-2.5, ()), (1.3, ()), (-0.5, (1e-4, -2e-6, 3e-9)), (0.0, (0.0, 5e-6))],
)
@pytest.mark.parametrize("is_mirror", [False, True])
def test_one_surface_agrees_with_the_reference(conic, coefficients, is_mirror):
    surface = Surface(
        thickness=tensor(0.0),
        curvature=tensor(0.04),
        conic=tensor(conic),
        coefficients=tensor(*coefficients) if coefficients else None,
        glass=MIRROR if is_mirror else constant(1.6),
    )
    position = torch.tensor([[1.0, -4.0, 6.0], [0.5, 3.0, -6.0], [-2.0, 1.0, 0.0]], dtype=torch.float64)
    direction = torch.tensor([[0.1, -0.2, 0.0], [0.05, 0.1, 0.3], [1.0, 1.0, 1.0]], dtype=torch.float64)
    direction = direction / torch.linalg.vector_norm(direction, dim=0)
    rays = Rays(position, direction, torch.ones(3, dtype=torch.bool), torch.zeros(3, dtype=torch.float64))
    indices = [tensor(1.0), tensor(1.0 if is_mirror else 1.6)]
    end = trace_surfaces([surface], rays, indices=indices)
    assert bool(end.valid.all())
    reference = [ReferenceSurface(0.04, conic, coefficients, 0.0, float(indices[1]), is_mirror)]
    for i in range(3):
        exact = trace_reference(reference, 1.0, position[:, i].tolist(), direction[:, i].tolist())
        assert end.position[:, i].tolist() == pytest.approx([float(x) for x in exact.position], rel=1e-14, abs=1e-14)
        assert end.direction[:, i].tolist() == pytest.approx([float(x) for x in exact.direction], rel=1e-14, abs=1e-14)
        assert float(end.opl[i]) == pytest.approx(float(exact.path), rel=1e-13)


def test_gradient_about_a_fixed_centroid_is_that_of_the_spot():
    lens = read_lens(shipped("lenses") / "cooke_triplet.zmx")
    rays = field_rays(lens, 40)
    moving, leaves = with_leaves(lens, variables(lens))
    x, y, _ = trace_lens(moving, rays, lens.primary).position
    centroid = torch.stack([x.mean(), y.mean()])
    fixed = torch.autograd.grad(squared_radius(x, y, centroid.detach()), leaves, retain_graph=True)
    free = torch.autograd.grad(squared_radius(x, y, centroid), leaves)
    assert torch.allclose(torch.stack(fixed), torch.stack(free), rtol=1e-10, atol=1e-12)


def test_reference_gradient_is_a_derivative():
    """The reference's differences against a closed form: moving the image by dT moves a ray by dT·tan θ."""
    lens = read_lens(shipped("lenses") / "cooke_triplet.zmx")
    surfaces, index = reference_of(lens)
    rays = field_rays(lens, 3)
    starts = list(zip(rays.position.T.tolist(), rays.direction.T.tolist(), strict=True))
    last = len(surfaces) - 2
    assert (last + 1, "thickness") in variables(lens)
    slope = spot_gradient(surfaces, index, starts, [(last, "thickness")])[0]
    ends = [trace_reference(surfaces, index, *start) for start in starts]
    expected = 0.0
    for axis in (0, 1):
        mean = sum(end.position[axis] for end in ends) / 3
        expected += sum(2 * (e.position[axis] - mean) * e.direction[axis] / e.direction[2] for e in ends) / 3
    assert float(slope) == pytest.approx(float(expected), rel=1e-12)


@pytest.mark.parametrize(
    ("position", "direction", "curvature", "words"),
    [((0, 30, -5), (0, 0, 1), 0.05, "misses"), ((0, 9, 0), (0, 0.9, 0.1), -0.1, "totally reflected")],
)
def test_failed_reference_ray_is_an_error(position, direction, curvature, words):
    glass = [ReferenceSurface(curvature, index=1.0)]
    with pytest.raises(ValueError, match=words):
        trace_reference(glass, 1.8, position, direction)


def test_unknown_lens_is_one_line(capsys):
    assert main(["bench", "trace", "no_such_lens"]) == 1
    assert capsys.readouterr().err.startswith("raytrace: error: no_such_lens")


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        ("trace tessar phone", "measures one lens"),
        ("psf --rays 5", "takes no --rays"),
        ("psf --sensor 3x2", "takes no --sensor"),
        ("trace --sensor 3x2", "takes no --sensor"),
        ("camera --plot x.png", "takes no --plot"),
        ("psf no_such_lens", "no such lens file"),
    ],
)
def test_options_of_other_subjects_are_refused(words, reason, capsys):
    assert main(["bench", *words.split()]) == 1
    assert reason in capsys.readouterr().err
