"""Clear semi-diameters, chip zones and mechanical semi-diameters of a lens, or of some of its surfaces."""

import dataclasses
import math
from collections.abc import Sequence

from raytrace.edit.choice import At, BadEdit, surfaces_at
from raytrace.system.elements import lens_elements
from raytrace.system.lens import Lens
from raytrace.tracing.geometry import fixed_semi_diameters
from raytrace.words import option

#: In place of a length in mm: by the rays, or by the clear semi-diameters.
AUTO = "auto"


def semi_diameters(
    lens: Lens,
    surfaces: At | None = None,
    *,
    clear: float | str | None = None,
    margin: tuple[float, float] | float | None = None,
    chip_zone: float | None = None,
    mechanical: float | str | None = None,
) -> Lens:
    """The lens with its semi-diameters stored: automatic clear ones by the rays of all fields, wavelengths and
    configurations (`Lens.with_semi_diameters`), those of some surfaces as given.

    surfaces: as "3-4", by default all. clear: mm, fixed there; "auto": by the rays. margin: per cent and mm, or per
    cent alone, added to all automatic ones, but for the stop and the image. chip_zone: mm of the polished surface
    beyond the clear semi-diameter, at the faces of glass and the mirrors among the surfaces. mechanical: mm, fixed, of
    the part at these faces; "auto": the largest of the element, or of the cemented group, with its chip zones. None
    leaves what is stored. Raises BadEdit for a negative length, and a mechanical semi-diameter below a clear one.
    """
    last = len(lens.surfaces) - 1
    first, end = (1, last) if surfaces is None else surfaces_at(lens, surfaces)
    chosen = [k for k in range(max(first, 1), end + 1) if not lens.surfaces[k].is_break]
    for name, length in (("clear", clear), ("chip_zone", chip_zone), ("mechanical", mechanical)):
        is_size = length in (None, AUTO) or (not isinstance(length, str) and 0 <= length < math.inf)
        if not is_size or (length == AUTO and name == "chip_zone") or (length == 0 and name != "chip_zone"):
            raise BadEdit(f"semi_diameters: {option(name, str(length))}: expected a length in mm, as 0.5")
    pair = margin if margin is None or isinstance(margin, Sequence) else (margin, 0.0)
    faces = {k for ends in lens_elements(lens) for k in ends if k < last}
    faces |= {k for k, surface in enumerate(lens.surfaces) if surface.is_mirror}
    listed = list(lens.surfaces)
    for k in faces.intersection(chosen):
        if chip_zone is not None:
            listed[k] = dataclasses.replace(listed[k], chip_zone=float(chip_zone) or None)
        if mechanical is not None:
            width = None if isinstance(mechanical, str) else float(mechanical)
            listed[k] = dataclasses.replace(listed[k], mechanical_semi_diameter=width)
    lens, fixed = dataclasses.replace(lens, surfaces=tuple(listed)), None
    if clear is not None:
        for k in chosen:
            lens = lens if isinstance(clear, str) else lens.replace(k, semi_diameter=float(clear))
        others = (k for k in fixed_semi_diameters(lens) if k and k not in chosen)
        fixed = sorted({*others, *([] if isinstance(clear, str) else chosen)})
    try:
        lens = lens.with_semi_diameters(fixed=fixed, margin=pair)
    except ValueError as error:
        raise BadEdit(f"semi_diameters: {error}") from error
    for k, surface in enumerate(lens.surfaces):
        width, size = surface.mechanical_semi_diameter, surface.semi_diameter
        if width is not None and size is not None and width < size:
            raise BadEdit(
                f"semi_diameters: the mechanical semi-diameter of surface {k} is {width:.6g} mm, smaller than its "
                f"clear one, {size:.6g} mm; expected at least as much, or {AUTO}"
            )
    return lens
