"""Figures of a glass: what is known of it, and its indices."""

import re
import warnings
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from raytrace.materials.catalogs import edition, find_glass
from raytrace.materials.environment import (
    REFERENCE,
    Environment,
    NoThermalCoefficients,
    dn_dt,
    index_in,
    objection,
    told,
    unknown_change,
)
from raytrace.materials.glass import (
    LINES,
    Glass,
    abbe_number,
    check_unit,
    check_wavelengths,
    mil_glass,
    nd,
    refractive_index,
)
from raytrace.maths.result import Result, number
from raytrace.maths.value import value
from raytrace.words import calling_level


@value
class GlassFigures(Result):
    """A glass and its indices (W,) at wavelengths (W,) µm.

    environment: where the indices and wavelengths are those beside its air, None for the catalog's own; and there
    dn_dt, dn_dt_absolute: (W,) 1/K, beside air that warms with the glass and beside vacuum.
    """

    glass: Glass
    wavelengths: Tensor
    indices: Tensor
    environment: Environment | None = None
    dn_dt: Tensor | None = None
    dn_dt_absolute: Tensor | None = None

    def columns(self) -> dict[str, Tensor]:
        changes = {"dn_dt": self.dn_dt, "dn_dt_absolute": self.dn_dt_absolute} if self.environment else {}
        return {"wavelength": self.wavelengths, "index": self.indices, **changes}

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
            **self._document_of_environment(),
        }

    def _document_of_environment(self) -> dict:
        if self.environment is None:
            return {}
        return {
            "temperature": number(self.environment.temperature),
            "pressure": number(self.environment.pressure),
            "dn_dt": self.dn_dt.tolist(),
            "dn_dt_absolute": self.dn_dt_absolute.tolist(),
        }

    def __str__(self) -> str:
        glass, span = self.glass, self.glass.wavelength_range
        source = "MIL code" if glass.formula == "model" else "no catalog"
        lines = [
            f"{glass.name}  ({glass.catalog or source})",
            f"  nd       {float(nd(glass)):.7f}",
            f"  Vd       {float(abbe_number(glass)):.4f}",
            f"  formula  {glass.formula}",
            f"  range    {span[0]:g} to {span[1]:g} µm" if span else "  range    not listed",
            *(f"  edition  {sentence}" for sentence in edition(glass)),
        ]
        shown = [
            f"  n({w:g} µm) = {n:.10f}" for w, n in zip(self.wavelengths.tolist(), self.indices.tolist(), strict=True)
        ]
        if self.environment is not None:
            lines.append(
                f"  at       {told(self.environment)}, beside the air there; dn/dT beside it, and beside vacuum"
            )
            changes = torch.stack([self.dn_dt, self.dn_dt_absolute], -1).mul(1e6).round(decimals=3).tolist()
            slopes = (f"   {beside_air:8.3f} {absolute + 0.0:8.3f} e-6/K" for beside_air, absolute in changes)
            shown = [line + slope for line, slope in zip(shown, slopes, strict=True)]
        return "\n".join([*lines, *shown])


def glass(
    name: str,
    *,
    wavelengths: Sequence[float] | Tensor | None = None,
    catalogs: Sequence[str | Path] = (),
    temperature: float | Tensor | None = None,
    pressure: float | Tensor | None = None,
) -> GlassFigures:
    """What is known of a glass by its name, as in a lens file, or by a six-digit MIL code.

    wavelengths: µm, by default the lines F, d and C. catalogs: AGF files that go before all others.
    temperature: °C, pressure: atm: where one is given, 20 °C and 1 atm by default, the indices beside the air there,
    and the wavelengths in it; n_d and V_d stay those of the catalog.
    Raises UnknownGlass, ImplausibleWavelength, InvalidIndex, ValueError; warns OutOfRange, NoThermalCoefficients.
    """
    found = mil_glass(name) if re.fullmatch(r"\d{6}", name) else find_glass(name, user=catalogs)
    asked = [LINES[line] for line in "FdC"] if wavelengths is None else wavelengths
    asked = torch.as_tensor(asked, dtype=torch.float64).reshape(-1)
    check_unit(asked, [found])
    check_wavelengths(found, asked)
    if temperature is None and pressure is None:
        return GlassFigures(found, asked, refractive_index(found, asked))
    given = [normal if one is None else one for one, normal in zip((temperature, pressure), REFERENCE, strict=True)]
    air = Environment(*(torch.as_tensor(one, dtype=torch.float64) for one in given))
    if wrong := objection(air):
        raise ValueError(f"{name}: {wrong}")
    if unknown := unknown_change(found, air):
        warnings.warn(unknown, NoThermalCoefficients, stacklevel=calling_level())
    return GlassFigures(found, asked, index_in(found, asked, air), air, *dn_dt(found, asked, air))
