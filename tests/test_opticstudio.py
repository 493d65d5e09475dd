"""Figures that OpticStudio printed or stored for public systems, each at its own tolerance.

Oracle: tests/oracles/opticstudio.json.gz (`meta` says what it holds); RAYTRACE_OPTICSTUDIO=FILE runs every case of
another file of that schema. THEIRS are the cases that differ, each with the reason and the size.
"""

import re
from pathlib import Path

import opticstudio_answers
import pytest
import torch
from opticstudio_answers import ANSWERS, CASES, ELSEWHERE, intensities, lens_of, share_of, tensor

from raytrace.tracing.paraxial import first_order

#: Differs by what OpticStudio does: pattern of the case's id, why, and the largest difference in the case's unit.
THEIRS = {
    r"^cooke_m0p80 FFT MTF (0|20)\.0 deg": ("64 × 64 samples do not resolve 20 µm of blur", 0.15),
    r"^cooke_m0p40 FFT MTF (0|20)\.0 deg": ("64 × 64 samples do not resolve 12 µm of blur", 0.12),
    r"^cooke_p0p40 FFT MTF 20\.0 deg": ("64 × 64 samples do not resolve the blur", 0.016),
    r"^cooke_p0p80 FFT MTF (14|20)\.0 deg": ("64 × 64 samples do not resolve the blur", 0.055),
    r"^objective first order exit_pupil_diameter": ("its exit pupil is off by 5e-6", 1.1e-4),
    r"^objective first order exit_pupil_position": ("its exit pupil is off by 5e-6", 3e-4),
    r"^index H-ZBAF(20|1)$": ("its catalog is of 2023-09; the shipped glass is of an older edition", 5.5e-5),
}

#: Diffraction off the axis takes seconds a case.
SLOW = r"^objective (through-focus|(FFT MTF|diffraction encircled).* (1\.125|2\.25|3\.375|4\.5) mm)"


def listed(table: dict, case: dict):
    return next((value for pattern, value in table.items() if re.search(pattern, case["id"])), None)


def answered() -> list:
    def marks(case: dict) -> list:
        return [pytest.mark.slow] if re.search(SLOW, case["id"]) and not ELSEWHERE else []

    return [pytest.param(case, id=case["id"], marks=marks(case)) for case in CASES if case["call"] != "none"]


def differences(case: dict) -> tuple[torch.Tensor, torch.Tensor]:
    """|ours - theirs| and the tolerance, number by number."""
    found, value, tolerance = tensor(ANSWERS[case["call"]](case)), tensor(case["value"]), tensor(case["tol"])
    assert found.shape == value.reshape(-1).shape, f"{len(found)} numbers for {value.numel()}"
    return (found - value.reshape(-1)).abs(), tolerance.reshape(-1).expand(found.shape)


@pytest.mark.parametrize("case", answered())
def test_figure(case):
    if case["call"] not in ANSWERS:
        pytest.fail(f"{case['id']}: no answer to {case['call']!r}; known are {', '.join(ANSWERS)}")
    off, tolerance = differences(case)
    differs = listed(THEIRS, case)
    if differs:
        reason, size = differs
        assert (off > tolerance).any(), f"right now: take it off the list ({reason})"
        tolerance = torch.full_like(off, size)
    assert torch.isfinite(off).all()
    assert (off <= tolerance).all(), f"off by {off.max():.3g}, {float((off / tolerance).max()):.3g} tolerances"


@pytest.mark.skipif(bool(ELSEWHERE), reason="of the shipped cases")
def test_pages_state_the_counts_of_the_cases():
    compared = [case for case in CASES if case["call"] != "none"]
    differ = sum(listed(THEIRS, case) is not None for case in compared)
    counts = len(compared) - differ, len(compared), differ
    agree, total, theirs = map(str, counts)
    root = Path(__file__).parents[1]
    for page, words in (
        ("docs/reference/opticstudio.md", f"{agree} of {total} figures"),
        (
            "docs/reference/accuracy.md",
            f"{total} figures of OpticStudio: {agree} agree to the digits printed, {theirs} ",
        ),
        ("README.md", f"of {total} figures that it printed or stored, {agree} agree"),
    ):
        assert words in (root / page).read_text("utf-8"), page
    table = (root / "docs" / "reference" / "opticstudio.md").read_text("utf-8")
    rows = re.findall(r"^\|[^|]+\| (\d+) \| (\d+) \| (\d*) *\|$", table, re.M)
    assert tuple(sum(int(row[k] or 0) for row in rows) for k in (1, 0, 2)) == counts


@pytest.mark.skipif(bool(ELSEWHERE), reason="of the shipped cases")
def test_every_exception_is_that_of_a_case():
    for pattern in THEIRS:
        assert [case for case in CASES if re.search(pattern, case["id"])], pattern


def test_exit_pupil_of_the_objective_by_an_independent_trace():
    """y' = y + t u, n'u' = nu - y c (n' - n), backwards in nothing but numbers from the centre and rim of the stop."""
    lens = opticstudio_answers.system("objective_f27")
    data = first_order(lens)
    system = opticstudio_answers.description("objective_f27")
    indices = [system["indices"][row[2]]["0.44"] if row[2] else 1.0 for row in system["surfaces"]]
    ends = []
    for y, u in ((0.0, 1.0), (1.0, 0.0)):
        for k in range(system["stop"], len(system["surfaces"]) - 1):
            before, (curvature, thickness) = indices[k - 1], system["surfaces"][k][:2]
            u = (before * u - y * curvature * (indices[k] - before)) / indices[k]
            y = y + float(thickness) * u
        ends.append((y, u))
    (y, u), (height, slope) = ends
    position = -y / u
    magnification = height + position * slope
    assert data.exit_pupil_position.item() == pytest.approx(position, rel=1e-9)
    expected = 2 * abs(magnification * data.stop_height.item())
    assert data.exit_pupil_diameter.item() == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("name", ["cooke_m0p80", "cooke_m0p40"])
def test_axial_mtf_of_the_cooke_lens_by_the_transform_of_its_psf(name):
    """2π ∫ I(r) J₀(2πνr) r dr up to 0.15 mm: another way to what OpticStudio's grid misses by 0.017 and 0.038."""
    case = {"system": name, "fields": [0.0], "frequency": [10.0, 20.0, 30.0, 50.0]}
    r = torch.linspace(0.0, 0.15, 3001, dtype=torch.float64)
    light = (share_of(case) * intensities(case, r, tensor([0.0]))[0]).sum((0, 1)) * r
    kernel = torch.special.bessel_j0(2 * torch.pi * tensor(case["frequency"])[:, None] * r)
    by_psf = 2 * torch.pi * torch.trapezoid(light * kernel, r)
    assert (by_psf.abs() - tensor(ANSWERS["mtf_fft"](case))[:4]).abs().max() <= 3e-3


#: Quantities that are analyses of their own, with tests of their own.
ELSEWHERE_TESTED = {
    "angular magnification": lambda case: first_order(lens_of(case)).angular_magnification.item(),
}


@pytest.mark.parametrize("case", [c for c in CASES if c["quantity"] in ELSEWHERE_TESTED], ids=lambda case: case["id"])
def test_first_order_figure(case):
    assert ELSEWHERE_TESTED[case["quantity"]](case) == pytest.approx(case["value"], abs=case["tol"] or 5e-7)


def test_a_path_that_cannot_be_read_fails(tmp_path):
    with pytest.raises(OSError, match="none"):
        opticstudio_answers.read(tmp_path / "none.json")
