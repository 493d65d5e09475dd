"""`rt.jacobian`: derivatives by design variables against differences, and against the gradients of torch's graph."""

import numpy as np
import pytest
import torch
from torch.testing import assert_close

import raytrace as rt
from raytrace.optimization.variables import DesignVariables, design_variables
from raytrace.system import configurations
from raytrace.system.lens import aligned, with_environment
from raytrace.tolerancing.jacobian import OF_RAYS
from raytrace.tracing.compiled import trace_engine
from raytrace.tracing.trace import trace_lens

FIELDS, PUPIL = [0.0, 6.0], rt.maths.gauss_rings(2)


def model_of(lens: rt.Lens, vary: str) -> DesignVariables:
    free = design_variables(lens, vary)
    return free


def rays_behind(lens: rt.Lens, name: str) -> torch.Tensor:
    launched = rt.tracing.rays(lens, fields=FIELDS, pupil=PUPIL)
    return OF_RAYS[name](trace_lens(aligned(lens, 3), launched, lens.wavelengths[:, None]))


def assert_differences(of, lens: rt.Lens, vary: str, derivatives: torch.Tensor, close: float = 1e-5) -> None:
    """Central differences of a function of the lens by every variable, relative to the largest of each."""
    model = model_of(lens, vary)
    for number, slope in enumerate(derivatives):
        step = np.zeros(len(model.start))
        step[number] = 1e-6 * max(abs(model.start[number]), 0.1)
        ends = [of(model.lens_at(model.start + sign * step)) for sign in (1, -1)]
        difference = (ends[0] - ends[1]) / (2 * step[number])
        scale = float(derivatives.abs().max()) * 1e-6 + float(slope.abs().max())
        assert float((difference - slope).abs().max()) <= close * scale


def assert_gradients(of, lens: rt.Lens, vary: str, close: float = 1e-11) -> None:
    """The gradient of a weighted sum of a function by torch's graph, and the same sum of the Jacobian."""
    found = rt.jacobian(lens, vary, of=of)
    view = model_of(lens, vary).views[lens.current_configuration - 1].clipping
    leaves = {at: torch.tensor(n, dtype=torch.float64, requires_grad=True) for at, n in view.stored.items()}
    value = of(view.held(leaves))
    weights = torch.rand(value.shape, generator=torch.Generator().manual_seed(4), dtype=value.dtype)
    by = torch.autograd.grad((weights * value).sum(), list(leaves.values()), allow_unused=True)
    expected = torch.stack([torch.zeros((), dtype=value.dtype) if g is None else g for g in by])
    assert_close(found.value, value.detach(), rtol=1e-12, atol=1e-14)
    sums = (weights * found.derivatives).reshape(len(by), -1).sum(-1)
    assert_close(sums, expected, rtol=close, atol=close * float(expected.abs().max()))


COOKE, GAUSS = rt.read_lens("cooke_triplet"), rt.read_lens("double_gauss")
ASPHERE = COOKE.replace(1, conic=-0.4, coefficients=[0.0, 1e-6])

KINDS = {
    "curvature and thickness": (COOKE, "curvature thickness"),
    "conic and asphere": (ASPHERE, "conic:1 a4:1 sensor"),
    "tilt and decentre": (COOKE, "tilt:3 decentre:4"),
    "glass and aperture": (COOKE, "index:1,3 abbe_number:1 aperture"),
    "temperature": (COOKE.at(temperature=35.0), "temperature pressure curvature:2"),
    "solve and pickup": (COOKE, "curvature:1-3 curvature:6=f_number(6) thickness:3=2*thickness:1"),
    "real aiming": (GAUSS.at(ray_aiming="real"), "curvature:1-3 thickness:4,5"),
    "real aiming of a tilted lens": (GAUSS.at(ray_aiming="real"), "tilt:2 decentre:9 curvature:1"),
    "clipped": (
        COOKE.replace(1, semi_diameter=7.0, apertures=(rt.system.Aperture("circular", (0.0, 7.0)),)),
        "curvature thickness",
    ),
}


@pytest.mark.parametrize(
    ("kind", "name"),
    [
        pytest.param(
            kind,
            name,
            marks=() if name == "points" or kind == "clipped" else pytest.mark.slow,
            id=f"{kind}, {name}",
        )
        for kind in KINDS
        for name in OF_RAYS
    ],
)
def test_derivatives_of_rays_are_their_differences(kind, name):
    lens, vary = KINDS[kind]
    found = rt.jacobian(lens, vary, of=name, fields=FIELDS, pupil=PUPIL)
    model = model_of(lens, vary)  # with solves as they come out, and model glasses
    assert_close(found.value, rays_behind(model.lens_at(model.start), name), rtol=0, atol=1e-12)
    assert_differences(lambda lens: rays_behind(lens, name), lens, vary, found.derivatives)


def errors_of(lens: rt.Lens) -> tuple:
    """Rows of a grade, with a sag term and a thickness that another surface takes up."""
    return tuple(rt.tolerances(lens, "index=0.0002", grade="precision"))


@pytest.mark.parametrize("aiming", ["off", pytest.param("real", marks=pytest.mark.slow)])
def test_derivatives_by_errors_are_their_differences(aiming):
    lens = COOKE.at(ray_aiming=aiming)
    rows = errors_of(lens)
    found = rt.jacobian(lens, tolerances=rows, fields=FIELDS, pupil=PUPIL)
    steps = torch.tensor([1e-3 * row.maximum for row in rows], dtype=torch.float64)
    landing = rays_behind(
        rt.tolerancing.perturbed(lens, rows, torch.cat([torch.diag(steps), -torch.diag(steps)])), "points"
    )
    plus, minus = landing.chunk(2, 1)
    difference = ((plus - minus) / (2 * steps.reshape(-1, 1, 1, 1))).movedim(1, 0)
    limits = (1e3 * steps).reshape(-1, 1, 1, 1, 1)  # mm at the limit of each error
    assert_close(limits * found.derivatives, limits * difference, rtol=1e-4, atol=1e-8)
    assert found.variables[0] == f"{rows[0].name} of {rows[0].where}"
    assert not found.numbers.any()


def test_errors_follow_the_variables():
    lens, rows = GAUSS, errors_of(GAUSS)[:3]

    def of(lens: rt.Lens) -> torch.Tensor:
        return rt.spot(lens, fields=[5.0]).whole.rms_radius

    both = rt.jacobian(lens, "curvature:1 sensor", of=of, tolerances=rows)
    variables, errors = rt.jacobian(lens, "curvature:1 sensor", of=of), rt.jacobian(lens, of=of, tolerances=rows)
    assert both.variables == (*variables.variables, *errors.variables)
    assert_close(both.derivatives, torch.cat([variables.derivatives, errors.derivatives]), rtol=1e-9, atol=1e-12)
    assert_close(both.numbers, torch.cat([variables.numbers, errors.numbers]))


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"of": "merit", "merit": "spot", "grade": "precision"}, "derivatives by design variables alone"),
        ({"tolerances": (), "grade": "high"}, "leave `grade` and `limits` out"),
        ({"vary": "temperature:3"}, "expected temperature without surfaces"),
        ({"vary": "pressure@2"}, "all configurations have the same pressure"),
    ],
)
def test_numbers_that_do_not_go_together_are_refused(options, words):
    with pytest.raises(ValueError, match=words):
        rt.jacobian(COOKE, **{"vary": "curvature", **options})


def test_a_merit_function_moves_with_the_temperature():
    lens, step = COOKE.at(temperature=35.0), 1.0
    found = rt.jacobian(lens, "temperature", of="merit", merit="wavefront")
    ends = [
        rt.jacobian(
            with_environment(lens, 35.0 + sign * step, None), "temperature", of="merit", merit="wavefront"
        ).value
        for sign in (1, -1)
    ]
    assert_close(
        found.derivatives[0],
        (ends[0] - ends[1]) / (2 * step),
        rtol=1e-3,
        atol=1e-3 * float(found.derivatives.abs().max()),
    )


@pytest.mark.parametrize("kind", ["curvature and thickness", "real aiming", "tilt and decentre"])
def test_both_engines_have_the_same_derivatives(kind):
    lens, vary = KINDS[kind]
    each = []
    for engine in ("eager", "compiled"):
        with trace_engine(engine):
            each.append(rt.jacobian(lens, vary, fields=FIELDS, pupil=PUPIL).derivatives)
    assert_close(*each, rtol=1e-10, atol=1e-10)


ANALYSES = {
    "first order": lambda lens: rt.first_order(lens).effective_focal_length,
    "spot": lambda lens: rt.spot(lens).whole.rms_radius,
    "distortion": lambda lens: rt.distortion(lens, samples=3).f_tan,
    "field curvature": lambda lens: rt.field_curvature(lens, samples=3).tangential,
    "Seidel sums": lambda lens: rt.seidel(lens).contributions,
    "paraxial kernel": lambda lens: rt.psf(lens, "paraxial", fields=[0.0], size=11).kernel,
    "Gaussian kernel": lambda lens: rt.psf(lens, "gaussian", fields=[5.0], size=11).kernel,
    "geometric MTF": lambda lens: rt.mtf(lens, frequencies=[20.0], geometric=True).tangential,
    "focus": lambda lens: rt.focus(lens).sensor_distance,
    "a number of the lens": lambda lens: 2 * lens.surfaces[1].curvature,
}
SLOW = {
    "wavefront": lambda lens: rt.wavefront(lens, fields=[5.0]).opd,
    "Strehl ratio": lambda lens: rt.wavefront(lens, fields=[5.0]).strehl,
    "DRT kernel": lambda lens: rt.psf(lens, "drt", fields=[5.0], size=11).kernel,
    "wave kernel": lambda lens: rt.psf(lens, "wave", fields=[5.0], size=11).kernel,
    "Fourier kernel": lambda lens: rt.psf(lens, "fourier", fields=[0.0], size=11).kernel,
    "MTF": lambda lens: rt.mtf(lens, fields=[5.0], frequencies=[20.0]).tangential,
    "relative illumination": lambda lens: rt.relative_illumination(lens, samples=3).illumination,
}


@pytest.mark.parametrize("name", [*ANALYSES, *(pytest.param(name, marks=pytest.mark.slow) for name in SLOW)])
def test_derivatives_of_an_analysis_are_its_gradients(name):
    of = (ANALYSES | SLOW)[name]
    assert_gradients(lambda lens: of(lens).nan_to_num(), COOKE, "curvature:1,2,6 thickness:6")


def test_residuals_of_a_merit_function_have_the_jacobian_of_the_optimiser():
    found = rt.jacobian(COOKE, "curvature", of="merit", merit="spot")
    assert_close(found.value.norm(), rt.evaluate(COOKE, merit="spot").merit, rtol=1e-12, atol=0)
    step = 1e-7
    moved = [
        rt.jacobian(
            COOKE.replace(1, curvature=COOKE.surfaces[1].curvature + sign * step), "curvature", of="merit", merit="spot"
        )
        for sign in (1, -1)
    ]
    difference = (moved[0].value - moved[1].value) / (2 * step)
    assert_close(found.derivatives[0], difference, rtol=1e-4, atol=1e-4 * float(difference.abs().max()))


def test_the_result_prints_and_is_a_document():
    found = rt.jacobian(COOKE, "curvature:1 sensor", fields=FIELDS)
    assert found.variables == ("curvature_1", "thickness_7")
    assert found.derivatives.shape == (2, 2, 2, 3, 144)
    text = str(found)
    assert "curvature_1" in text
    assert "landing points" in text
    assert found.to_frame()["variable"].tolist() == ["curvature_1", "thickness_7"]
    assert np.asarray(found.document()["derivatives"]).shape == (2, 2, 2, 3, 144)


def test_the_landing_points_are_named_as_of_optimize():
    points, former = (rt.jacobian(COOKE, "curvature:1", of=of, fields=[0.0]) for of in ("points", "landing points"))
    assert torch.equal(points.derivatives, former.derivatives)
    with pytest.raises(ValueError, match="expected points, directions, paths, merit or a function"):
        rt.jacobian(COOKE, "curvature:1", of="spots")


def test_a_quantity_without_derivatives_is_reported():
    with pytest.warns(rt.RaytraceWarning, match="carries no derivatives"):
        found = rt.jacobian(COOKE, "curvature:1", of=lambda lens: lens.surfaces[2].thickness)
    assert not found.derivatives.any()


@pytest.mark.parametrize("name", ["focal_length", "direction"])
def test_derivatives_of_a_base_ray_are_its_gradients(name):
    """Its focal lengths follow from gradients that the function takes itself."""
    bent = GAUSS.replace(3, tilt_x=1.0)
    assert_gradients(lambda lens: getattr(rt.base_ray(lens), name), bent, "curvature:1,3 tilt:3 decentre:5")


def test_wrong_quantities_are_refused():
    with pytest.raises(ValueError, match="did you mean directions"):
        rt.jacobian(COOKE, "curvature", of="direction")
    with pytest.raises(ValueError, match="`fields` belongs to quantities of rays"):
        rt.jacobian(COOKE, "curvature", of=lambda lens: lens.wavelengths, fields=[0.0])
    with pytest.raises(ValueError, match="`merit` belongs to `of=merit`"):
        rt.jacobian(COOKE, "curvature", merit="spot")
    with pytest.raises(TypeError, match="expected a tensor"):
        rt.jacobian(COOKE, "curvature", of=lambda lens: 3)
    with pytest.raises(rt.BadVariables if hasattr(rt, "BadVariables") else ValueError, match="no variables"):
        rt.jacobian("cooke_triplet")


def test_derivatives_reach_the_configuration_that_a_function_takes():
    zoom = configurations.made(GAUSS, thickness={5: [14.0, 15.0]})

    def track(lens: rt.Lens) -> torch.Tensor:
        return sum(surface.thickness for surface in lens.configuration(2).surfaces[1:-1])

    found = rt.jacobian(zoom, "thickness:5 thickness:6=2*thickness:3 thickness:3", of=track)
    assert found.variables == ("thickness_5@1", "thickness_5@2", "thickness_3")
    assert found.derivatives.tolist() == [0.0, 1.0, 3.0]
