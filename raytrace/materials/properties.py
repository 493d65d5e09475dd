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
    internal_transmittance,
    mil_glass,
    nd,
    refractive_index,
)
from raytrace.maths.numerics import value
from raytrace.maths.result import Column, Result, Table, number, numbers
from raytrace.words import calling_level


@value
class GlassFigures(Result):
    """A glass and its indices (W,) at wavelengths (W,) µm.

    environment: the air that the indices and wavelengths refer to, None for the catalog's reference air; dn_dt,
    dn_dt_absolute: (W,) 1/K, relative to air at the glass's temperature and relative to vacuum. transmittance: (W,)
    internal, of 10 mm, nan where not listed. Expansion, density and price are those of `glass`.
    """

    COLUMNS = (
        Column("wavelength", "µm", "g"), Column("index", "", ".10f"), Column("dn_dt", "1/K", ".3e", "dn/dT, air"),
        Column("dn_dt_absolute", "1/K", ".3e", "dn/dT, vacuum"),
        Column("transmittance", "10 mm", ".4f", "internal\ntransmittance"),
    )  # fmt: skip

    glass: Glass
    wavelengths: Tensor
    indices: Tensor
    transmittance: Tensor
    environment: Environment | None = None
    dn_dt: Tensor | None = None
    dn_dt_absolute: Tensor | None = None

    def columns(self) -> dict[str, Tensor]:
        listed = {"transmittance": self.transmittance} if self.glass.transmittance else {}
        return {"wavelength": self.wavelengths, "index": self.indices, **self._changes(), **listed}

    def _changes(self) -> dict[str, Tensor]:
        """dn/dT where the environment is specified."""
        if self.dn_dt is None or self.dn_dt_absolute is None:
            return {}
        return {"dn_dt": self.dn_dt, "dn_dt_absolute": self.dn_dt_absolute}

    def document(self) -> dict:
        glass, air = self.glass, self.environment
        return {
            "name": glass.name,
            "catalog": glass.catalog or None,
            "edition": list(edition(glass)),
            "formula": glass.formula,
            "coefficients": glass.coefficients.tolist(),
            "wavelength_range": list(glass.wavelength_range) if glass.wavelength_range else None,
            "nd": number(nd(glass)),
            "vd": number(abbe_number(glass)),
            **{name: number(getattr(glass, name)) for name in _FIGURES},
            "wavelengths": self.wavelengths.tolist(),
            "transmittance": numbers(self.transmittance),
            "indices": self.indices.tolist(),
            **({} if air is None else {"temperature": number(air.temperature), "pressure": number(air.pressure)}),
            **{name: numbers(change) for name, change in self._changes().items()},
        }

    def tables(self) -> list[Table]:
        glass, span = self.glass, self.glass.wavelength_range
        source = "MIL code" if glass.formula == "model" else "no catalog"
        expansions = ((glass.expansion, "−30 to 70 °C"), (glass.expansion_20_300, "20 to 300 °C"))
        listed = [f"{figure:g}·10⁻⁶/K from {span}" for figure, span in expansions if figure is not None]
        price = glass.relative_price
        figures = {
            "nd": f"{float(nd(glass)):.7f}",
            "Vd": f"{float(abbe_number(glass)):.4f}",
            "formula": glass.formula,
            "range": f"{span[0]:g} to {span[1]:g} µm" if span else "",
            "expansion": ", ".join(listed),
            "density": "" if glass.density is None else f"{glass.density:g} g/cm³",
            "price": "" if price is None else f"{price:g}, relative to the maker's BK7",
            "transmittance": "internal, of 10 mm, below" if glass.transmittance else "",
        }
        lines = [f"{glass.name}  ({glass.catalog or source})"]
        lines += [f"  {title:13}  {figure or 'not listed'}" for title, figure in figures.items()]
        lines += [f"  {'edition':13}  {sentence}" for sentence in edition(glass)]
        if self.environment is not None:
            where = f"{in_words(self.environment)}, relative to air; dn/dT relative to air, and to vacuum"
            lines.append(f"  {'at':13}  {where}")
        return [Table(self.columns(), [*lines, ""])]


#: Fields of a glass other than its dispersion.
_FIGURES = "expansion", "expansion_20_300", "density", "relative_price"


def glass(
    name: str,
    *,
    wavelengths: Sequence[float] | Tensor | None = None,
    catalogs: Sequence[str | Path] = (),
    temperature: float | Tensor | None = None,
    pressure: float | Tensor | None = None,
) -> GlassFigures:
    """Properties of a glass by its name, as in a lens file, or by a six-digit MIL code.

    wavelengths: µm, by default the lines F, d and C; catalogs: AGF files or names of shipped ones, searched first;
    temperature: °C, pressure: atm: if either is given (defaults 20 °C, 1 atm), indices and wavelengths refer to air in
    that state; n_d and V_d remain those of the catalog.
    Raises UnknownGlass, ImplausibleWavelength, InvalidIndex, ValueError; warns OutOfRange, NoThermalCoefficients.
    """
    medium = mil_glass(name) if re.fullmatch(r"\d{6}", name) else find_glass(name, user=catalogs)
    waves = [LINES[line] for line in "FdC"] if wavelengths is None else wavelengths
    waves = torch.as_tensor(waves, dtype=torch.float64).reshape(-1)
    check_unit(waves, [medium])
    check_wavelengths(medium, waves)
    if temperature is None and pressure is None:
        return GlassFigures(medium, waves, refractive_index(medium, waves), internal_transmittance(medium, waves))
    state = (REFERENCE[0] if temperature is None else temperature, REFERENCE[1] if pressure is None else pressure)
    air = Environment(*(torch.as_tensor(number, dtype=torch.float64) for number in state))
    if wrong := objection(air):
        raise ValueError(f"{name}: {wrong}")
    if unknown := unknown_change(medium, air):
        warnings.warn(unknown, NoThermalCoefficients, stacklevel=calling_level())
    transmittance = internal_transmittance(medium, waves)
    return GlassFigures(medium, waves, index_in(medium, waves, air), transmittance, air, *dn_dt(medium, waves, air))
