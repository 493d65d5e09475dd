"""Models of ray-optics (.roa): small ones of our own, against figures of ray-optics 0.9.8 and exact ones."""

import json
import math

import pytest
import torch

import raytrace as rt
from raytrace.io import LensFileError, UnsupportedSurface, read_lens, read_lens_with_report
from raytrace.materials.glass import refractive_index


def part(kind: str, module: str = "rayoptics.x", **attributes) -> dict:
    return {"__instance_type__": [module, kind], "attributes": attributes}


AIR = part("Air", "opticalglass.opticalmedium")


def surface(profile: dict, mode: str = "transmit", **more) -> dict:
    return part("Surface", interact_mode=mode, max_aperture=6.0, label="", profile=profile, **more)


def gap(thickness: float, medium: dict = AIR) -> dict:
    return part("Gap", thi=thickness, medium=medium)


PLANE = part("Spherical", cv=0.0)
BK7 = part("SchottGlass", "opticalglass.schott", gname="N-BK7", coefs=[])


def model(
    surfaces, gaps, *, stop=1, pupil=("object", "epd", 10.0), fields=("object", "angle"), unit="mm", **field
) -> dict:
    """A model of surfaces between object and image, and the gaps behind object and surfaces."""
    points = [part("Field", x=0.0, y=y, vux=0.0, vuy=0.0, vlx=0.0, vly=0.0, wt=1.0) for y in (0.0, 0.5)]
    points[1]["attributes"] |= field.pop("vignetting", {})
    ifcs = [surface(PLANE, "dummy"), *surfaces, surface(PLANE, "dummy")]
    optics = part(
        "OpticalSpecs",
        spectral_region=part("WvlSpec", wavelengths=[486.1327, 587.5618], spectral_wts=[1.0, 2.0], reference_wvl=1),
        pupil=part("PupilSpec", _key=["aperture", *pupil[:2]], value=pupil[2]),
        field_of_view=part("FieldSpec", key=["field", *fields], value=2.0, fields=points, **field),
        defocus=part("FocusRange", focus_shift=0.0),
    )
    sequence = part("SequentialModel", ifcs=ifcs, gaps=gaps, stop_surface=stop)
    system = part("SystemSpec", title="x", _dimensions=unit)
    whole = part(
        "OpticalModel", system_spec=system, seq_model=sequence, optical_spec=optics, profile_dict={}, part_tree={}
    )
    return {"optical_model": whole}


FRONT, BACK = (
    surface(part("Conic", cv=0.02, cc=-0.5)),
    surface(part("EvenPolynomial", cv=-0.02, cc=0.0, coefs=[0.0, 1e-6])),
)
SINGLET = [FRONT, BACK], [gap(1e10), gap(4.0, BK7), gap(47.0)]


@pytest.fixture
def read(tmp_path):
    def of(found: dict | str, **options):
        path = tmp_path / "lens.roa"
        path.write_text(found if isinstance(found, str) else json.dumps(found))
        return read_lens_with_report(path, **options)

    return of


def test_a_singlet_is_read_number_for_number(read):
    lens, report = read(model(*SINGLET, is_relative=True, vignetting={"vuy": 0.4, "vly": 0.2}))
    assert not report.warnings
    assert (lens.surfaces[0].thickness, lens.stop, lens.name) == (math.inf, 1, "x")
    assert [float(one.thickness) for one in lens.surfaces[1:]] == [4.0, 47.0, 0.0]
    assert (float(lens.surfaces[1].curvature), float(lens.surfaces[1].conic)) == (0.02, -0.5)
    assert lens.surfaces[2].coefficients.tolist() == [0.0, 1e-6]
    assert (lens.surfaces[1].glass.name, lens.surfaces[1].glass.catalog) == ("N-BK7", "SCHOTT")
    assert lens.wavelengths.tolist() == [0.4861327, 0.5875618]
    assert (lens.wavelength_weights.tolist(), lens.primary_wavelength) == ([1.0, 2.0], 2)
    assert (lens.fields.kind, lens.fields.y.tolist()) == ("angle", [0.0, 1.0])
    assert lens.fields.vignetting[:, 1].tolist() == pytest.approx([0.0, -0.1, 0.0, 0.3, 0.0], abs=1e-15)
    assert rt.spot(lens).rms_radius.isfinite().all()


def test_lengths_are_converted_to_millimetres(read):
    small = model([FRONT, BACK], SINGLET[1], unit="cm")
    lens, _ = read(small)
    assert float(lens.surfaces[1].thickness) == 40.0
    assert float(lens.surfaces[1].curvature) == 0.002
    assert lens.surfaces[2].coefficients.tolist() == pytest.approx([0.0, 1e-9], rel=1e-15)
    assert (lens.aperture.kind, float(lens.aperture.value)) == ("entrance_pupil_diameter", 100.0)


def test_a_model_glass_has_the_indices_of_buchdahls_formula(read):
    """Of nd 1.471, Vd 76.6, as ray-optics 0.9.8 gives them at both wavelengths."""
    start, terms = 0.5875618, [-0.0423116, 0.0009162]
    model_glass = part("Buchdahl2", wv0=start, rind0=1.471, coefs={"__ndarray__": terms})
    glass = part("ModelGlass", "opticalglass.modelglass", label="", n=1.471, v=76.6, bdhl_model=model_glass)
    lens, _ = read(model([FRONT, BACK], [gap(1e10), gap(4.0, glass), gap(47.0)]))
    omega = (lens.wavelengths - start) / (1 + 2.5 * (lens.wavelengths - start))
    wanted = 1.471 + terms[0] * omega + terms[1] * omega**2
    assert (refractive_index(lens.surfaces[1].glass, lens.wavelengths) - wanted).abs().max() < 1e-14


def test_mirrors_and_pupils_of_the_image(read):
    """A Cassegrain of two parabolas: thicknesses keep their signs; an image F/# is that of the beam."""
    mirrors = [
        surface(part("Conic", cv=-0.01, cc=-1.0), "reflect"),
        surface(part("Conic", cv=-0.02, cc=-4.0), "reflect"),
    ]
    gaps = [gap(1e10), gap(-30.0), gap(50.0)]
    lens, _ = read(model(mirrors, gaps, pupil=("image", "f/#", 10.0), fields=("image", "height")))
    first = rt.first_order(lens)
    assert float(first.effective_focal_length / first.entrance_pupil_diameter) == pytest.approx(10.0, rel=1e-12)
    assert lens.fields.kind == "paraxial_image_height"
    assert [one.is_mirror for one in lens.surfaces] == [False, True, True, False]


def test_an_image_f_number_of_a_near_object_is_that_of_the_paraxial_cone(read):
    lens, _ = read(model(SINGLET[0], [gap(100.0), *SINGLET[1][1:]], pupil=("image", "f/#", 10.0)))
    assert lens.aperture.kind == "paraxial_working_f_number"
    assert float(rt.first_order(lens).paraxial_working_f_number) == pytest.approx(10.0, rel=1e-12)


def test_decentres_and_odd_terms(read):
    """Tilts alpha and beta are left-handed; a radial polynomial begins with r, and ec is the conic constant + 1."""
    tilt = part("DecenterData", _dtype="decenter", dec=[1.0, 2.0, 0.0], euler=[10.0, -5.0, 3.0])
    radial = part("RadialPolynomial", cv=0.02, ec=0.5, coefs=[0.0, 0.0, 1e-5, 1e-6])
    lens, _ = read(model([surface(radial, decenter=tilt), BACK], SINGLET[1]))
    one = lens.surfaces[1]
    numbers = [float(getattr(one.before, name)) for name in ("x", "y", "tilt_x", "tilt_y", "tilt_z")]
    assert numbers == [1.0, 2.0, -10.0, 5.0, 3.0]
    assert (one.kind, float(one.conic), one.coefficients.tolist()) == ("odd asphere", -0.5, [0.0, 0.0, 1e-5, 1e-6])


def test_a_diffractive_surface_has_its_power(read):
    """p = c r² at the reference wavelength: a power of -2 c, added to that of the refraction."""
    element = part(
        "DiffractiveElement", coefficients=[-1e-3], ref_wl=587.5618, order=1, phase_fct_name="radial_phase_fct"
    )
    lens, report = read(model([surface(PLANE, phase_element=element), surface(PLANE)], SINGLET[1]))
    assert float(rt.first_order(lens).effective_focal_length) == pytest.approx(500.0, rel=1e-12)
    assert "light refracts at the diffractive surface" in report.warnings[0]


@pytest.mark.parametrize(
    ("changed", "error", "message"),
    [
        (model([part("ThinLens", _power=0.02), BACK], SINGLET[1]), UnsupportedSurface, "surface 1: .*a thin lens"),
        (model([surface(part("XToroid", cv=0.1)), BACK], SINGLET[1]), UnsupportedSurface, "a profile of class XToroid"),
        (model(*SINGLET, stop=None), UnsupportedSurface, "a stop that floats is not modelled"),
        (model(*SINGLET, stop=3), LensFileError, "stop_surface is surface 3"),
        (model(*SINGLET, fields=("image", "angle")), LensFileError, "fields by image angle are not modelled"),
        (model(*SINGLET, pupil=("image", "epd", 3.0)), LensFileError, "a pupil by image epd is not modelled"),
        (model(*SINGLET, unit="furlong"), LensFileError, "dimensions are 'furlong'"),
        (model([FRONT], SINGLET[1]), LensFileError, "3 surfaces and 3 gaps"),
        (model([FRONT, surface(part("Spherical", cv="x"))], SINGLET[1]), LensFileError, "surface 2: .*cv is"),
        (model([FRONT, surface(part("Spherical", cv=math.inf))], SINGLET[1]), LensFileError, "a finite number"),
        ({"optical_model": [1]}, LensFileError, "expected an object with __instance_type__"),
        ([1], LensFileError, "no optical_model"),
        ("{", LensFileError, "lens.roa:1: no JSON file of ray-optics"),
        ("[" * 100_000, LensFileError, "nested too deeply"),
        (json.dumps(model(*SINGLET)).replace("4.0", "9" * 5000), LensFileError, "no JSON file|a finite number"),
    ],
)
def test_unmodelled_or_damaged_data_are_refused_by_name(changed, error, message, read):
    with pytest.raises(error, match=message):
        read(changed)


def test_a_glass_of_no_catalog_has_a_substitute(read, tmp_path):
    glass = part("SchottGlass", "opticalglass.schott", gname="XK99", coefs=[])
    read_from = model([FRONT, BACK], [gap(1e10), gap(4.0, glass), gap(47.0)])
    lens, report = read(read_from, substitute="XK99=N-BK7")
    assert lens.surfaces[1].glass.name == "N-BK7"
    assert "is taken for the glass XK99" in report.warnings[0]
    assert torch.equal(read_lens(tmp_path / "lens.roa", substitute="XK99=N-BK7").wavelengths, lens.wavelengths)
