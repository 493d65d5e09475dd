"""What an analysis looks at: fields, wavelengths and their weights, as a scene of one object distance."""

import dataclasses

import torch
from torch import Tensor

from raytrace.maths.pupil import gauss_rings
from raytrace.optics.launch import is_at_infinity, object_field
from raytrace.optics.losses import losses
from raytrace.optics.paraxial import first_order
from raytrace.optics.scene import Scene
from raytrace.optics.scene import scene as make_scene
from raytrace.optics.spot import EmptySpot
from raytrace.system.lens import FIELD_UNITS, Lens, check_media, largest_field, name_of_field, with_field_kind


def scene_of(lens: Lens, fields: Tensor | None, wavelengths: Tensor | None) -> Scene:
    """The scene (1, F, W) of the lens at its own object distance; fields (2, F), wavelengths (W,) µm."""
    fields = torch.stack([lens.fields.x, lens.fields.y]) if fields is None else fields
    return make_scene(lens, fields, lens.surfaces[0].thickness[None], wavelengths_of(lens, wavelengths))


def wavelengths_of(lens: Lens, wavelengths: Tensor | None) -> Tensor:
    """The wavelengths (W,) µm: the lens's own, or those given, checked as by `check_media`."""
    if wavelengths is None:
        return lens.wavelengths
    check_media(lens, wavelengths)
    return wavelengths


def wavelength_weights(lens: Lens, wavelengths: Tensor | None) -> Tensor:
    """Shares (W,): the lens's for its own wavelengths, equal ones for others."""
    weights = lens.wavelength_weights if wavelengths is None else torch.ones_like(wavelengths)
    return weights / weights.sum()


def primary_number(lens: Lens, wavelengths: Tensor | None) -> int:
    """Which of the wavelengths is the reference: the lens's primary one, the first of others."""
    return lens.primary_wavelength if wavelengths is None else 0


def field_range(lens: Lens, size: int) -> Tensor:
    """Fields (2, size) along y from the axis to the lens's largest."""
    largest = largest_field(lens)[1, 0]
    y = largest * torch.linspace(0.0, 1.0, size, dtype=largest.dtype, device=largest.device)
    return torch.stack([torch.zeros_like(y), y])


def refuse_dark(lens: Lens, fields: Tensor, wavelengths: Tensor, lit: Tensor, what: str) -> None:
    """Raise EmptySpot that names the first field (2, F) and wavelength (W,) µm without light, and where its rays end.

    lit: (F, W); what: is not defined there.
    """
    if bool(lit.all()):
        return
    f, w = torch.nonzero(~lit)[0].tolist()
    found = losses(lens, gauss_rings(6)[0].to(fields), fields=fields[:, f : f + 1], wavelengths=wavelengths[w : w + 1])
    lost = found.words(0, 0) if int(found.arrived) == 0 else "too few rays reach the sensor"
    where = f"field {name_of_field(fields[:, f])} {FIELD_UNITS[lens.fields.kind]}, {float(wavelengths[w]):g} µm"
    raise EmptySpot(f"{where} has no {what}: {lost}; leave the field out")


def unvignetted(lens: Lens) -> Lens:
    """The lens without vignetting factors, which would bend a curve over the field at every field listed."""
    return dataclasses.replace(lens, fields=dataclasses.replace(lens.fields, vignetting=None))


def in_object_space(lens: Lens, fields: Tensor) -> tuple[Lens, Tensor, Tensor, Tensor]:
    """The lens with fields of a kind that scales with the object, those fields (2, F), and tan θ or mm (2, F).

    And whether they exist (F,): no chief ray may reach a real image height.
    """
    extent, found = object_field(lens, fields, first_order(lens))
    infinite = is_at_infinity(lens)
    described = torch.rad2deg(torch.atan(extent)) if infinite else extent
    kind = "angle" if infinite else "object_height"
    return with_field_kind(lens, kind), described, extent, found
