"""Kinds of sag: the odd asphere against its formula in 50 digits, in files and everywhere else; and kinds made up here,
added at run time, which everything has to find in their rows. Polygons as apertures."""

import dataclasses
import json
import math
from decimal import Decimal, localcontext

import pytest
import torch
from differences import gradcheck, gradgradcheck
from problems import SHARED, both_engines, field, lens, scalar, scene_of, surface, vector
from torch.testing import assert_close

import raytrace as rt
from raytrace.analysis.cross_section import depth
from raytrace.imaging.variables import Variables
from raytrace.io import read_lens, write_lens
from raytrace.io.source import LensFileError
from raytrace.maths.numerics import value
from raytrace.maths.sampling import gauss_rings, grid, sobol
from raytrace.psf_models import psf
from raytrace.system import sag_terms, shapes
from raytrace.system.apertures import SHAPES, Aperture, Edge, Shape, clearance, inside, reach, stands_inside
from raytrace.system.intersection import intersect, normal
from raytrace.system.parameter_paths import number_at, parameter_paths, with_number
from raytrace.system.prescription import lens as lens_of_rows
from raytrace.system.rays import start
from raytrace.system.sag_terms import Sag
from raytrace.system.surface import sag, sag_and_derivatives, sag_at
from raytrace.tracing.compiled import is_expressible, trace_engine
from raytrace.tracing.launch import launch
from raytrace.tracing.paraxial import first_order
from raytrace.tracing.scene import Memo, symmetry, trace_bundle
from raytrace.tracing.spot import spot_of
from raytrace.tracing.streaming import stream_spot
from raytrace.tracing.trace import trace_lens, trace_surfaces

TIER2, CORPUS = SHARED / "tier2", SHARED / "corpus"
ODD = "odd asphere"
CURVATURE, CONIC = 0.02, -0.6
PUPIL = gauss_rings(3)[0]
BETA = [0.02, 1e-3, -2e-4, 1e-5, -4e-7, 3e-9, 1e-10, -2e-12]


def odd(coefficients=BETA, curvature=CURVATURE, conic=CONIC, **others):
    return surface(curvature, 5.0, 1.5, conic=conic, coefficients=coefficients, kind=ODD, semi_diameter=9.0, **others)


def bundle(count: int = 40, seed: int = 3, reach: float = 5.0):
    """Positions and unit directions of rays before the vertex plane; the first along the axis, through the vertex."""
    generator = torch.Generator().manual_seed(seed)
    spread = 2 * torch.rand(4, count, generator=generator, dtype=torch.float64) - 1
    spread[:, 0] = 0
    direction = torch.stack([0.3 * spread[0], 0.3 * spread[1], torch.ones(count, dtype=torch.float64)])
    direction = direction / torch.linalg.vector_norm(direction, dim=0)
    position = torch.stack([reach * spread[2], reach * spread[3], torch.zeros(count, dtype=torch.float64)])
    return position - 20 * direction, direction


def textbook(position, direction, n1: float, n2: float):
    """Hit and direction behind an odd asphere by its formula: bisection and Snell's law in 50 digits."""
    with localcontext() as context:
        context.prec = 50
        c, shape = Decimal(CURVATURE), 1 + Decimal(CONIC)
        beta = [Decimal(b) for b in BETA]
        p, d = ([Decimal(x) for x in v.tolist()] for v in (position, direction))

        def sag_of(r):
            w = (1 - shape * c * c * r * r).sqrt()
            return c * r * r / (1 + w) + sum(b * r**i for i, b in enumerate(beta, 1))

        def at(t):
            return [a + t * b for a, b in zip(p, d, strict=True)]

        low, high = Decimal(15), Decimal(27)
        for _ in range(160):
            middle = (low + high) / 2
            x, y, z = at(middle)
            low, high = (middle, high) if z < sag_of((x * x + y * y).sqrt()) else (low, middle)
        x, y, z = at(low)
        r = (x * x + y * y).sqrt()
        slope = c * r / (1 - shape * c * c * r * r).sqrt() + sum(i * b * r ** (i - 1) for i, b in enumerate(beta, 1))
        size = (1 + slope * slope).sqrt()
        normal = [-slope * x / r / size, -slope * y / r / size, 1 / size]
        length = sum(v * v for v in d).sqrt()
        unit = [v / length for v in d]
        mu, cosine = Decimal(n1) / Decimal(n2), sum(a * b for a, b in zip(normal, unit, strict=True))
        behind = (1 - mu * mu * (1 - cosine * cosine)).sqrt()
        bent = [mu * a + (behind - mu * cosine) * b for a, b in zip(unit, normal, strict=True)]
        return [float(v) for v in (x, y, z)], [float(v) for v in bent]


@both_engines
def test_odd_asphere_is_its_formula_in_fifty_digits(engine):
    position, direction = bundle(12)
    rays = start(position, direction)
    end = trace_surfaces([odd()], rays, indices=vector(1.0, 1.5).unbind(), gap=None)
    assert end.valid.all()
    for i in range(1, 12):
        hit, bent = textbook(position[:, i], direction[:, i], 1.0, 1.5)
        assert_close(end.position[:, i], vector(*hit), rtol=0, atol=1e-14 * 30)
        assert_close(end.direction[:, i], vector(*bent), rtol=0, atol=2e-15)


def test_slopes_are_the_derivatives_of_the_sag():
    u = vector(0.01, 0.5, 20.0).requires_grad_()
    S, dS, d2S = sag_and_derivatives(u, scalar(0.05), scalar(1.2), vector(*BETA), kind=ODD)
    (slope,) = torch.autograd.grad(S.sum(), u, create_graph=True)
    (bend,) = torch.autograd.grad(slope.sum(), u)
    assert_close(slope, dS, rtol=1e-13, atol=0)
    assert_close(bend, d2S, rtol=1e-12, atol=0)


def numbers_of(given):
    return {"curvature": scalar(0.02), "conic": scalar(-0.6), "coefficients": vector(*BETA), **given}


@pytest.mark.parametrize("name", ["curvature", "conic", "coefficients", "position"])
def test_first_and_second_derivatives_of_the_hit(name):
    position, direction = bundle(5, reach=1.0)
    position, direction = position[:, 1:], direction[:, 1:]

    def hits(x):
        given = numbers_of({name: x} if name != "position" else {})
        face = surface(given["curvature"], 5.0, 1.5, conic=given["conic"], coefficients=given["coefficients"], kind=ODD)
        return intersect(face, x if name == "position" else position, direction)[0]

    x = (position if name == "position" else numbers_of({})[name]).clone().requires_grad_()
    assert gradcheck(hits, x, eps=1e-7, atol=1e-5, rtol=1e-4)
    assert gradgradcheck(hits, x, eps=1e-7, atol=2e-3, rtol=2e-3)


@both_engines
def test_even_powers_alone_are_the_even_asphere_at_the_vertex_too(engine):
    """Hits, directions and their derivatives, also of the ray through the vertex: the tip of a cone that is flat."""
    position, direction = bundle(64)
    found = []
    for kind, terms in ((ODD, [0.0, 1e-3, 0.0, 1e-5, 0.0, 3e-9]), (shapes.EVEN, [1e-3, 1e-5, 3e-9])):
        c, a, p = scalar(0.02).requires_grad_(), vector(*terms).requires_grad_(), position.clone().requires_grad_()
        face = surface(c, 5.0, 1.5, conic=-0.6, coefficients=a, kind=kind, semi_diameter=9.0)
        end = trace_surfaces([face], start(p, direction), indices=vector(1.0, 1.5).unbind())
        merit = (end.direction[:2] * torch.linspace(1, 2, 64, dtype=torch.float64)).sum() + (end.position**2).sum()
        by_c, by_a, by_p = torch.autograd.grad(merit, (c, a, p))
        found.append((end.position, end.direction, by_c, by_a[1::2] if kind == ODD else by_a, by_p))
    for one, other in zip(*found, strict=True):
        assert_close(one, other, rtol=1e-11, atol=1e-13)


@both_engines
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_the_tip_of_a_cone_makes_no_nan(engine, dtype):
    """A ray through the tip meets the mean of all directions, the vertex plane; its neighbours meet the cone."""
    position = torch.zeros(3, 4, dtype=dtype)
    position[1] = torch.tensor([0.0, 1e-13, 1e-9, 1e-3], dtype=dtype)
    position[2] = -1
    beta, p = torch.tensor([0.1, 0.01, 0.0], dtype=dtype).requires_grad_(), position.requires_grad_()
    face = dataclasses.replace(odd(), curvature=None, conic=None, coefficients=beta)
    axis = torch.tensor([[0.0], [0.0], [1.0]], dtype=dtype).expand(3, 4)
    rays = dataclasses.replace(start(p, axis), direction=axis)
    end = trace_surfaces([face], rays, indices=torch.tensor([1.0, 1.5], dtype=dtype).unbind())
    assert end.valid.all()
    by_p, by_beta = torch.autograd.grad(end.direction[1].sum() + end.position[2].sum(), (p, beta))
    assert by_p.isfinite().all()
    assert by_beta.isfinite().all()
    assert end.direction[1, :2].abs().max() < 1e-12
    slope = 0.1 + 0.02 * 1e-3
    bent = math.asin(math.sin(math.atan(slope)) / 1.5) - math.atan(slope)
    assert float(end.direction[1, 3]) == pytest.approx(math.sin(bent), rel=1e-6)


@pytest.mark.needs(TIER2)
def test_a_file_of_another_hand_is_traced_as_its_oracle_says():
    found = read_lens(TIER2 / "dev" / "oddasphe.zmx")
    oracle = json.loads((TIER2 / "oracle_dev.json").read_text())["files"]["oddasphe.zmx"]
    front = found.surfaces[2]
    assert front.kind == ODD
    assert front.coefficients.tolist() == [0.002, 0.0001, -1e-05, 2e-06, 1e-08]
    for ray in oracle["rays"]:
        rays = start(vector(*ray["P"])[:, None], vector(*ray["D"])[:, None])
        end = trace_lens(found, rays, scalar(ray["wavelength"]))
        expected = vector(*ray["out"][-1])
        assert_close(torch.cat([end.position, end.direction])[:, 0], expected, rtol=0, atol=1e-10)
    efl = oracle["first_order"]["efl"]
    assert float(first_order(found).effective_focal_length) == pytest.approx(efl, rel=1e-9)


@pytest.mark.parametrize("suffix", [".zmx", ".csv", ".tsv"])
def test_files_bring_every_number_back(tmp_path, suffix):
    system = lens([odd(), surface(0.01, 40.0, coefficients=[0.0, 1e-6]), surface(None, 2.0)])
    write_lens(system, tmp_path / f"odd{suffix}")
    back = read_lens(tmp_path / f"odd{suffix}").surfaces
    assert [s.kind for s in back[1:3]] == [ODD, shapes.EVEN]
    for one, other in zip(system.surfaces[1:3], back[1:3], strict=True):
        assert torch.equal(one.coefficients, other.coefficients)
        assert torch.equal(sag(one, vector(0.0, 7.0)), sag(other, vector(0.0, 7.0)))


def test_units_and_too_many_terms(tmp_path):
    path, rows = tmp_path / "odd.csv", "0,inf,inf,,,\n1,2,1,1.5,0.1,0.2\n2,inf,9,,,\n3,inf,0,,,\n"
    path.write_text(f"# units: in\n# stop: 1\nsurface,radius,thickness,glass,a1,a3\n{rows}")
    face = read_lens(path).surfaces[1]
    assert face.kind == ODD
    assert_close(face.coefficients, vector(0.1, 0.0, 0.2 / 25.4**2), rtol=1e-15, atol=0)
    with pytest.raises(LensFileError, match=r"9 terms .*ODDASPHE has 8"):
        write_lens(lens([odd([1e-9] * 9), surface(None, 2.0)]), tmp_path / "odd.zmx")


# ---------------------------------------------------------------- everything that has to know of a kind


@value
class Ripple:
    """sag terms made up here: depth (R,) mm of ripples exp(-(x² + 2 y²)/width²), one number and several."""

    depth: torch.Tensor
    width: torch.Tensor


def ripple_sag(numbers, x, y, highest):
    depth, width = (number.to(x.dtype) for number in numbers)
    s = width**-2
    z = depth.sum() * torch.exp(-(x * x + 2 * y * y) * s)
    z_x, z_y = -2 * x * s * z, -4 * y * s * z
    return Sag(z, z_x, z_y, -2 * s * (z + x * z_x), -2 * x * s * z_y, -4 * s * (z + y * z_y))


def dome(u, coefficients, highest, along):
    """Terms made up here: a_j (1 + u)^(j/2) - a_j, r² j/2 near the vertex."""
    total = [torch.zeros_like(u) for _ in range(3)]
    for j, a in enumerate(coefficients.unbind(0), 1):
        power = (1 + u) ** (j / 2)
        terms = a * (power - 1), a * j / 2 * power / (1 + u), a * j / 2 * (j / 2 - 1) * power / (1 + u) ** 2 * along**2
        total = [t + term for t, term in zip(total, terms, strict=True)]
    return total[0], total[1] if highest > 0 else None, total[2] if highest > 1 else None


@pytest.fixture
def made_up(monkeypatch):
    kind = shapes.Kind("dome", dome, zemax="USERDOME", words=("dome",))
    monkeypatch.setitem(shapes.KINDS, "dome", kind)
    ripple = sag_terms.SagTermKind(ripple_sag, lambda numbers, radius: numbers[0].abs().sum())
    monkeypatch.setitem(sag_terms.SAG_TERMS, "Ripple", ripple)


FACES = {
    "odd": lambda **others: odd([0.0, *BETA[1:]], **others),
    "dome": lambda **others: dataclasses.replace(odd([0.01, -2e-3], curvature=0.03, **others), kind="dome"),
    "ripple": lambda **others: odd(None, sag_terms=Ripple(vector(0.02, 0.01), scalar(6.0)), **others),
}
SYMMETRY = {"odd": "round", "dome": "round", "ripple": "none"}
VARIABLES = {"odd": "a2:1 a3:1 a8:1", "dome": "a2:1 a4:1", "ripple": "depth1:1 depth2:1 width:1"}


def system_of(name: str, **others):
    return lens([FACES[name](**others), surface(-0.02, 60.0)])


@pytest.mark.parametrize("name", FACES)
@pytest.mark.usefixtures("made_up")
class TestWhatHasToKnow:
    def test_hits_lie_on_the_sag_and_normals_are_its_slopes(self, name):
        position, direction = bundle()
        hit, met = intersect(FACES[name](), position, direction)
        assert met.all()
        assert (hit[2] - sag_at(FACES[name](), hit[0], hit[1])).abs().max() < 1e-13
        x, y = (part[1:].clone().requires_grad_() for part in hit[:2])
        slope = torch.autograd.grad(sag_at(FACES[name](), x, y).sum(), (x, y))
        n, _ = normal(FACES[name](), hit[:, 1:])
        assert_close(-n[0] / n[2], slope[0], rtol=1e-11, atol=1e-13)
        assert_close(-n[1] / n[2], slope[1], rtol=1e-11, atol=1e-13)

    def test_paraxial_power_is_the_limit_of_real_rays(self, name):
        """The mean over two meridians, at a height of 1 µm."""
        system, height = system_of(name), 0.001
        bent = []
        for x, y in ((height, 0.0), (0.0, height)):
            rays = start(vector(x, y, 0.0)[:, None], vector(0.0, 0.0, 1.0)[:, None])
            end = trace_lens(system, rays, system.wavelengths[0])
            bent.append(-float(end.direction[:2].sum()) / height)
        power = float(first_order(system).power)
        assert sum(bent) / 2 == pytest.approx(power, rel=1e-4)

    def test_every_number_is_a_variable_with_the_derivative_of_a_difference(self, name):
        """By its name, through Variables and the trace; and the memory of traced rays forgets what it moves."""
        system, memo = system_of(name), Memo()
        variables = Variables(system, VARIABLES[name])

        def merit(memo=None):
            changed = variables()
            rays = trace_bundle((changed, field(3.0), changed.wavelengths[:1], PUPIL), memo)
            return (rays.position[:2] ** 2).sum()

        merit(memo)
        for parameter in variables.parameters():
            (slope,) = torch.autograd.grad(merit(memo), parameter)
            ends = []
            with torch.no_grad():
                for step in (1e-5, -2e-5):
                    parameter += step
                    ends.append(float(merit(memo)))
                parameter += 1e-5
            assert float(slope) == pytest.approx((ends[0] - ends[1]) / 2e-5, rel=1e-4)
            assert float(slope) != 0

    def test_every_tensor_of_a_shape_ends_the_memory(self, name):
        """Also one that a kind has for itself: each is a leaf of the shape."""
        system, memo = lens([surface(0.01, 3.0, 1.6), FACES[name](), surface(-0.02, 60.0)]), Memo()
        trace_bundle((system, field(0.0), system.wavelengths[:1], PUPIL), memo)
        for place in parameter_paths(system.surfaces[2]).values():
            number = number_at(system.surfaces[2], place)
            moved = with_number(system.surfaces[2], place, number.clone().requires_grad_())
            changed = dataclasses.replace(system, surfaces=(*system.surfaces[:2], moved, *system.surfaces[3:]))
            given = changed, field(0.0), changed.wavelengths[:1], PUPIL
            trace_bundle(given, memo)
            before = memo.crossed
            assert trace_bundle(given, memo).position.requires_grad
            assert memo.crossed - before == 3

    def test_symmetry_streams_kernels_and_figures(self, name, tmp_path):
        system = system_of(name)
        assert symmetry(scene_of(system)) == SYMMETRY[name]
        streamed = stream_spot(system, 4096, sampling="sobol", seed=1)
        assert float(streamed.rays.sum()) == 4096
        points = sobol(4096, seed=1)[0]
        end = trace_lens(system, launch(system, points), system.wavelengths[:, None])
        assert float(streamed.rms_radius) == pytest.approx(float(spot_of(end).rms_radius), rel=1e-9)
        found = psf(system, "gaussian", fields=field(0.0), grid=grid(0.5, 9), tol=1e-2)
        assert found.kernel.isfinite().all()
        rt.layout(system).plot(tmp_path / "layout.png")
        y = torch.linspace(-5, 5, 11, dtype=torch.float64)
        drawn = torch.as_tensor(depth(system.surfaces[1], y.numpy()))
        assert_close(drawn, sag_at(system.surfaces[1], 0 * y, y), rtol=0, atol=1e-14)

    def test_lens_rows_and_replace(self, name):
        face = FACES[name]()
        row = {key: getattr(face, key) for key in ("curvature", "conic", "coefficients", "kind", "sag_terms")}
        made = lens_of_rows([row | {"thickness": 5.0, "glass": 1.5}], stop=1, f_number=8).surfaces[1]
        plain = lens_of_rows([dict(radius=50, thickness=5.0, glass=1.5)], stop=1, f_number=8)
        for found in (made, plain.replace(1, **row).surfaces[1]):
            x = vector(0.0, 3.0, 4.0)
            assert torch.equal(sag_at(found, x, x), sag_at(face, x, x))
        with pytest.raises(
            ValueError,
            match=r"surface 1: .*'cone'; expected .*even asphere, .*biconic, dome",
        ):
            plain.replace(1, kind="cone")

    def test_files_store_it_or_report_that_they_do_not(self, name, tmp_path):
        system = system_of(name)
        for suffix in (".zmx", ".csv"):
            path = tmp_path / f"{name}{suffix}"
            if name == "ripple":
                with pytest.raises(LensFileError, match="ripple"):
                    write_lens(system, path)
                continue
            write_lens(system, path)
            back = read_lens(path).surfaces[1]
            assert back.kind == system.surfaces[1].kind
            assert torch.equal(
                back.coefficients[: len(system.surfaces[1].coefficients)], system.surfaces[1].coefficients
            )

    @both_engines
    def test_both_engines_trace_it(self, name, engine):
        """The compiled trace leaves to torch what it has no code for."""
        system = system_of(name)
        rays = start(*bundle(300))
        found = trace_lens(system, rays, system.wavelengths[0])
        with trace_engine("eager"):
            expected = trace_lens(system, rays, system.wavelengths[0])
        assert is_expressible(system.surfaces[1]) == (name == "odd")
        assert_close(found.position, expected.position, rtol=0, atol=1e-12)


# ---------------------------------------------------------------- polygons

SLIT = CORPUS / "zmx" / "Project_X__sc_slit.ZMX"
#: A square ring of ±4 mm with a hole of ±2 mm and a triangle outside it, each closed.
CORNERS = (-4, -4, 4, -4, 4, 4, -4, 4, -4, -4, -2, -2, -2, 2, 2, 2, 2, -2, -2, -2, 6, 1, 8, 1, 7, 3, 6, 1)


STEPS = (-1e-9, 0.0, 1e-9)


def polygon(*corners: float, **others) -> Aperture:
    return Aperture("polygon", tuple(float(c) for c in corners), **others)


def through(x, y):
    """The same by its words."""
    ring = max(abs(x), abs(y)) <= 4 and max(abs(x), abs(y)) >= 2
    return ring or (1 <= y <= 3 and 2 * (x - 6) >= y - 1 and 2 * (8 - x) >= y - 1)


@both_engines
@pytest.mark.parametrize("obscures", [False, True])
def test_polygons_pass_points_within_an_odd_number_of_them(engine, obscures):
    grid_of = torch.linspace(-9, 9, 73, dtype=torch.float64)  # corners and sides among them
    x, y = (part.reshape(-1) for part in torch.meshgrid(grid_of, grid_of, indexing="xy"))
    position = torch.stack([x, y, torch.zeros_like(x)])
    axis = torch.zeros_like(position)
    axis[2] = 1
    stop = surface(None, 1.0, apertures=(polygon(*CORNERS, obscures=obscures),))
    valid = trace_surfaces([stop], start(position, axis), indices=[scalar(1.0)] * 2).valid
    for px, py, passes in zip(x.tolist(), y.tolist(), valid.tolist(), strict=True):
        near = min(through(px + dx, py + dy) for dx in STEPS for dy in STEPS)
        far = max(through(px + dx, py + dy) for dx in STEPS for dy in STEPS)
        assert passes == (not near if obscures else far), (px, py)


def test_the_clearance_of_a_polygon_is_its_distance_in_its_size():
    square = polygon(-3, -3, 3, -3, 3, 3, -3, 3)
    hit = vector(0.0, 0.0, 2.5, 1.0, 5.0, 0.0).reshape(3, 2).T
    assert_close(clearance(square, hit), vector(3.0, 0.5, -2.0) / 3, rtol=1e-15, atol=0)
    assert_close(clearance(dataclasses.replace(square, obscures=True), hit), vector(-3.0, -0.5, 2.0) / 3)
    x = vector(2.9, 3.1).requires_grad_()
    (slope,) = torch.autograd.grad(clearance(square, torch.stack([x, 0 * x])).sum(), x)
    assert_close(slope, vector(-1.0, -1.0) / 3)
    assert reach(square) == (0.0, 3.0)
    assert stands_inside(square)


@pytest.mark.parametrize("suffix", [".zmx", ".csv"])
def test_polygons_in_files(tmp_path, suffix):
    face = surface(0.02, 5.0, 1.5, semi_diameter=9.0, apertures=(polygon(*CORNERS, centre=(0.5, -0.25)),))
    path = tmp_path / f"polygon{suffix}"
    write_lens(lens([face, surface(-0.02, 60.0)]), path)
    found = read_lens(path).surfaces[1].apertures[0]
    assert (found.shape, found.extent, found.centre) == ("polygon", polygon(*CORNERS).extent, (0.5, -0.25))


def test_polygons_that_files_cannot_hold(tmp_path):
    def write(path, *corners):
        write_lens(lens([surface(None, 5.0, apertures=(polygon(*corners),)), surface(-0.02, 60.0)]), path)

    with pytest.raises(LensFileError, match="corner at 0, 0"):
        write(tmp_path / "polygon.zmx", 0, 0, 1, 0, 1, 1)
    with pytest.raises(LensFileError, match="has no points x, y, three or more"):
        write(tmp_path / "line.csv", 1, 0, 1, 1)


def test_a_scene_with_a_polygon_has_no_symmetry_and_a_figure(tmp_path):
    system = lens([surface(0.02, 5.0, 1.5, apertures=(polygon(-3, -3, 3, -3, 0, 4),)), surface(-0.02, 60.0)])
    assert symmetry(scene_of(system)) == "none"
    rt.layout(system).plot(tmp_path / "layout.png")
    found = psf(system, "drt", fields=field(0.0), grid=grid(0.5, 9), tol=3e-2)
    share = 0.5 * 6 * 7 / (math.pi * 25)
    assert float(found.energy) == pytest.approx(share, rel=3e-2)


@pytest.mark.needs(CORPUS)
def test_slits_of_a_real_file():
    """Six bars of 1 × 12 mm, one every 2 mm, as user-defined aperture that is shifted by half a bar."""
    (aperture,) = read_lens(SLIT).surfaces[1].apertures
    assert len(aperture.extent) == 6 * 10
    assert aperture.centre == (-0.5, 0.0)
    x = vector(-4.5, -3.5, -2.5, 0.5, 1.5, 5.5, 6.5) - 0.5
    assert inside((aperture,), torch.stack([x, 0 * x])).tolist() == [True, False, True, False, True, True, False]


def test_a_shape_of_aperture_added_at_run_time_is_found_by_everything(monkeypatch, tmp_path):
    """A diamond |x|/a + |y|/b ≤ 1: traced, drawn, in kernels and in files; refused where it is unknown."""
    diamond = Aperture("diamond", (4.0, 3.0))
    system = lens([surface(0.02, 5.0, 1.5, apertures=(diamond,), semi_diameter=9.0), surface(-0.02, 60.0)])
    with pytest.raises(ValueError, match=r"surface 1: .*'diamond'; expected .*circular, rect"):
        system.at(object_distance=1e4)
    row = Shape(
        lambda x, y, sizes: [Edge(x.abs() / sizes[0] + y.abs() / sizes[1], 1.0)],
        lambda sizes: (0.0, sizes[1]), "mirror", ("DIAP", "DIOB"),
    )  # fmt: skip
    monkeypatch.setitem(SHAPES, "diamond", row)
    assert system.at(object_distance=1e4).surfaces[1].apertures == (diamond,)
    assert not is_expressible(system.surfaces[1])
    position = torch.stack([vector(0.0, 4.0, 2.0, 2.1, 0.0), vector(0.0, 0.0, 1.5, 1.5, -3.1), torch.zeros(5).double()])
    axis = torch.zeros_like(position)
    axis[2] = 1
    for engine in ("eager", "compiled"):
        with trace_engine(engine):
            valid = trace_lens(system, start(position, axis), system.wavelengths[0]).valid
        assert valid.tolist() == [True, True, True, False, False]
    assert symmetry(scene_of(system)) == "mirror"
    rt.layout(system).plot(tmp_path / "layout.png")
    found = psf(system, "drt", fields=field(0.0), grid=grid(0.5, 9), tol=3e-2)
    assert float(found.energy) == pytest.approx(2 * 4 * 3 / (math.pi * 25), rel=3e-2)
    for suffix in (".zmx", ".csv"):
        write_lens(system, tmp_path / f"diamond{suffix}")
        (back,) = read_lens(tmp_path / f"diamond{suffix}").surfaces[1].apertures
        assert (back.shape, back.extent, back.obscures) == ("diamond", (4.0, 3.0), False)
    with pytest.raises(ValueError, match=r"surface 1: .*diamond.*negative size"):
        system.replace(1, apertures=(Aperture("diamond", (4.0, -3.0)),))
