"""Streaming: the same numbers as with all rays at once, for any chunk, within the memory granted."""

import dataclasses
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from problems import NANOMETRE, PICOMETRE, aspheric_singlet, double_gauss, fields, lens, scalar, surface, vector

import raytrace as rt
from raytrace.maths.numerics import to
from raytrace.maths.sampling import SAMPLINGS, grid, sobol, with_rim
from raytrace.psf_models import DRT, Execution, Gaussian, Wave, psf
from raytrace.psf_models.drt import kernels_of_rays, stream_kernels
from raytrace.system.lens import with_object_distance
from raytrace.system.surface import Aperture
from raytrace.tracing import streaming
from raytrace.tracing.launch import launch
from raytrace.tracing.scene import scene
from raytrace.tracing.spot import EmptySpot, spot_of
from raytrace.tracing.streaming import (
    Moments,
    chunk_size,
    mean_square_gradient,
    merge,
    moments,
    pupil_chunks,
    shot,
    stream_gradient,
    stream_spot,
    stream_spots,
)
from raytrace.tracing.trace import trace_lens

LIKE = torch.zeros((), dtype=torch.float64)
SMALL = 512 * 768  # bytes: chunks of 512 rays
FEW = SMALL + 10**6  # and of a few kernels
COLOURS = vector(0.48, 0.65)


def clipped(**others):
    """The double Gauss with a rim that cuts beams off the axis, as tight as it must be to lose rays of the axis."""
    found = double_gauss(**others)
    return found.replace(1, apertures=(Aperture("circular", (0.0, 15.0)),))


# ---------------------------------------------------------------- points


@pytest.mark.parametrize("size", [1, 256, 4096])
@pytest.mark.parametrize("sampling", ["sobol", "random"])
def test_points_are_those_of_the_pupil_whatever_the_chunk(sampling, size):
    count = 700 if size == 1 else 5000
    chunks = list(pupil_chunks(count, size, sampling=sampling, seed=3, like=LIKE, cut=333))
    assert max(chunk.shape[1] for chunk in chunks) <= size
    assert 333 in torch.tensor([chunk.shape[1] for chunk in chunks]).cumsum(0)
    points = SAMPLINGS[sampling][0](count, seed=3)[0]
    found = torch.cat(chunks, 1)
    assert torch.equal(found[:, 1:], points[:, 1:])
    # The engine of torch gives its first point in float32.
    assert float((found[:, 0] - points[:, 0]).abs().max()) < 1e-7


def test_points_far_into_the_sequence():
    """The block at 3·2²⁰ by one XOR, against the engine run up to there."""
    first = 3 << 20
    table, steps = streaming._sobol_table(64, 5, None)
    bits = table ^ streaming._sobol_place(first, steps, table)
    engine = torch.quasirandom.SobolEngine(2, scramble=True, seed=5).fast_forward(first)
    assert torch.equal(bits.T * 2.0**-30, engine.draw(64, dtype=torch.float32))


def test_points_after_the_last_of_the_sequence_are_those_of_the_next_seed(monkeypatch):
    monkeypatch.setattr(streaming, "_SOBOL_POINTS", 1024)
    found = torch.cat(list(pupil_chunks(1500, 256, seed=7, like=LIKE, cut=1100)), 1)
    assert found.shape == (2, 1500)
    assert torch.equal(found[:, 1025:], sobol(476, seed=8)[0][:, 1:])


def test_other_samplings_are_refused():
    with pytest.raises(ValueError, match=r"'gauss'.*sobol or random"):
        next(pupil_chunks(10, 256, sampling="gauss", like=LIKE))


# ---------------------------------------------------------------- rays

FACTORS = torch.tensor([[0.0, 0.1], [0.0, -0.2], [0.1, 0.3], [0.0, 0.2], [0.0, 30.0]], dtype=torch.float64)
SCENES = {
    "infinity": double_gauss(),
    "vignetting factors": double_gauss(field=fields("angle", (0.0, 14.0), vignetting=FACTORS)),
    "near object": double_gauss(object_distance=250.0),
    "very far object": double_gauss(object_distance=1e12),
    "virtual object": double_gauss(object_distance=-3000.0),
    "image height": double_gauss(field=fields("paraxial_image_height", (0.0, 20.0)), object_distance=4000.0),
    "telecentric": lens(
        [surface(0.02, 4.0, 1.5), surface(-0.02, 50.0)],
        object_distance=60.0,
        aperture=("object_na", 0.1),
        field=fields("object_height", (0.0, 2.0), telecentric=True),
    ),
    "aimed": double_gauss(ray_aiming="real"),
}


@pytest.mark.parametrize("name", SCENES)
def test_rays_are_those_of_launch(name):
    system = SCENES[name]
    points = sobol(200)[0]
    rays = launch(system, points)
    points_of_field = torch.stack([system.fields.x, system.fields.y]).unbind(1)
    for f, field in enumerate(points_of_field):
        found = streaming.start(shot(system, field, scalar(0.55)), points)
        assert bool(found.valid.all())
        # On the same lines: starting points may differ along them, and by the rounding of the larger of both.
        assert float((found.direction - rays.direction[:, f, 0]).abs().max()) < 2e-15
        apart = found.position - rays.position[:, f, 0]
        size = 1 + float(rays.position[:, f, 0].abs().max())
        assert float(torch.linalg.cross(apart, found.direction, dim=0).abs().max()) < 1e-15 * size


# ---------------------------------------------------------------- moments


def test_moments_of_a_small_spot_far_from_the_axis_keep_their_digits():
    """σ = 2.6 pm at 1 m: the squares of its coordinates would need 30 digits."""
    generator = torch.Generator().manual_seed(1)
    # Units of the last place of 1000 mm.
    steps = torch.randint(-40, 40, (2, 5000), generator=generator).double()
    points = 1000 + steps * 2.0**-43
    valid = torch.ones(5000, dtype=torch.bool)
    whole = Moments(LIKE, torch.zeros(2, dtype=torch.float64), torch.zeros(3, dtype=torch.float64))
    for part in points.split(17, 1):
        whole = merge(whole, moments(part, valid[: part.shape[1]], vector(1000.0, 1000.0)))
    exact = torch.cov(steps, correction=0) * 2.0**-86
    assert float(whole.count) == 5000
    assert torch.allclose(whole.scatter / 5000, exact.flatten()[[0, 1, 3]], rtol=1e-13, atol=0)
    assert torch.allclose(whole.mean, steps.mean(1) * 2.0**-43, rtol=1e-13, atol=0)


def test_merged_moments_are_those_of_all_points():
    generator = torch.Generator().manual_seed(2)
    points = torch.randn(2, 1000, generator=generator, dtype=torch.float64) + vector(3.0, -70.0)[:, None]
    valid = torch.rand(1000, generator=generator) < 0.7
    found = merge(*(moments(points[:, p], valid[p], vector(3.0, -69.0)) for p in (slice(0, 10), slice(10, None))))
    kept = points[:, valid]
    assert float(found.count) == kept.shape[1]
    assert torch.allclose(found.mean + vector(3.0, -69.0), kept.mean(1), rtol=1e-14, atol=0)
    exact = torch.cov(kept, correction=0).flatten()[[0, 1, 3]] * kept.shape[1]
    assert torch.allclose(found.scatter, exact, rtol=1e-13, atol=0)


def test_moments_of_nothing_leave_others_alone():
    nothing = moments(torch.ones(2, 5, dtype=torch.float64), torch.zeros(5, dtype=torch.bool), vector(7.0, 7.0))
    some = moments(torch.eye(2, dtype=torch.float64), torch.ones(2, dtype=torch.bool), vector(0.0, 0.0))
    for both in (merge(nothing, some), merge(some, nothing)):
        assert torch.equal(both.mean, some.mean)
        assert torch.equal(both.scatter, some.scatter)
    assert float(nothing.scatter.abs().sum()) == 0


# ---------------------------------------------------------------- spots


@pytest.mark.parametrize("distance", [float("inf"), 3000.0])
@pytest.mark.parametrize("make", [double_gauss, clipped, aspheric_singlet])
def test_spot_is_that_of_all_rays_at_once(make, distance):
    system = with_object_distance(make(), distance)
    points, weights = sobol(3000, seed=4)
    whole = spot_of(trace_lens(system, launch(system, points, wavelengths=COLOURS), COLOURS[:, None]), weights)
    found = stream_spot(
        system, 3000, seed=4, wavelengths=COLOURS, max_bytes=SMALL * (9 if make is aspheric_singlet else 1)
    )
    assert torch.equal(found.rays, whole.rays)
    assert found.launched == 3000
    if make is clipped:
        assert int(found.rays.min()) < 3000
    # The first point differs by 1e-8 of the pupil, see above.
    assert float((found.centroid - whole.centroid).abs().max()) < PICOMETRE
    for name in ("mean_square_radius", "rms_radius", "geometric_radius"):
        assert torch.allclose(getattr(found, name), getattr(whole, name), rtol=1e-9, atol=0), name
    assert torch.allclose(found.geometric_bound, found.geometric_radius, rtol=1e-12, atol=0)


def test_size_of_the_chunk_changes_rounding_alone():
    one, other = (stream_spots(clipped(), 10_000, wavelengths=COLOURS, max_bytes=b) for b in (2 * SMALL, 32 * SMALL))
    for a, b in zip(one, other, strict=True):
        assert torch.equal(a.rays, b.rays)
        assert float((a.centroid - b.centroid).abs().max()) < 1e-3 * PICOMETRE
        for name in ("rms_radius", "geometric_radius", "geometric_bound"):
            assert torch.allclose(getattr(a, name), getattr(b, name), rtol=1e-12, atol=0), name


def test_spot_of_all_wavelengths():
    weights = vector(1.0, 3.0)
    points, equal = sobol(2000)
    system = double_gauss()
    rays = trace_lens(system, launch(system, points, wavelengths=COLOURS), COLOURS[:, None])
    found = stream_spots(system, 2000, wavelengths=COLOURS, wavelength_weights=weights, max_bytes=SMALL)[1]
    whole = spot_of(dataclasses.replace(rays, position=rays.position.flatten(2), valid=rays.valid.flatten(1)),
                 (weights[:, None] * equal).flatten())  # fmt: skip
    assert float((found.centroid - whole.centroid).abs().max()) < PICOMETRE
    assert torch.allclose(found.rms_radius, whole.rms_radius, rtol=1e-9, atol=0)
    assert torch.allclose(found.geometric_radius, whole.geometric_radius, rtol=1e-9, atol=0)
    assert found.rays.tolist() == [4000] * 3


def test_largest_distance_of_many_rays_lies_between_the_bounds_reported(monkeypatch):
    monkeypatch.setattr(streaming, "_PILOT", 64)
    system = double_gauss()
    points, weights = sobol(5000)
    exact = spot_of(trace_lens(system, launch(system, points), system.wavelengths[:, None]), weights).geometric_radius
    found = stream_spot(system, 5000, max_bytes=SMALL)
    assert bool((found.geometric_radius <= exact * (1 + 1e-9)).all())
    assert bool((exact <= found.geometric_bound * (1 + 1e-9)).all())
    assert bool((found.geometric_bound - found.geometric_radius < 0.05 * exact).all())


def test_rim_counts_for_the_largest_distance_alone():
    system = double_gauss()
    points, weights = with_rim(*sobol(500))
    whole = spot_of(trace_lens(system, launch(system, points), system.wavelengths[:, None]), weights)
    found = stream_spot(system, 500, rim=72)
    assert torch.allclose(found.geometric_radius, whole.geometric_radius, rtol=1e-9, atol=0)
    assert torch.allclose(found.rms_radius, whole.rms_radius, rtol=1e-9, atol=0)
    assert found.rays.tolist() == [[500]] * 3


def test_spot_of_no_rays_is_empty():
    system = clipped(field=fields("angle", (60.0,)))
    found = stream_spot(system, 300)
    assert found.rays.tolist() == [[0]]
    for name in ("rms_radius", "geometric_radius", "geometric_bound", "centroid", "covariance", "mean_square_radius"):
        assert getattr(found, name).isnan().all(), name
    with pytest.raises(EmptySpot, match="no ray reaches 1 of 1 spots"):
        stream_spots(system, 300, empty="error")


def test_float32_rays_are_summed_in_float64():
    system = double_gauss()
    exact, found = stream_spot(system, 20_000), stream_spot(to(system, dtype=torch.float32), 20_000)
    assert found.rms_radius.dtype == torch.float64
    # float32 has 6e-8 of a height of 25 mm for a hit: 1.5 nm.
    assert float((found.centroid - exact.centroid).abs().max()) < 10 * NANOMETRE
    assert float((found.rms_radius - exact.rms_radius).abs().max()) < 10 * NANOMETRE


def test_progress_counts_every_ray():
    counts = []
    stream_spot(double_gauss(), 3000, wavelengths=COLOURS, max_bytes=SMALL, progress=counts.append)
    assert sum(counts) == 3000 * 6
    assert max(counts) <= 512


# ---------------------------------------------------------------- PSFs


@pytest.mark.parametrize("width", [0.25, 0.0])
def test_psf_is_that_of_all_rays_at_once(width):
    system = clipped()
    pixels = grid(0.05, (15, 21), centre=vector(0.0, 25.0))
    batch = {"fields": vector(0.0, 14.0).expand(2, 2) * vector(0.0, 1.0)[:, None], "wavelengths": COLOURS}
    batch |= {"object_distances": vector(float("inf"), 3000.0), "wavelength_weights": vector(1.0, 2.0)}
    if width:
        whole, found = (
            psf(system, DRT(rays=1501), grid=pixels, execution=Execution(max_bytes=most), **batch)
            for most in (None, FEW)
        )
        assert float((found.kernel - whole.kernel).abs().max()) < 1e-9
        assert torch.allclose(found.error, whole.error, rtol=1e-6, atol=0, equal_nan=True)
        assert float((found.centroid - whole.centroid).abs().max()) < PICOMETRE
        assert torch.allclose(found.covariance, whole.covariance, rtol=1e-8, atol=1e-11)
        assert torch.allclose(found.arrived, whole.arrived, rtol=1e-12)
        assert torch.equal(found.grid.centre, whole.grid.centre)
        assert float(found.energy[:, 1].min()) > 0.05
    for distance in batch["object_distances"].split(1):
        one = scene(system, batch["fields"], distance, COLOURS)
        found, half = stream_kernels(one, pixels, 1501, max_bytes=FEW, width=width)
        whole, first = (kernels_of_rays(one, pixels, rays=n, width=width) for n in (1501, 750))
        assert float((found.kernel - whole.kernel).abs().max()) < 1e-9
        assert float((half.kernel - first.kernel).abs().max()) < 1e-9


def test_energy_of_a_psf_is_accounted_for():
    """A window that holds all that arrives holds `arrived`, which is the share of rays that were not lost."""
    system = clipped(field=fields("angle", (10.0,)))
    centroid = stream_spot(system, 2000).centroid[:, 0]
    options = {"execution": Execution(max_bytes=FEW), "center": "axis"}
    found = psf(system, DRT(rays=2000), grid=grid(0.5, 9, centre=centroid[:, None]), **options)
    rays = stream_spot(system, 2000).rays
    assert float(found.arrived) == pytest.approx(float(rays) / 2000, rel=1e-14)
    assert float(found.energy) == pytest.approx(float(found.arrived), rel=1e-12)
    assert 0.3 < float(found.arrived) < 0.99
    narrow = psf(system, DRT(rays=2000), grid=grid(0.005, 3, centre=centroid[:, None]), **options)
    assert float(narrow.energy) < 0.5 * float(narrow.arrived)


@pytest.mark.parametrize("model", [Gaussian(order=8), DRT(order=2), Wave(order=0), DRT(rays=500)])
@pytest.mark.parametrize("x", [0.0, 3.0])
def test_the_light_outside_a_window_is_what_arrives_elsewhere(model, x):
    """Of a lens that clips the beam; x = 0: the light is symmetric, and half of it is traced."""
    options = {"fields": vector(x, 6.0)[:, None], "object_distances": vector(25e3), "wavelengths": vector(0.55)}
    narrow = psf(clipped(), model, pixel=0.02, size=5, **options)
    if not isinstance(model, Wave):
        whole = psf(clipped(), model, pixel=1.0, size=21, **options)
        rounding = 2e-4 if isinstance(model, DRT) and model.order else 1e-9  # cells of another width
        assert float(narrow.arrived) == pytest.approx(float(whole.energy), rel=rounding)
    clear = psf(clipped(), DRT(rays=20_000), pixel=1.0, size=21, **options).energy
    assert float(narrow.arrived) == pytest.approx(float(clear), abs=1e-2 if model.rays else 1e-3)
    assert float(narrow.energy_outside) == pytest.approx(1 - float(narrow.energy / narrow.arrived), abs=1e-12)
    assert 0.01 < float(narrow.energy_outside) < 0.9


def test_psf_counts_vignetting_factors():
    system = SCENES["vignetting factors"]
    pixels = grid(0.5, 9, centre=stream_spot(system, 500).centroid[..., 0][:, None])
    options = {"grid": pixels, "object_distances": vector(float("inf")), "center": "axis"}
    share = torch.tensor([[0.9, 0.7 * 0.8]], dtype=torch.float64)
    for most in (None, FEW):
        found = psf(system, DRT(rays=500), execution=Execution(max_bytes=most), **options)
        assert torch.allclose(found.arrived, share, rtol=1e-12)
        assert torch.allclose(found.energy, share, rtol=1e-12)


# ---------------------------------------------------------------- gradients


def bent(curvatures, scale):
    """The clipped double Gauss of these curvatures, its first thicknesses made from one number."""
    system, given = clipped(), iter(curvatures)
    surfaces = [s if s.curvature is None else dataclasses.replace(s, curvature=next(given)) for s in system.surfaces]
    surfaces[1] = dataclasses.replace(surfaces[1], thickness=surfaces[1].thickness * scale**2)
    return dataclasses.replace(system, surfaces=tuple(surfaces))


@pytest.mark.parametrize("distance", [float("inf"), 2000.0])
def test_gradient_is_that_of_all_rays_at_once(distance):
    curvatures = [s.curvature.clone().requires_grad_() for s in double_gauss().surfaces if s.curvature is not None]
    scale, idle = scalar(1.01).requires_grad_(), scalar(3.0).requires_grad_()
    leaves = [*curvatures, scale, idle]
    system = with_object_distance(bent(curvatures, scale), distance)
    points, weights = sobol(1000)
    rays = trace_lens(system, launch(system, points, wavelengths=COLOURS), COLOURS[:, None])
    merit = spot_of(rays, weights).mean_square_radius.mean()
    exact = torch.autograd.grad(merit, leaves[:-1], retain_graph=True)
    value, found = mean_square_gradient(system, leaves, 1000, wavelengths=COLOURS, max_bytes=256 * 10_000)
    assert float(value) == pytest.approx(float(merit.detach()), rel=1e-9)
    for one, other in zip(found[:-1], exact, strict=True):
        assert float(one) == pytest.approx(float(other), rel=1e-8)
    assert float(found[-1]) == 0


def test_a_spot_that_no_ray_reaches_makes_the_mean_nan_and_no_derivative():
    curvatures = [s.curvature.clone().requires_grad_() for s in double_gauss().surfaces if s.curvature is not None]
    system = bent(curvatures, scalar(1.0))
    both, one = vector(0.0, 0.0, 0.0, 85.0).reshape(2, 2), vector(0.0, 0.0)[:, None]
    assert stream_spot(system, 300, fields=both).rays[1].tolist() == [0]
    value, found = mean_square_gradient(system, curvatures, 300, fields=both)
    alone = mean_square_gradient(system, curvatures, 300, fields=one)[1]
    assert value.isnan()
    assert all(float(2 * a) == pytest.approx(float(b), rel=1e-12) for a, b in zip(found, alone, strict=True))
    weighed = mean_square_gradient(system, curvatures, 300, fields=both, weights=vector(1.0, 0.0)[:, None])[0]
    assert weighed.isfinite()
    with pytest.raises(EmptySpot):
        mean_square_gradient(system, curvatures, 300, fields=both, empty="error")


def test_the_public_gradient_takes_plain_numbers():
    curvatures = [s.curvature.clone().requires_grad_() for s in double_gauss().surfaces if s.curvature is not None]
    system = bent(curvatures, scalar(1.0))
    plain = rt.tracing.mean_square_gradient(system, curvatures, 300, fields=[0, 7.0], wavelengths=[0.55])
    given = vector(0.0, 0.0, 0.0, 7.0).reshape(2, 2), vector(0.55)
    tensors = rt.tracing.mean_square_gradient(system, curvatures, 300, fields=given[0], wavelengths=given[1])
    assert plain[0] == tensors[0]
    assert plain[1] == tensors[1]


def test_gradient_of_a_sum_over_chunks():
    """d/da Σ (a x)² = 2 a Σ x², for any chunks; a leaf that is not used has derivative 0."""
    a, unused = scalar(1.5).requires_grad_(), vector(1.0, 2.0).requires_grad_()
    numbers = torch.arange(10.0, dtype=torch.float64)
    total, (slope, zero) = stream_gradient(lambda x: ((a * x) ** 2).sum(), [a, unused], iter(numbers.split(3)))
    assert float(total) == pytest.approx(2.25 * 285, rel=1e-15)
    assert float(slope) == pytest.approx(3 * 285, rel=1e-15)
    assert zero.tolist() == [0.0, 0.0]


# ---------------------------------------------------------------- memory


def test_too_small_a_budget_is_refused():
    with pytest.raises(ValueError, match=r"max_bytes 1000 .*196608 or more"):
        stream_spot(double_gauss(), 10, max_bytes=1000)
    assert stream_spot(double_gauss(), 10, max_bytes=196608).launched == 10


def test_chunk_shrinks_with_the_budget_and_the_stored_rays():
    of_lens = shot(double_gauss(), vector(0.0, 0.0), scalar(0.55))
    sizes = [chunk_size(of_lens, b) for b in (2 * 10**5, 10**6, 10**7, 10**9)]
    assert sizes == sorted(sizes)
    assert sizes[0] == 256
    assert sizes[-1] == streaming._CHUNK["cpu"]
    assert chunk_size(of_lens, 10**7, kept=9 * 10**6) == chunk_size(of_lens, 10**6)


MEMORY = """
import ctypes, resource, sys, torch
sys.path.insert(0, "tests")
from problems import double_gauss, vector
from problems import aspheric_singlet
from raytrace.tracing import streaming
from raytrace.maths.sampling import grid
from raytrace.psf_models import DRT, Execution, psf
from raytrace.tracing.streaming import mean_square_gradient
import dataclasses

def peak():
    with open("/proc/self/status") as status:
        return next(1024 * int(line.split()[1]) for line in status if line.startswith("VmHWM"))

def growth(run, rays, max_bytes):
    run(300, max_bytes)
    ctypes.CDLL(None).malloc_trim(0)
    with open("/proc/self/clear_refs", "w") as peaks:
        peaks.write("5")
    before = peak()
    run(rays, max_bytes)
    return (peak() - before) / max_bytes

gauss, bulge = double_gauss(), aspheric_singlet()
curvature = bulge.surfaces[1].curvature.clone().requires_grad_()
bent = bulge.replace(1, curvature=curvature)
field = vector(0.0, 10.0)[:, None]
aim = {"fields": field, "ray_aiming": "real"}
run = lambda n, b: streaming.stream_spot(gauss, n, fields=field[:, :1], max_bytes=b)
print(growth(run, RAYS, 4 * 10**6))
# Chunks as large as the budget allows, not as the caches like them: the bytes of a ray are what is measured.
streaming._CHUNK["cpu"] = 2**22
print(growth(run, 2**16, 2**16 * 768))
print(growth(lambda n, b: mean_square_gradient(bent, [curvature], n, max_bytes=b), 2**13, 2**13 * 9216))
if RAYS > 10**7:
    pixels = grid(0.005, 21)
    run = lambda n, b: psf(gauss, DRT(rays=n), grid=pixels, fields=field, execution=Execution(max_bytes=b))
    print(growth(run, 2**17, 2**17 * 768))
    print(growth(lambda n, b: streaming.stream_spot(gauss, n, max_bytes=b, **aim), 2**15, 2**15 * 8192))
"""


def memory(rays: int) -> list[float]:
    """Growth of the resident memory over the budget, at its peak, of streams of every kind; eager, which takes most."""
    done = subprocess.run(
        [sys.executable, "-c", MEMORY.replace("RAYS", str(rays))],
        cwd=Path(__file__).parents[1],
        env=os.environ | {"RAYTRACE_TRACE": "eager"},
        capture_output=True,
        text=True,
        timeout=3000,
    )
    assert done.returncode == 0, done.stderr
    return [float(line) for line in done.stdout.split()]


@pytest.mark.skipif(not Path("/proc/self/clear_refs").exists(), reason="reads the peak of memory where Linux has it")
@pytest.mark.slow
@pytest.mark.parametrize("rays", [300_000, 100_000_000])
def test_memory_stays_within_the_budget(rays):
    found = memory(rays)
    # Were all rays kept, the coordinates of the first stream alone would take 3.6 times its budget.
    assert len(found) == (3 if rays < 10**7 else 5)
    assert max(found) < 1, found


# ---------------------------------------------------------------- command


def test_command_gives_the_spot_of_few_rays(command):
    common = ("spot", "cooke_triplet", "--seed", 2)
    few = json.loads(command(*common, "--sampling", "sobol", "--points", 3000, "--json")[1])
    many = json.loads(command(*common, "--rays", "3e3", "--max-bytes", "1MB", "--json")[1])
    for one, other in zip(few["results"], many["results"], strict=True):
        assert one["field"] == other["field"]
        assert one["centroid"] == pytest.approx(other["centroid"], abs=PICOMETRE)
        assert one["rms_radius_um"] == pytest.approx(other["rms_radius_um"], rel=1e-9)
        assert one["geometric_radius_um"] == pytest.approx(other["geometric_radius_um"], rel=1e-9)
        assert other["launched"] == 3000
    lines = [
        command(*common, *a)[1].splitlines() for a in (("--sampling", "sobol", "--points", 3000), ("--rays", 3000))
    ]
    assert [line.split() for line in lines[0]] == [line.split() for line in lines[1]]


def test_command_shows_a_progress_bar(command, monkeypatch):
    monkeypatch.setattr("raytrace.cli.progress._is_terminal", lambda: True)
    code, out, err = command("spot", "double_gauss", "--rays", 2000, "--json")
    assert code == 0
    json.loads(out)
    assert "ray/s" in err
    assert "6.00k" in err  # three fields


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--rays", 100, "--points", 3), "--rays and --points exclude each other"),
        (("--rays", 100, "--sampling", "square"), "sobol (its default) or random, not square"),
        (("--rays", 100, "--plot", "spot.png"), "--plot needs the rays"),
        (("--rays", 100, "--max-bytes", "1kB"), "max_bytes 1000 is too little"),
        (("--rays", "1.5"), "not a whole number above 0"),
        (("--rays", "0"), "not a whole number above 0"),
        (("--rays", "100", "--max-bytes", "many"), "not a number of bytes, as 200MB"),
    ],
)
def test_command_refuses(command, arguments, said):
    code, out, err = command("spot", "double_gauss", *arguments)
    assert code in (1, 2)
    assert out == ""
    assert said in err


def test_interrupted_command_prints_no_result(command, monkeypatch):
    traced = []

    def until_the_third(*given):
        traced.append(given)
        if len(traced) == 3:
            raise KeyboardInterrupt
        return original(*given)

    original = streaming.hits
    monkeypatch.setattr(streaming, "hits", until_the_third)
    code, out, err = command("spot", "double_gauss", "--rays", 10_000)
    assert (code, out) == (130, "")
    assert "interrupted" in err
