"""Arguments of the public functions: a path for a lens, one number for several, both spellings, errors of misuse."""

import dataclasses
import functools
import inspect
import pickle
import re

import numpy as np
import pytest
import torch

import raytrace as rt
from raytrace import public
from raytrace.tracing.launch import launch
from raytrace.tracing.spot import spot_of
from raytrace.tracing.trace import trace_lens

NAN = float("nan")
FUNCTIONS = {name: each for name in rt.PUBLIC if inspect.isfunction(each := rt.public_name(name))}
PARAMETERS = {name: inspect.signature(function).parameters for name, function in FUNCTIONS.items()}
OF_A_LENS = [name for name, parameters in PARAMETERS.items() if "lens" in parameters]
OF_SEVERAL = [(function, name) for function, names in PARAMETERS.items() for name in names if name in public._SEVERAL]
#: A function, keywords as a person may give them, and the same in full.
ALIKE = [
    ("first_order", {}, {}),
    ("info", {}, {}),
    ("evaluate", {"merit": "spot"}, {"merit": "spot"}),
    ("layout", {"field": 3}, {"fields": [3.0]}),
    ("rays", {"fields": 3, "wavelength": 0.55}, {"fields": [3.0], "wavelengths": [0.55]}),
    ("trace", {"object_distance": 1e3, "field": 3}, {"object_distances": [1e3], "fields": [3.0]}),
    ("spot", {"field": 3, "wavelength": 0.55}, {"fields": [3.0], "wavelengths": [0.55]}),
    ("spot", {"fields": np.float32(3)}, {"fields": [3.0]}),
    ("spot", {"fields": [(0, np.int64(3))]}, {"fields": [(0.0, 3.0)]}),
    ("spot", {"fields": torch.tensor(3.0, dtype=torch.float64)}, {"fields": [3.0]}),
    ("spot", {"rings": 4.0}, {"rings": 4}),
    ("focus", {"object_distances": 1e3}, {"object_distances": [1e3]}),
    ("ray_fan", {"field": 3}, {"fields": [3.0]}),
    ("seidel", {"field": np.array([3])}, {"fields": [3.0]}),
    ("distortion", {"wavelengths": 0.55, "samples": 3}, {"wavelengths": [0.55], "samples": 3}),
    (
        "mtf",
        {"frequency": 10, "field": 3, "geometric": True},
        {"frequencies": [10.0], "fields": [3.0], "geometric": True},
    ),
    ("encircled_energy", {"radius": 0.1, "geometric": True}, {"radii": [0.1], "geometric": True}),
    ("psf", {"model": "gaussian", "field": 3, "object_distance": 1e4, "size": 5},
     {"model": "gaussian", "fields": [3.0], "object_distances": [1e4], "size": 5}),
]  # fmt: skip


@pytest.fixture(scope="module")
def singlet():
    rows = [{"radius": 50.0, "thickness": 4.0, "glass": 1.5}, {"radius": -50.0, "thickness": 48.0}]
    return rt.lens(rows, stop=1, f_number=8, fields=[0, 3])


@pytest.fixture(scope="module")
def path(singlet, tmp_path_factory):
    found = tmp_path_factory.mktemp("lens") / "singlet.zmx"
    rt.write_lens(singlet, found)
    return found


def fill(function: str, **given) -> dict:
    """The keywords given, which are read first, and None for what else the function requires."""
    required = (name for name, one in PARAMETERS[function].items() if one.default is one.empty and one.kind < 4)
    return given | {name: None for name in required if name not in given}


def refused(kind, function: str, said: str, **given) -> None:
    with pytest.raises(kind, match=re.escape(said)) as found:
        FUNCTIONS[function](**fill(function, **given))
    assert str(found.value).startswith(function)


@pytest.mark.parametrize(("function", "short", "full"), ALIKE, ids=lambda value: str(value)[:30])
def test_a_path_and_a_lens_and_one_number_and_several_are_alike(function, short, full, path):
    found, expected = FUNCTIONS[function](str(path), **short), FUNCTIONS[function](rt.read_lens(path), **full)
    assert str(found) == str(expected)


@pytest.mark.parametrize("function", OF_A_LENS)
def test_arguments_that_are_not_lenses_are_refused(function, singlet):
    for wrong, said in ((None, "None"), (5, "5"), ([singlet], "a list"), (rt.info(singlet), "as its `lens`")):
        refused(TypeError, function, said, lens=wrong)
    with pytest.raises((OSError, ValueError), match="no_such_lens"):
        FUNCTIONS[function](**fill(function, lens="no_such_lens"))


@pytest.mark.parametrize(("function", "name"), OF_SEVERAL, ids=lambda value: str(value))
def test_arguments_that_are_not_numbers_are_refused(function, name, singlet):
    lens = {"lens": singlet} if "lens" in PARAMETERS[function] else {}
    refused(ValueError, function, f"`{name}` holds nan; expected a number or several", **lens, **{name: NAN})
    refused(ValueError, function, f"`{name}` holds nan; expected a number or several", **lens, **{name: [1, NAN]})
    refused(ValueError, function, f"`{name}` is empty; expected a number or several", **lens, **{name: []})
    refused(ValueError, function, f"`{name}` is empty", **lens, **{name: torch.zeros(0)})
    refused(TypeError, function, f"`{name}` is 'five'; expected a number", **lens, **{name: "five"})
    refused(TypeError, function, f"`{name}` holds 'five'; expected a number", **lens, **{name: ["five"]})
    refused(TypeError, function, f"`{name}` is an object; expected a number", **lens, **{name: object()})


@pytest.mark.parametrize("function", FUNCTIONS)
def test_other_misuse_is_refused(function, singlet):
    lens = {"lens": singlet} if "lens" in PARAMETERS[function] else {}
    for name, one in PARAMETERS[function].items():
        reader = public._reader_of_values(one) if name != "lens" else None
        if reader in (public._number, public._count):
            refused(TypeError, function, f"`{name}` is 'five'; expected a", **lens, **{name: "five"})
            refused(ValueError, function, f"`{name}` is nan; expected a", **lens, **{name: NAN})
        if isinstance(reader, functools.partial):
            refused(TypeError, function, f"`{name}` is an object; expected a", **lens, **{name: object()})
    if all(one.kind is not one.VAR_KEYWORD for one in PARAMETERS[function].values()):
        refused(TypeError, function, f"{function} has no option `nothing_like_it` (it has ", **lens, nothing_like_it=1)


def test_an_unknown_option_names_the_nearest(singlet):
    refused(TypeError, "spot", "spot has no option `feilds`; did you mean fields?", lens=singlet, feilds=1)
    refused(TypeError, "mtf", "`field` and `fields` are one option", lens=singlet, field=1, fields=[1])


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda lens: rt.Variables(None), "Variables: `lens` is None; expected a Lens"),
        (lambda lens: rt.Camera(lens, None), "Camera: `variables` is a Lens; expected the Variables of a lens"),
        (lambda lens: lens.at(fields=NAN), "`fields` hold a number that is not finite"),
        (lambda lens: lens.at(object_distance=NAN), "the object distance is nan"),
        (lambda lens: rt.materials.find_glass(None), "find_glass: `name` is None; expected a text"),
        (lambda lens: rt.materials.refractive_index("N-BK7", 0.55), "`glass` is 'N-BK7'; expected a Glass"),
        (lambda lens: rt.psf(lens, size="a"), "psf: `size` is 'a'; expected a pair or a whole number"),
        (lambda lens: rt.optimize(lens, merit="spot", vary=5), "`vary` is 5; expected a sequence or a text"),
        (lambda lens: lens.at(feilds=5), "Lens.at has no option `feilds`; did you mean fields?"),
        (lambda lens: lens.at(field=5, fields=[5]), "Lens.at: `field` and `fields` are one option"),
        (lambda lens: lens.at([5]), "Lens.at: a list is given without a name; write name=value (options: object_dist"),
        (lambda lens: rt.lens([5]), "lens: `stop` is missing and has no default; add stop=…"),
        (lambda lens: rt.lens([5], stop=1, f_number=8), "surface 1: 5; expected a mapping, as dict(radius=50"),
        (
            lambda lens: rt.tracing.rays(lens, pupil=5),
            "rays: `pupil` is 5; expected points (2, P) of the unit disc, or a rule",
        ),
        (
            lambda lens: rt.tracing.rays(lens, pupil=torch.zeros(3)),
            "rays: `pupil` has the shape (3,); expected points (2, P)",
        ),
        (lambda lens: rt.wave_optics.wave_psf(None), "wave_psf: `element` is None; expected "),
        (lambda lens: rt.maths.hexapolar(-1), "hexapolar: `rings` is -1; expected 1 or more"),
        (lambda lens: rt.maths.gauss_rings(0), "gauss_rings: `rings` is 0; expected 1 or more"),
        (lambda lens: rt.maths.sobol(0), "sobol: `count` is 0; expected 1 or more"),
        (lambda lens: rt.spot(lens, [0, 5]), "spot: a list is given without a name; write name=value (options: fields"),
        (
            lambda lens: rt.imaging.wiener(torch.ones(2, 2), 0.1, 5),
            "wiener: 5 is given without a name; it takes no further",
        ),
        (lambda lens: rt.spot(lens, lens=lens), "spot: `lens` is given twice, with and without its name"),
    ],
)
def test_classes_and_values_of_other_kinds_are_refused(call, said, singlet):
    with pytest.raises((TypeError, ValueError), match=re.escape(said)):
        call(singlet)


VMAPPED = {
    **{"spot": {}, "mtf": {"frequencies": [10.0]}, "wavefront": {}, "focus": {}, "trace": {}},
    **{"psf": {"model": "gaussian", "size": 5}, "optimize": {"merit": "spot", "vary": "curvature"}},
}


def varied(lens, curvature):
    first, changed, *rest = lens.surfaces
    changed = dataclasses.replace(changed, curvature=curvature)
    return dataclasses.replace(lens, surfaces=(first, changed, *rest))


@pytest.mark.parametrize("function", VMAPPED)
def test_a_verb_that_reads_numbers_names_itself_under_vmap(function, singlet):
    curvatures = torch.tensor([0.02, 0.021], dtype=torch.float64)
    with pytest.raises(RuntimeError, match=f"^{function} .*torch.func.vmap.* first_order, rays, base_ray"):
        torch.func.vmap(lambda c: FUNCTIONS[function](varied(singlet, c), **VMAPPED[function]))(curvatures)


@pytest.mark.parametrize(
    "call",
    [
        lambda lens: rt.first_order(lens).power,
        lambda lens: rt.tracing.rays(lens).position,
        lambda lens: rt.base_ray(lens).position,
        lambda lens: (
            spot_of(
                trace_lens(lens, launch(lens, rt.maths.gauss_rings(3)[0]), lens.wavelengths[:, None]),
                rt.maths.gauss_rings(3)[1],
            ).mean_square_radius
        ),
    ],
)
def test_the_functions_that_the_message_names_work_under_vmap(call, singlet):
    curvatures = torch.tensor([0.02, 0.021], dtype=torch.float64)
    found = torch.func.vmap(lambda c: call(varied(singlet, c)))(curvatures)
    assert torch.allclose(found[1], call(varied(singlet, curvatures[1])), rtol=1e-12)


def test_a_lens_takes_both_spellings_of_its_conditions(singlet):
    assert str(singlet.at(field=5, wavelength=[0.55])) == str(singlet.at(fields=5, wavelengths=[0.55]))


def test_one_number_serves_as_a_wavelength(path):
    lens = rt.read_lens(path)
    expected = rt.first_order(lens, torch.tensor(0.55, dtype=torch.float64)).power
    assert torch.equal(rt.first_order(path, wavelengths=0.55).power, expected)
    assert rt.Variables(str(path)).lens.name == lens.name


def test_the_verbs_are_those_of_the_modules():
    for name, function in FUNCTIONS.items():
        assert function is rt.public_name(name)
        assert function.__doc__ == function.__wrapped__.__doc__
        assert pickle.loads(pickle.dumps(function)) is function


@pytest.mark.parametrize("warned", ["spot", "read_lens"])
def test_a_warning_names_the_line_that_calls_the_verb(warned, path, tmp_path):
    unknown = tmp_path / "unknown.zmx"
    unknown.write_text(path.read_text("utf-8-sig").replace("NAME", "FROB 1 2\nNAME", 1), "utf-8")
    with pytest.warns((rt.LostRays, UserWarning)) as found:
        rt.spot(path, field=80) if warned == "spot" else rt.read_lens(unknown)
    assert {one.filename for one in found} == {__file__}
