"""RMS over the field: what it is made of, the limit of small aberrations, and derivatives."""

import dataclasses
import json

import pytest
import torch
from differences import gradcheck
from problems import double_gauss, fields, lens, scalar, surface, vector

from raytrace import rms_over_field, wavefront
from raytrace.cli import main
from raytrace.files import shipped
from raytrace.io import read_lens
from raytrace.maths.sampling import gauss_rings
from raytrace.system.surface import Aperture
from raytrace.tracing.spot import image_rays, spot_of

TRIPLET = read_lens(shipped("lenses") / "cooke_triplet.zmx")


def own_fields(system):
    return torch.stack([system.fields.x, system.fields.y])


def test_each_wavelength_is_that_of_its_map_and_separate_spheres_add_as_squares():
    own = rms_over_field(TRIPLET, fields=own_fields(TRIPLET), reference="own", pupil=gauss_rings(14, 56))
    torch.testing.assert_close(own.rms, wavefront(TRIPLET, size=8).rms, rtol=1e-9, atol=1e-12)
    weights = TRIPLET.wavelength_weights / TRIPLET.wavelength_weights.sum()
    torch.testing.assert_close(own.polychromatic**2, (own.rms**2 * weights).sum(-1))
    primary = rms_over_field(TRIPLET, fields=own_fields(TRIPLET), pupil=gauss_rings(14, 56))
    torch.testing.assert_close(primary.rms, own.rms)
    assert primary.polychromatic[0].item() == pytest.approx(own.polychromatic[0].item(), rel=1e-9)  # no lateral colour
    assert (primary.polychromatic[1:] / own.polychromatic[1:] - 1).abs().min().item() > 1e-4


def test_the_strehl_ratio_of_small_aberrations_is_that_of_the_diffraction_integral():
    """exp(-(2πσ)²) against the largest intensity of the wave, of a telescope at the edge of its field."""
    telescope = read_lens(shipped("lenses") / "hubble.zmx")
    at = vector(0.0, 0.05)[:, None]
    found, wave = rms_over_field(telescope, fields=at), wavefront(telescope, fields=at, size=8)
    assert found.strehl[0].item() < 0.99
    assert found.strehl[0].item() == pytest.approx(wave.strehl[0, 0].item(), abs=3e-3)


def test_spots_are_those_of_the_rays():
    system = double_gauss(wavelengths=(0.53, 0.6))
    rule = gauss_rings(6)
    found = rms_over_field(system, fields=own_fields(system), spot=True, pupil=rule)
    expected = spot_of(image_rays(system, rule[0]), rule[1])
    torch.testing.assert_close(found.rms, expected.rms_radius)
    torch.testing.assert_close(found.polychromatic[0], (expected.rms_radius[0] ** 2).mean().sqrt())
    apart = (expected.centroid[:, 2, 0] - expected.centroid[:, 2, 1]).norm()
    joint = (expected.rms_radius[2] ** 2).mean() + apart**2 / 4
    torch.testing.assert_close(found.polychromatic[2] ** 2, joint)
    assert found.strehl is None


def test_fields_without_light_are_nan_and_words_that_are_none_are_refused():
    blind = surface(None, 90.0, apertures=(Aperture("circular", (0.0, 4.0)),))
    system = lens([surface(0.01, 60.0, 1.5), blind], field=fields("angle", (0.0, 20.0)))
    found = rms_over_field(system, samples=2)
    assert found.polychromatic.isnan().tolist() == [False, True]
    with pytest.raises(ValueError, match=r"'chief': expected .*primary, own"):
        rms_over_field(system, reference="chief")


@pytest.mark.parametrize("spot", [False, True])
def test_a_curvature_carries_its_derivatives(spot):
    def together(curvature):
        front = dataclasses.replace(surface(0.02, 5.0, 1.5), curvature=curvature)
        system = lens([front, surface(-0.01, 60.0)], field=fields("angle", (3.0,)), wavelengths=(0.5, 0.6))
        return rms_over_field(system, samples=2, spot=spot, pupil=gauss_rings(2)).polychromatic

    assert gradcheck(together, (scalar(0.02).requires_grad_(),), rtol=1e-4)


@pytest.mark.parametrize("options", [[], ["--spot"]])
def test_the_command(options, capsys, tmp_path):
    arguments = ["rms-over-field", "cooke_triplet", "--samples", "3", *options]
    assert main([*arguments, "--json", "--plot", str(tmp_path / "rms.png")]) == 0
    document = json.loads(capsys.readouterr().out, parse_constant=lambda text: pytest.fail(text))
    assert len(document["results"]) == 9
    assert len(document["summary"]) == 3
    assert (tmp_path / "rms.png").stat().st_size > 10_000
    assert main(arguments) == 0
    assert "all, weighted" in capsys.readouterr().out


@pytest.mark.slow
def test_zernike_coefficients_are_a_table(capsys):
    """Fringe terms are those of Noll's polynomials times their value at the rim; a lens on the axis has no coma."""
    assert main(["wavefront", "tessar", "--field", "0", "--numbering", "fringe", "--terms", "9", "--size", "8"]) == 0
    lines = capsys.readouterr().out.splitlines()
    rows = {line.split()[0]: line for line in lines if line[:3].strip().isdigit()}
    assert len(rows) == 9
    assert "spherical" in rows["9"]
    assert rows["7"].split()[-1] == "0.00000000"
    tessar = read_lens(shipped("lenses") / "tessar.zmx")
    axis = torch.zeros(2, 1, dtype=torch.float64)
    # Nine fringe terms are the first eleven of Noll less the trefoils, which a round lens has none of on its axis.
    noll = wavefront(tessar, fields=axis, size=8, terms=11).coefficients[0, :, 10]
    fringe = wavefront(tessar, fields=axis, size=8, terms=9, numbering="fringe").coefficients[0, :, 8]
    torch.testing.assert_close(fringe, noll * 5**0.5, rtol=1e-9, atol=1e-12)
    with pytest.raises(ValueError, match="expected one of noll, fringe"):
        wavefront(tessar, fields=axis, size=8, numbering="ansi")
