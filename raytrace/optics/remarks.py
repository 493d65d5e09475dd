"""Remarks: what a surface is beside a conic, in words for a table and by name for a document."""

import dataclasses
import math

from torch import Tensor

from raytrace.maths.result import number, numbers
from raytrace.system.phases import IdealLens
from raytrace.system.pose import Pose
from raytrace.system.shapes import EVEN, KINDS
from raytrace.system.surface import Surface

#: What phases and departures are called, with their own numbers; of others their kind stands alone.
_WORDS = {
    "Grating": "grating of {frequency:.6g} lines/µm, order {order:g}",
    "RadialPhase": "binary 2 over {radius:.6g} mm, order {order:g}",
    "PolynomialPhase": "binary 1 over {radius:.6g} mm, order {order:g}",
    "FringePhase": "Zernike fringe phase over {radius:.6g} mm, order {order:g}",
    "Hologram": "hologram of {wavelength:g} µm, order {order:g}",
    "Facets": "Fresnel lens",
    "TiltSag": "plane with slopes {tan_x:.6g}, {tan_y:.6g}",
    "PolynomialSag": "x-y polynomial over {radius:.6g} mm",
    "FringeSag": "Zernike fringe sag over {radius:.6g} mm",
    "ZernikeSag": "Zernike sag over {radius:.6g} mm",
    "IrregularSag": "irregular by {spherical:.6g}, {astigmatism:.6g}, {coma:.6g} mm over {radius:.6g} mm",
    "GridSag": "height map, {pitch:.6g} mm apart",
    "SplineSag": "height map, {pitch:.6g} mm apart",
}


def remarks(surface: Surface) -> list[str]:
    """What a surface is beside a conic: its kind of sag, its departure, its phase, and how it stands."""
    found = [*_kind(surface), *(_part(part) for part in (surface.departure, surface.phase) if part is not None)]
    if surface.is_break:
        return [*found, "coordinate break", *_pose(surface.before)]
    for where, pose in (("before", surface.before), ("behind", surface.after)):
        told = _pose(pose)
        found += [f"{where}: {told[0]}", *told[1:]] if told else []
    return found


def entries(surface: Surface) -> dict:
    """The same for a document: keys that only such surfaces have."""
    found: dict = {} if surface.kind == EVEN else {"kind": surface.kind}
    for name in ("departure", "phase"):
        part = getattr(surface, name)
        if part is not None:
            found[name] = {"kind": type(part).__name__, **_fields(part)}
    for name in ("before", "after"):
        if getattr(surface, name) is not None:
            found[name] = _fields(getattr(surface, name))
    return found | ({"is_break": True} if surface.is_break else {})


def _kind(surface: Surface) -> list[str]:
    """The kind of sag, with the numbers that stand before its terms."""
    if surface.coefficients is None:
        return []
    heads = zip(KINDS[surface.kind].heads, surface.coefficients.tolist(), strict=False)
    return [surface.kind, *(_head(name, value) for name, value in heads)]


def _head(name: str, value: float) -> str:
    if name != "curvature_x":
        return f"{name.replace('_', ' ')} {value:.6g}"
    return f"radius x {1 / value:.6g}" if value else "radius x inf"


def _part(part) -> str:
    if isinstance(part, IdealLens):
        return f"ideal lens, f {_focal_lengths(float(part.power_x), float(part.power_y))}"
    scalars = {f.name: getattr(part, f.name) for f in dataclasses.fields(part)}
    scalars = {name: float(one) for name, one in scalars.items() if isinstance(one, Tensor) and one.dim() == 0}
    name = type(part).__name__
    return _WORDS.get(name, name).format(**scalars)


def _focal_lengths(power_x: float, power_y: float) -> str:
    x, y = (1 / power if power else math.inf for power in (power_x, power_y))
    return f"{x:.6g} mm" if x == y else f"{x:.6g} mm in x, {y:.6g} mm in y"


def _pose(pose: Pose | None) -> list[str]:
    if pose is None:
        return []
    decentres = [f"{axis} {float(at):.6g}" for axis in "xyz" if (at := getattr(pose, axis)) is not None]
    tilts = [f"{axis} {float(at):.6g}°" for axis in "xyz" if (at := getattr(pose, f"tilt_{axis}")) is not None]
    parts = [f"decentre {' '.join(decentres)} mm"] if decentres else []
    parts += [f"tilt {' '.join(tilts)}"] if tilts else []
    return [*(reversed(parts) if pose.tilts_first else parts)]


def _fields(part) -> dict:
    found = {field.name: getattr(part, field.name) for field in dataclasses.fields(part)}
    return {name: _plain(one) for name, one in found.items() if one is not None}


def _plain(one):
    if not isinstance(one, Tensor):
        return one
    return number(one) if one.dim() == 0 else numbers(one)
