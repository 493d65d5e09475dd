"""A lens on a GPU: every analysis, PSF model and camera gives the numbers and the derivatives of the CPU."""

import dataclasses

import pytest
import torch
from torch import nn

import raytrace as rt
from raytrace.imaging.pictures import dead_leaves
from raytrace.maths.sampling import hexapolar
from raytrace.tracing.launch import launch
from raytrace.tracing.trace import trace_lens

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
LENSES = ("cooke_triplet", "double_gauss", "phone")


def numbers_of(thing, seen=None):
    """All floating-point tensors of a result, in order."""
    if isinstance(thing, torch.Tensor):
        return [thing] if thing.is_floating_point() else []
    if isinstance(thing, rt.Lens):
        return []
    if isinstance(thing, dict):
        thing = thing.values()
    elif dataclasses.is_dataclass(thing):
        thing = [getattr(thing, field.name) for field in dataclasses.fields(thing)]
    elif not isinstance(thing, (tuple, list)):
        return []
    return [number for part in thing for number in numbers_of(part)]


def both(make, name):
    """What a function of a lens returns on the CPU and on the GPU."""
    lens = rt.read_lens(name)
    return [make(rt.to(lens, device=device)) for device in ("cpu", "cuda")]


def agree(here, there, rtol=1e-9, atol=1e-11):
    ours, theirs = numbers_of(here), numbers_of(there)
    assert len(ours) == len(theirs) > 0
    for one, other in zip(ours, theirs, strict=True):
        scale = one[one.isfinite()].abs().max() if bool(one.isfinite().any()) else 1.0
        torch.testing.assert_close(other.cpu(), one, rtol=rtol, atol=atol + rtol * float(scale), equal_nan=True)


ANALYSES = {
    "first_order": rt.first_order,
    "spot": rt.spot,
    "spot of many": lambda lens: rt.spot(lens, rays=100_000),
    "rays": lambda lens: rt.tracing.rays(lens, fields=[0, 5]),
    "base_ray": rt.base_ray,
    "trace": lambda lens: rt.trace(lens, fields=[5]),
    "focus": lambda lens: rt.focus(lens).lens.surfaces[-2].thickness,
    "wavefront": rt.wavefront,
    "zernike": lambda lens: rt.wavefront(lens, terms=15),
    "mtf": rt.mtf,
    "mtf geometric": lambda lens: rt.mtf(lens, [30.0], geometric=True),
    "mtf through focus": lambda lens: rt.mtf(lens, [30.0], through_focus=0.1),
    "seidel": rt.seidel,
    "distortion": rt.distortion,
    "distortion_grid": rt.distortion_grid,
    "encircled_energy": rt.encircled_energy,
    "field_curvature": rt.field_curvature,
    "incidence": rt.incidence,
    "lateral_colour": rt.lateral_colour,
    "chromatic_focal_shift": rt.chromatic_focal_shift,
    "longitudinal_aberration": rt.longitudinal_aberration,
    "opd_fan": rt.opd_fan,
    "ray_fan": rt.ray_fan,
    "relative_illumination": rt.relative_illumination,
    "rms_over_field": rt.rms_over_field,
    "evaluate": lambda lens: rt.evaluate(lens, merit=rt.optimization.DefaultMerit()),
    "layout": rt.layout,
}


@pytest.mark.parametrize("name", LENSES)
@pytest.mark.parametrize("analysis", ANALYSES)
def test_analysis(analysis, name):
    if analysis in ("lateral_colour", "chromatic_focal_shift") and len(rt.read_lens(name).wavelengths) == 1:
        pytest.skip("a lens of one wavelength has no colours to compare")
    agree(*both(ANALYSES[analysis], name), rtol=1e-7 if analysis == "focus" else 1e-8)


@pytest.mark.parametrize(
    "analysis", ["spot", "mtf", "wavefront", "layout", "seidel", "ray_fan", "relative_illumination"]
)
def test_figure(analysis, tmp_path):
    result = ANALYSES[analysis](rt.to(rt.read_lens("double_gauss"), device="cuda"))
    result.plot(tmp_path / "figure.png")
    assert (tmp_path / "figure.png").stat().st_size > 1000
    result.save(tmp_path / "numbers.json")
    assert len(str(result)) > 20


def with_leaf(lens):
    k = next(k for k, surface in enumerate(lens.surfaces) if surface.curvature is not None)
    leaf = lens.surfaces[k].curvature.detach().clone().requires_grad_()
    return lens.replace(k, curvature=leaf), leaf


@pytest.mark.parametrize("model", ["paraxial", "fourier", "gaussian", "drt", "wave"])
@pytest.mark.parametrize("name", LENSES)
def test_psf_and_its_derivative(model, name):
    def make(lens):
        changed, leaf = with_leaf(lens)
        result = rt.psf(changed, model, fields=[0.0, 5.0], pixel=0.004, size=33)
        (slope,) = torch.autograd.grad(result.kernel[..., 16, 16].sum(), leaf)
        return result.kernel.detach(), slope

    agree(*both(make, name), rtol=1e-6)


@pytest.mark.parametrize("name", LENSES)
@pytest.mark.parametrize("of", ["spot", "wavefront", "mtf", "first_order"])
def test_derivative(of, name):
    merits = {
        "spot": lambda lens: rt.spot(lens).mean_square_radius.sum(),
        "wavefront": lambda lens: rt.wavefront(lens).rms.sum(),
        "mtf": lambda lens: rt.mtf(lens, [30.0], geometric=True).tangential.sum(),
        "first_order": lambda lens: rt.first_order(lens).effective_focal_length.sum(),
    }

    def make(lens):
        changed, leaf = with_leaf(lens)
        return torch.autograd.grad(merits[of](changed), leaf)[0]

    agree(*both(make, name), rtol=1e-7)


@pytest.mark.parametrize("name", LENSES)
def test_streamed_gradient(name):
    def make(lens):
        changed, leaf = with_leaf(lens)
        return rt.tracing.mean_square_gradient(changed, [leaf], 200_000)

    agree(*both(make, name), rtol=1e-8)


def test_float32_trace_of_a_million_rays():
    lens = rt.to(rt.read_lens("double_gauss"), device="cuda", dtype=torch.float32)
    points = hexapolar(500, dtype=torch.float32, device="cuda")[0]
    with torch.no_grad():
        end = trace_lens(lens, launch(lens, points), lens.wavelengths[:, None])
    assert end.position.is_cuda
    assert float(end.valid.float().mean()) > 0.5


def test_optimize():
    def make(lens):
        return (
            rt.optimize(lens, merit=rt.optimization.DefaultMerit(), vary="curvature sensor", hold="efl", cycles=5)
            .lens.surfaces[1]
            .curvature
        )

    here, there = both(make, "cooke_triplet")
    assert abs(float(there) / float(here) - 1) < 1e-6


@pytest.mark.parametrize("engine", ["pupil", "radial", "fresnel", "angular_spectrum"])
def test_wave_psf(engine):
    def make(device):
        (element,) = rt.wave_optics.phase_elements("singlet", aperture=2.0)
        element = rt.to(element, device=device)
        return rt.wave_optics.wave_psf(
            element, depths=[500.0, 1000.0], wavelengths=[0.55], size=31, engine=engine
        ).kernel

    agree(make("cpu"), make("cuda"), rtol=1e-7)


@pytest.mark.parametrize("model", ["gaussian", "drt", "fourier", "paraxial"])
def test_training_step(model):
    def make(device):
        torch.manual_seed(0)
        lens = rt.to(rt.read_lens("double_gauss"), device=device)
        network = nn.Conv2d(1, 1, 5, padding=2).double()
        camera = rt.Camera(rt.Variables(lens, "curvature sensor"), network, model=model).to(device)
        images = torch.stack([torch.as_tensor(picture) for picture in dead_leaves(2, size=64, seed=1).samples])
        images = (images.double() / 255).to(device)
        distances = torch.tensor([20e3, 30e3], dtype=torch.float64, device=device)
        loss = (camera(images, distances) - camera.target(images)).square().mean()
        loss.backward()
        return [loss.detach(), *(p.grad for p in camera.parameters() if p.grad is not None)]

    agree(make("cpu"), make("cuda"), rtol=1e-6)


def test_noise_is_seeded_on_the_device():
    picture = torch.full((1, 1, 64, 64), 0.5, dtype=torch.float64, device="cuda")
    noisy = rt.imaging.add_noise(picture, 0.1, generator=torch.Generator(device="cuda").manual_seed(0))
    again = rt.imaging.add_noise(picture, 0.1, generator=torch.Generator(device="cuda").manual_seed(0))
    assert torch.equal(noisy, again)
    assert abs(float(noisy.std()) - 0.1) < 0.01
