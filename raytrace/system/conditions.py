"""Conditions: the light that a lens is used with, the size of its beam and its field points."""

from torch import Tensor

from raytrace.maths.value import value

#: Units of a field point by the kind of field.
FIELD_UNITS = {
    "angle": "degrees",
    "object_height": "mm",
    "paraxial_image_height": "mm",
    "real_image_height": "mm",
}

#: How rays find the stop. "auto" is that of a lens, or of a file, that specifies none.
RAY_AIMING = {
    "auto": "real where the axis bends in front of the stop, or the stop is off it; else off",
    "off": "through points of the paraxial entrance pupil",
    "paraxial": "to points of the stop, whose radius is that of the paraxial marginal ray",
    "real": "to points of the stop, whose radius is that of the real marginal ray",
}

#: What the number of a system aperture means.
APERTURE_KINDS = {
    "entrance_pupil_diameter": "mm",
    "image_f_number": "EFL / entrance pupil diameter",
    "paraxial_working_f_number": "paraxial working F/#",
    "object_na": "n sin θ of the marginal ray at the object",
    "object_cone_angle": "degrees, half angle of the marginal ray at the object",
    "float_by_stop": "mm, semi-diameter of the stop",
}


@value
class SystemAperture:
    """The size of the beam: a kind of APERTURE_KINDS and its number."""

    kind: str
    value: Tensor


@value
class Fields:
    """Field points of one kind (a key of FIELD_UNITS), their weights and vignetting factors.

    x, y, weight: (F,) in degrees or mm.
    vignetting: (5, F): decentre VDX, VDY, compression VCX, VCY (pupil fractions) and angle VAN (degrees), or None.
    telecentric: chief rays parallel to the axis in object space.
    """

    kind: str
    x: Tensor
    y: Tensor
    weight: Tensor
    vignetting: Tensor | None = None
    telecentric: bool = False
