"""`raytrace glass`."""

import argparse
import re

import torch

from raytrace.cli.door import catalogs, print_json
from raytrace.maths.result import number
from raytrace.media.catalog import edition, find_glass
from raytrace.media.glass import LINES, abbe_number, check_wavelengths, mil_glass, nd, refractive_index
from raytrace.system.lens import check_unit


def glass(arguments: argparse.Namespace) -> None:
    """Index, nd, Vd, formula, range and catalog of one glass."""
    is_code = re.fullmatch(r"\d{6}", arguments.name) is not None
    found = mil_glass(arguments.name) if is_code else find_glass(arguments.name, user=catalogs(arguments))
    asked = arguments.wavelength or [LINES[line] for line in "FdC"]
    wavelengths = torch.tensor(asked, dtype=torch.float64)
    check_unit(wavelengths, [found])
    check_wavelengths(found, wavelengths)
    indices = refractive_index(found, wavelengths).tolist()
    if arguments.json:
        print_json(
            {
                "name": found.name,
                "catalog": found.catalog or None,
                "edition": list(edition(found)),
                "formula": found.formula,
                "coefficients": found.coefficients.tolist(),
                "wavelength_range": list(found.wavelength_range) if found.wavelength_range else None,
                "nd": number(nd(found)),
                "vd": number(abbe_number(found)),
                "wavelengths": asked,
                "indices": indices,
            }
        )
        return
    span = found.wavelength_range
    print(f"{found.name}  ({found.catalog or ('MIL code' if is_code else 'no catalog')})")
    print(f"  nd       {float(nd(found)):.7f}")
    print(f"  Vd       {float(abbe_number(found)):.4f}")
    print(f"  formula  {found.formula}")
    print(f"  range    {span[0]:g} to {span[1]:g} µm" if span else "  range    not listed")
    for sentence in edition(found):
        print(f"  edition  {sentence}")
    for wavelength, index in zip(asked, indices, strict=True):
        print(f"  n({wavelength:g} µm) = {index:.10f}")
