"""Figures of a glass: what is known of it, and its indices."""

import re
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from raytrace.maths.result import Result, number
from raytrace.maths.value import value
from raytrace.media.catalog import edition, find_glass
from raytrace.media.glass import (
    LINES,
    Glass,
    abbe_number,
    check_unit,
    check_wavelengths,
    mil_glass,
    nd,
    refractive_index,
)


@value
class GlassFigures(Result):
    """A glass and its indices (W,) at wavelengths (W,) µm."""

    glass: Glass
    wavelengths: Tensor
    indices: Tensor

    def columns(self) -> dict[str, Tensor]:
        return {"wavelength": self.wavelengths, "index": self.indices}

    def document(self) -> dict:
        glass = self.glass
        return {
            "name": glass.name,
            "catalog": glass.catalog or None,
            "edition": list(edition(glass)),
            "formula": glass.formula,
            "coefficients": glass.coefficients.tolist(),
            "wavelength_range": list(glass.wavelength_range) if glass.wavelength_range else None,
            "nd": number(nd(glass)),
            "vd": number(abbe_number(glass)),
            "wavelengths": self.wavelengths.tolist(),
            "indices": self.indices.tolist(),
        }

    def __str__(self) -> str:
        glass, span = self.glass, self.glass.wavelength_range
        told = "MIL code" if glass.formula == "model" else "no catalog"
        lines = [
            f"{glass.name}  ({glass.catalog or told})",
            f"  nd       {float(nd(glass)):.7f}",
            f"  Vd       {float(abbe_number(glass)):.4f}",
            f"  formula  {glass.formula}",
            f"  range    {span[0]:g} to {span[1]:g} µm" if span else "  range    not listed",
            *(f"  edition  {sentence}" for sentence in edition(glass)),
        ]
        pairs = zip(self.wavelengths.tolist(), self.indices.tolist(), strict=True)
        return "\n".join([*lines, *(f"  n({wavelength:g} µm) = {index:.10f}" for wavelength, index in pairs)])


def glass(
    name: str, *, wavelengths: Sequence[float] | Tensor | None = None, catalogs: Sequence[str | Path] = ()
) -> GlassFigures:
    """What is known of a glass by its name, as in a lens file, or by a six-digit MIL code.

    wavelengths: µm, by default the lines F, d and C. catalogs: AGF files that go before all others.
    Raises UnknownGlass, ImplausibleWavelength, InvalidIndex; warns OutOfRange.
    """
    found = mil_glass(name) if re.fullmatch(r"\d{6}", name) else find_glass(name, user=catalogs)
    asked = [LINES[line] for line in "FdC"] if wavelengths is None else wavelengths
    asked = torch.as_tensor(asked, dtype=torch.float64).reshape(-1)
    check_unit(asked, [found])
    check_wavelengths(found, asked)
    return GlassFigures(found, asked, refractive_index(found, asked))
