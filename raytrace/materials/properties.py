"""Properties of a glass: catalog data, indices and thermal changes, the result of `rt.glass`."""

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
    in_words,
    index_in,
    objection,
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
from raytrace.maths.numerics import value
from raytrace.maths.result import Column, Result, Table, number
from raytrace.words import calling_level


@value
class GlassFigures(Result):
    """A glass and its indices (W,) at wavelengths (W,) µm.

    environment: that whose air the indices and wavelengths refer to, None for the catalog's reference air; dn_dt,
    dn_dt_absolute: (W,) 1/K, relative to air at the glass's temperature and relative to vacuum.
    """

    COLUMNS = (
        Column("wavelength", "µm", "g"), Column("index", "", ".10f"), Column("dn_dt", "1/K", ".3e", "dn/dT, air"),
        Column("dn_dt_absolute", "1/K", ".3e", "dn/dT, vacuum"),
    )  # fmt: skip

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
        } | (
            {}
            if self.environment is None
            else {
                "temperature": number(self.environment.temperature),
                "pressure": number(self.environment.pressure),
                "dn_dt": self.dn_dt.tolist(),
                "dn_dt_absolute": self.dn_dt_absolute.tolist(),
            }
        )

    def tables(self) -> list[Table]:
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
        if self.environment is not None:
            lines.append(
                f"  at       {in_words(self.environment)}, relative to air; dn/dT relative to air, and to vacuum"
            )
        return [Table(self.columns(), [*lines, ""])]


def glass(
    name: str,
    *,
    wavelengths: Sequence[float] | Tensor | None = None,
    catalogs: Sequence[str | Path] = (),
    temperature: float | Tensor | None = None,
    pressure: float | Tensor | None = None,
) -> GlassFigures:
    """Properties of a glass by its name, as in a lens file, or by a six-digit MIL code.

    wavelengths: µm, by default the lines F, d and C; catalogs: AGF files, searched first; temperature: °C, pressure:
    atm: if either is given (defaults 20 °C, 1 atm), indices and wavelengths refer to air in that state; n_d and V_d
    remain those of the catalog.
    Raises UnknownGlass, ImplausibleWavelength, InvalidIndex, ValueError; warns OutOfRange, NoThermalCoefficients.
    """
    medium = mil_glass(name) if re.fullmatch(r"\d{6}", name) else find_glass(name, user=catalogs)
    waves = [LINES[line] for line in "FdC"] if wavelengths is None else wavelengths
    waves = torch.as_tensor(waves, dtype=torch.float64).reshape(-1)
    check_unit(waves, [medium])
    check_wavelengths(medium, waves)
    if temperature is None and pressure is None:
        return GlassFigures(medium, waves, refractive_index(medium, waves))
    state = (REFERENCE[0] if temperature is None else temperature, REFERENCE[1] if pressure is None else pressure)
    air = Environment(*(torch.as_tensor(number, dtype=torch.float64) for number in state))
    if wrong := objection(air):
        raise ValueError(f"{name}: {wrong}")
    if unknown := unknown_change(medium, air):
        warnings.warn(unknown, NoThermalCoefficients, stacklevel=calling_level())
    return GlassFigures(medium, waves, index_in(medium, waves, air), air, *dn_dt(medium, waves, air))
