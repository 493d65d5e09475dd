"""The compiled trace: the eager one to rounding, its adjoint, how it is chosen, built and kept."""

import dataclasses
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from compiled_rays import CLOSE, assert_same_rays, both, leaves_of_rays, some_rays, with_leaves
from hits import hit_jacobian
from problems import both_engines, double_gauss, lens, scalar, surface, vector, vignetting_aperture
from torch.autograd import gradcheck, gradgradcheck
from torch.testing import assert_close

from raytrace.files import shipped
from raytrace.io import read_lens
from raytrace.materials.glass import MIRROR
from raytrace.maths.numerics import to
from raytrace.maths.sampling import sobol
from raytrace.system.lens import media
from raytrace.system.rays import Rays, start
from raytrace.system.sag_terms import ZernikeSag
from raytrace.system.surface import Aperture
from raytrace.tracing.compiled import (
    engine,
    prepare,
    task_of,
    trace_compiled,
    trace_engine,
    uses_compiled,
    with_numbers,
)
from raytrace.tracing.launch import launch
from raytrace.tracing.trace import pushed, trace_lens, trace_surfaces

pytestmark = pytest.mark.usefixtures("compiler")

LENSES = sorted(path for path in shipped("lenses").iterdir() if path.suffix == ".zmx")


#: Every kind of surface, a mirror, apertures of every shape, a dummy, and rays lost in every way.
EVERYTHING = lens(
    [
        surface(0.05, 6.0, 1.6, conic=-0.3, apertures=vignetting_aperture(9.0)),
        surface(-0.03, 2.0, coefficients=[1e-3, -1e-5], semi_diameter=12.0),
        surface(None, 1.0, apertures=(Aperture("rectangular", (6.0, 7.0), centre=(0.5, -0.5)),)),
        surface(-0.08, 3.0, 1.7, apertures=(Aperture("circular", (0.0, 0.3), obscures=True),)),
        surface(None, 4.0, 1.5),
        surface(0.01, 3.0, coefficients=[0.0, 1e-5, 1e-8, 1e-11, 1e-14], conic=-1.0, semi_diameter=14.0),
        surface(0.02, 2.0, 1.4, kind="odd asphere", coefficients=[0.02, 1e-3, -2e-4, 1e-5, -4e-7], semi_diameter=14.0),
        surface(-0.02, -10.0, MIRROR, conic=0.4, apertures=(Aperture("elliptic", (9.0, 8.0)),)),
        surface(-0.01, -5.0),
    ],
    object_distance=50.0,
)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("path", LENSES, ids=lambda path: path.stem)
def test_shipped_lenses_are_traced_as_by_torch(path, dtype):
    system = to(read_lens(path), dtype=dtype)
    with torch.no_grad(), trace_engine("eager"):
        rays = launch(system, sobol(301)[0].to(dtype))
    compiled, eager = both(lambda: trace_lens(system, rays, system.wavelengths[:, None]))
    assert torch.equal(compiled.valid, eager.valid)
    # Rounding of float32 puts each trace at up to 1.6e-6 from the double one of the same numbers, on either side of it.
    system, rays = (to(t, dtype=torch.float64) for t in (system, rays))
    with torch.no_grad(), trace_engine("eager"):
        exact = trace_lens(system, rays, system.wavelengths[:, None])
    size = max(float(s.thickness.abs()) for s in system.surfaces[1:])
    assert_same_rays(to(compiled, dtype=torch.float64), exact, CLOSE[dtype], max(size, 10.0))
    assert eager.valid.any()


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("with_path", [True, False])
def test_every_kind_of_surface_and_of_loss(dtype, with_path):
    system, rays = to(EVERYTHING, dtype=dtype), some_rays(dtype=dtype)
    rays = rays if with_path else dataclasses.replace(rays, opl=None)
    compiled, eager = both(lambda: trace_lens(system, rays, system.wavelengths[0]))
    assert 20 < int((~eager.valid).sum()) < 600
    assert_same_rays(compiled, eager, 10 * CLOSE[dtype])


@pytest.mark.parametrize(("dtype", "close"), [(torch.float64, 1e-11), (torch.float32, 2e-3)])
@pytest.mark.parametrize("with_path", [True, False])
def test_the_adjoint_equals_autograd(dtype, close, with_path):
    """By every number of the lens and by the rays, of a merit in which all that comes out has a weight."""
    system, rays = to(EVERYTHING, dtype=dtype), some_rays(dtype=dtype)
    generator = torch.Generator().manual_seed(1)
    weights = torch.randn(7, 700, generator=generator, dtype=torch.float64).to(dtype)

    def gradients():
        surfaces, indices, leaves = with_leaves(system.surfaces[1:], media(system, system.wavelengths[0]))
        given = [rays.position.clone().requires_grad_(), rays.direction.clone().requires_grad_()]
        opl = rays.opl.clone().requires_grad_() if with_path else None
        end = trace_surfaces(surfaces, Rays(*given, rays.valid, opl), indices=indices)
        out = [end.position, end.direction, *([end.opl[None]] if with_path else [])]
        merit = sum((w * x).sum() for w, x in zip(weights.split([3, 3, 1]), out, strict=False))
        inputs = [*leaves, *given, *([opl] if with_path else [])]
        return torch.autograd.grad(merit, inputs, allow_unused=True)

    compiled, eager = both(gradients)
    for f, e in zip(compiled, eager, strict=True):
        if e is None:
            assert f is None or not f.any()
            continue
        assert torch.isfinite(f).all()
        # Sums over rays of both signs: compared with the largest of their kind.
        assert float((f - e).abs().max()) <= close * (float(e.abs().max()) + 1.0)


@pytest.mark.parametrize(
    ("dtype", "close"), [(torch.float64, 1e-11), pytest.param(torch.float32, 2e-3, marks=pytest.mark.slow)]
)
@pytest.mark.slow
def test_the_forward_derivatives_of_every_number_are_those_of_torch(dtype, close):
    """∂hit/∂v by every number of the lens, through the compiled tangents and through jvp."""
    system, rays = to(EVERYTHING, dtype=dtype), some_rays(200, dtype=dtype)
    surfaces, indices, leaves = with_leaves(system.surfaces[1:], media(system, system.wavelengths[0]))
    compiled, eager = both(lambda: hit_jacobian(surfaces, rays, leaves, indices=indices))
    assert compiled.shape == (sum(x.numel() for x in leaves), 2, 200)
    for f, e in zip(compiled, eager, strict=True):
        assert float((f - e).abs().max()) <= close * (float(e.abs().max()) + 1.0)


@both_engines
def test_the_jacobian_sums_up_to_the_gradient(engine):
    """Σ w ∂hit/∂v is the gradient of Σ w·hit; variables may be behind the numbers, and populations have rows."""
    rays = some_rays(60)
    rays = Rays(rays.position[:, None], rays.direction[:, None], rays.valid[None], None)
    bend, length = vector(0.05, 0.04).requires_grad_(), scalar(2.0).requires_grad_()
    first = dataclasses.replace(EVERYTHING.surfaces[1], curvature=bend[:, None], thickness=3 * length)
    surfaces, indices = [first, *EVERYTHING.surfaces[2:]], media(EVERYTHING, EVERYTHING.wavelengths[0])
    weights = torch.randn(2, 2, 60, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    found = (hit_jacobian(surfaces, rays, [bend, length], indices=indices) * weights).sum((1, 2, 3))
    merit = (trace_surfaces(surfaces, rays, indices=indices).position[:2] * weights).sum()
    expected = torch.cat([g.reshape(-1) for g in torch.autograd.grad(merit, [bend, length])])
    assert_close(found, expected, rtol=1e-11, atol=0)


def test_a_gap_that_rays_along_the_axis_cross_has_no_derivative():
    """Exactly none: what moves a kernel is counted by derivatives other than 0."""
    heights = torch.linspace(-8.0, 8.0, 33, dtype=torch.float64)
    zero = torch.zeros_like(heights)
    rays = start(torch.stack([zero, heights, zero]), torch.stack([zero, zero, zero + 1]), None)
    gap = scalar(7.0).requires_grad_()
    mirror = surface(-0.01, -30.0, MIRROR, conic=-1.1)
    surfaces = [dataclasses.replace(surface(None), thickness=gap), mirror, surface(None)]
    for (gradient,) in both(
        lambda: torch.autograd.grad(
            (trace_surfaces(surfaces, rays, indices=[scalar(1.0)] * 4).position ** 2).sum(), gap
        )
    ):
        assert float(gradient) == 0.0


@pytest.mark.slow
def test_gradients_of_gradients_pass_through_the_eager_trace():
    system = double_gauss()
    rays = Rays(*(x[..., :5] for x in (some_rays().position, some_rays().direction, some_rays().valid)))

    def spread(curvature, thickness):
        changed = system.replace(1, curvature=curvature).replace(2, thickness=thickness)
        return trace_lens(changed, rays, system.wavelengths[0]).position[:2]

    arguments = system.surfaces[1].curvature.clone().requires_grad_(), scalar(0.5).requires_grad_()
    with trace_engine("compiled"):
        assert gradcheck(spread, arguments, atol=1e-5, rtol=1e-4)
        assert gradgradcheck(spread, arguments, atol=1e-3, rtol=1e-3)


def test_a_ray_does_not_depend_on_its_neighbours_nor_gradients_on_threads():
    """Bit for bit: rays traced alone, in other places of a block, and sums over many blocks in one thread or two."""
    rays, wavelength = some_rays(40_000), EVERYTHING.wavelengths[0]

    def gradient(threads):
        before = torch.get_num_threads()
        torch.set_num_threads(threads)
        try:
            surfaces, indices, leaves = with_leaves(EVERYTHING.surfaces[1:], media(EVERYTHING, wavelength))
            end = trace_surfaces(surfaces, rays, indices=indices)
            return torch.autograd.grad((end.position**2).sum(), leaves, allow_unused=True)
        finally:
            torch.set_num_threads(before)

    with trace_engine("compiled"):
        together = trace_lens(EVERYTHING, rays, wavelength)
        chosen = torch.tensor([0, 1, 15, 16, 17, 50, 255, 256, 300, 39_999])
        alone = trace_lens(EVERYTHING, Rays(*(x[..., chosen] for x in leaves_of_rays(rays))), wavelength)
        for part, whole in zip(leaves_of_rays(alone), leaves_of_rays(together), strict=True):
            assert torch.equal(part, whole[..., chosen])
        for one, two in zip(gradient(1), gradient(2), strict=True):
            assert one is two is None or torch.equal(one, two)


@pytest.mark.parametrize("axes", [(3, 1, 1), (3, 1), (1, 4, 1)])
def test_populations_and_wavelengths_get_rows_of_their_own(axes):
    """Numbers with batch axes, whose gradients come back in their own shape."""
    rays = some_rays(50)
    rays = Rays(rays.position[:, None], rays.direction[:, None], rays.valid[None], rays.opl[None])
    scale = torch.linspace(0.9, 1.1, 12, dtype=torch.float64)[: axes[0] * axes[1] if len(axes) > 1 else axes[0]]

    def outcome():
        factor = scale.reshape(axes).clone().requires_grad_()
        surfaces = [dataclasses.replace(EVERYTHING.surfaces[1], curvature=0.05 * factor), *EVERYTHING.surfaces[2:]]
        end = trace_surfaces(surfaces, rays, indices=media(EVERYTHING, EVERYTHING.wavelengths[0]))
        (gradient,) = torch.autograd.grad((end.position**2).sum(), factor)
        return end, gradient

    (compiled, by_compiled), (eager, by_eager) = both(outcome)
    assert compiled.shape == eager.shape
    assert_same_rays(compiled, eager, 1e-12)
    assert_close(by_compiled, by_eager, rtol=1e-10, atol=1e-8)


def test_numbers_that_differ_by_ray_are_left_to_torch():
    rays = some_rays(3)
    surfaces = [surface(vector(0.01, 0.02, 0.03), 5.0, 1.5)]
    how = {"indices": [scalar(1.0), scalar(1.5)], "side": 1, "gap": None}
    assert trace_compiled(surfaces, rays, **how, eager=None) is None
    compiled, eager = both(lambda: trace_surfaces(surfaces, rays, indices=how["indices"]))
    assert torch.equal(compiled.position, eager.position)


def test_surfaces_with_sag_terms_are_traced_between_compiled_ones():
    bump = ZernikeSag(vector(0.0, 0.0, 0.0, 1e-3, 2e-3), scalar(10.0))
    surfaces = [*EVERYTHING.surfaces[1:4], surface(0.01, 2.0, 1.5, sag_terms=bump), *EVERYTHING.surfaces[4:]]
    system = dataclasses.replace(EVERYTHING, surfaces=(EVERYTHING.surfaces[0], *surfaces))
    compiled, eager = both(lambda: trace_lens(system, some_rays(), system.wavelengths[0]))
    assert_same_rays(compiled, eager, 1e-12)


def test_transforms_other_dtypes_and_the_switch_leave_it_to_torch():
    rays, number = some_rays(4), scalar(1.0)
    with trace_engine("compiled"):
        assert uses_compiled(rays, number, 1)
        assert not uses_compiled(Rays(*(x.to("meta") for x in leaves_of_rays(rays))), number, 1)
        assert not uses_compiled(dataclasses.replace(rays, position=rays.position.float()), number, 1)
        seen = []
        torch.func.vmap(lambda x: seen.append(uses_compiled(dataclasses.replace(rays, position=x), number, 1)) or x)(
            rays.position[None]
        )
        assert seen == [False]
    with trace_engine("eager"):
        assert engine() == "eager"
        assert not uses_compiled(rays, number, 10**9)
        assert prepare() == "eager"
    with pytest.raises(ValueError, match=r"'quick': .*auto, eager, compiled"), trace_engine("quick"):
        pass


PROBE = """
import os, raytrace, torch
from raytrace.tracing.trace import trace_lens
from raytrace.tracing import compiler as library
from raytrace.tracing.compiled import uses_compiled
from raytrace.system.rays import Rays, start
library.FLAGS = tuple(flag for flag in library.FLAGS if flag != "-O3")  # compiled in 2 s instead of 14 s
lens = raytrace.read_lens({lens!r})
count = {count}
like = torch.zeros(3, count, dtype=torch.float64)
like[2] = 1.0
rays = Rays(0 * like, like, torch.ones(count, dtype=torch.bool))
for compiler in {compilers}:
    child = os.fork()  # nothing is compiled or chosen yet
    if child:
        assert os.waitpid(child, 0)[1] == 0
        continue
    if compiler:
        os.environ["CXX"] = compiler
    with torch.no_grad():
        trace_lens(lens, rays, lens.wavelengths[0])
    print(uses_compiled(Rays(like[:, :1], like[:, :1], rays.valid[:1]), lens.wavelengths, 1))
    break
"""


def probe(folder: Path, count: int, compilers: tuple[str, ...] = ("",)) -> subprocess.CompletedProcess:
    """Trace so many rays in a process that keeps compiled code in a folder of its own; print which trace is chosen.

    compilers: values of CXX, one after the other; empty: of this machine.
    """
    names = {"RAYTRACE_CACHE": str(folder), "PYTHONPATH": os.pathsep.join(sys.path)}
    own = {k: v for k, v in os.environ.items() if k not in ("RAYTRACE_TRACE", "CXX")} | names
    script = PROBE.format(lens=str(shipped("lenses") / "double_gauss.zmx"), count=count, compilers=compilers)
    done = subprocess.run([sys.executable, "-c", script], env=own, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    return done


@pytest.mark.slow
def test_it_is_compiled_once_for_work_that_is_worth_it(tmp_path):
    """A small batch compiles nothing; a large one does, says so, and the next process finds it on disk."""
    assert probe(tmp_path, 100).stdout == "False\n"
    assert not list(tmp_path.iterdir())
    first = probe(tmp_path, 2**20)
    (kept,) = tmp_path.iterdir()
    made = kept.stat().st_ino  # what is compiled anew takes its place as another file
    assert (first.stdout, kept.suffix) == ("True\n", ".so")
    assert first.stderr in ("", "raytrace: compiling the trace for this machine (once, a minute or two) …\n")
    second = probe(tmp_path, 100)
    assert (second.stdout, second.stderr) == ("True\n", "")
    assert [path.stat().st_ino for path in tmp_path.iterdir()] == [made]


@pytest.mark.slow
def test_without_a_compiler_torch_traces_and_one_line_gives_the_reason(tmp_path):
    """One line for each compiler: one that is missing, and one that fails."""
    done = probe(tmp_path, 2**20, ("no-such-compiler", "false"))
    assert done.stdout == "False\nFalse\n"
    lines = done.stderr.splitlines()
    reasons = ("no C++ compiler found (no-such-compiler)", "cannot compile the trace: exit status 1")
    for line, reason in zip(lines, reasons, strict=True):
        assert reason in line
        assert line.endswith("; tracing by torch alone")


@pytest.mark.parametrize("with_path", [True, False])
def test_rays_that_change_before_the_first_surface_are_pushed_on(with_path):
    system = read_lens("tessar")
    wavelengths = vector(0.5, 0.6)
    indices, surfaces = media(system, wavelengths[:, None]), system.surfaces[1:]
    rays = launch(system, sobol(9)[0], wavelengths=wavelengths)
    task = task_of(surfaces, rays if with_path else dataclasses.replace(rays, opl=None), indices=indices)
    position, direction, _, table = task.inputs
    generator = torch.Generator().manual_seed(1)

    def drawn(*shape):
        return torch.randn(*shape, *task.valid.shape, generator=generator, dtype=table.dtype)

    changes = 0.1 * torch.randn(2, *table.shape, generator=generator, dtype=table.dtype) * table.abs()
    turned = 0.01 * drawn(3, 2)
    turned = turned - (turned * direction[:, None]).sum(0) * direction[:, None]
    start = drawn(3, 2), turned, drawn(2) if with_path else None
    found, by_torch = both(lambda: pushed(surfaces, task, changes, start))
    for one, other in zip(found, by_torch, strict=True):
        assert one is other or torch.allclose(one.double(), other.double(), rtol=1e-10, atol=1e-10)
    step = 1e-6
    own, between, gap = with_numbers(task.structure, surfaces, table + step * changes[1], (3, 2))
    moved = Rays(position + step * start[0][:, 1], direction + step * start[1][:, 1], task.valid, rays.opl)
    end = trace_surfaces(own, moved, indices=between, gap=gap)
    assert_close((end.position - found.position)[:2] / step, found.by_position[:2, 1], rtol=1e-4, atol=1e-3)
