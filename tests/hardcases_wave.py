"""Hard cases of sums of waves, by kind; `check_*(case)` raises AssertionError where a gate is not met."""

from decimal import Decimal, getcontext

import torch

from raytrace.psf_models.dft import huygens, phasor, to_grid

AMPLITUDE = 1e-13  # of U/ΣA, for every radius of the sphere
INTENSITY = 1e-13  # of the diffraction peak

getcontext().prec = 60


def check_fft_psf(case: dict) -> float:
    """Picked values, Strehl at the centre and the sum (Parseval); the largest error, relative to the peak.

    PSF[v, u] = |Σ A exp(2πi W) exp(-2πi (u i + v j)/M)|² / (Σ A)² of N × N samples, M = pad·N; i column, j row.
    """
    data, expected = case["data"], case["expected"]
    amplitude, waves = (torch.tensor(data[key], dtype=torch.float64) for key in ("amplitude", "opd_waves"))
    size = data["pad"] * amplitude.shape[-1]
    line = torch.arange(size, dtype=torch.float64)
    j, i = (index.flatten() for index in torch.meshgrid(*(line[:n] for n in amplitude.shape), indexing="ij"))
    field = (amplitude * phasor(waves)).flatten()
    U = to_grid(field, -i / size, -j / size, line, line, torch.ones((), dtype=torch.float64))
    psf = (U.real**2 + U.imag**2) / amplitude.sum() ** 2
    if expected["status"] != "ok":
        assert not bool(U.any())
        return 0.0
    wanted = [(psf[pick["kv"], pick["ku"]], pick["value_over_diffraction_peak"], 1.0) for pick in expected["picks"]]
    wanted.append((psf[0, 0], expected["strehl_centre"], 1.0))
    wanted.append((psf.sum(), expected["sum_over_grid"], max(1.0, float(expected["sum_over_grid"]))))
    worst = max(_error(value, reference) / size for value, reference, size in wanted)
    assert worst <= INTENSITY, worst
    return worst


def check_huygens(case: dict) -> float:
    """Complex amplitude U/ΣA and intensity at every image point; the largest error."""
    data, expected = case["data"], case["expected"]
    radius, wavelength, path, amplitude = (
        torch.tensor(data[key], dtype=torch.float64) for key in ("R", "wavelength_mm", "W_mm", "amplitude")
    )
    if expected.get("status", "ok") != "ok":
        assert not bool((amplitude != 0).any())
        return 0.0
    x, y = torch.tensor(data["pupil_xy"], dtype=torch.float64).T
    pupil = torch.stack([x, y, -torch.sqrt(radius * radius - x * x - y * y)])
    points = torch.tensor(data["image_points"], dtype=torch.float64).T
    U = huygens(points, pupil, radius, path=path, amplitude=amplitude, wavelength=wavelength) / amplitude.sum()
    worst = 0.0
    for value, reference in zip(U, expected["values"], strict=True):
        intensity = value.real**2 + value.imag**2
        worst = max(worst, _error(value.real, reference["re"]), _error(value.imag, reference["im"]))
        worst = max(worst, 0.5 * _error(intensity, reference["intensity"]))
    assert worst <= AMPLITUDE, worst
    return worst


def _error(value: torch.Tensor, expected: str) -> float:
    return float(abs(Decimal(value.item()) - Decimal(expected)))
