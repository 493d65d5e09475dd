"""Paraxial optics: the y-nu trace, focal lengths, pupils, principal planes and conjugates.

A ray is (y, ω) with ω = n u, u = dy/dz the slope and n the *signed* index, negative while light travels towards -z.
"""

import dataclasses
import functools
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from raytrace.maths.numerics import Number, quotient, select, value, value_of
from raytrace.maths.result import Column, Result, Table, flat, quantity_remark, quantity_text
from raytrace.system.lens import (
    Lens,
    aligned,
    is_round_about_axis,
    media,
    shared,
    with_object_distance,
    with_sensor_distance,
)
from raytrace.system.surface import Surface, power, signed, vertex_curvature, ynu

#: A, B, C, D of y′ = A y + B ω, ω′ = C y + D ω.
Matrix = tuple[Number, Number, Number, Number]

#: Lines of a report: text, entry of FirstOrder, unit; further ones are printed of first-order data alone.
LINES = (
    ("effective focal length", "effective_focal_length", "mm"),
    ("back focal distance", "back_focal_distance", "mm, from the last surface before the image"),
    ("front focal distance", "front_focal_distance", "mm, from surface 1"),
    ("F/#", "f_number", "focal length in air / entrance pupil diameter"),
    ("paraxial working F/#", "paraxial_working_f_number", "1/(2 n' u')"),
    ("entrance pupil position", "entrance_pupil_position", "mm, from surface 1"),
    ("entrance pupil diameter", "entrance_pupil_diameter", "mm"),
    ("exit pupil position", "exit_pupil_position", "mm, from the image"),
    ("exit pupil diameter", "exit_pupil_diameter", "mm"),
    ("paraxial image distance", "paraxial_image_distance", "mm, from the last surface before the image"),
    ("magnification", "magnification", ""),
    ("angular magnification", "angular_magnification", "u'/u of the chief ray"),
    ("optical invariant", "optical_invariant", "mm, of the largest field"),
    ("object NA", "object_na", ""),
    ("image NA", "image_na", ""),
    ("Petzval radius", "petzval_radius", "mm"),
)
FURTHER_LINES = (
    ("power", "power", "1/mm"),
    ("height at the stop", "stop_height", "mm, of the marginal ray"),
    ("front principal plane", "front_principal_plane", "mm, from surface 1"),
    ("rear principal plane", "rear_principal_plane", "mm, from the last surface before the image"),
)


@value
class FirstOrder(Result):
    """First-order data of a lens at its primary wavelength or at other ones; every entry (...), mm.

    power: -ω′/y₁ in 1/mm.
    effective_focal_length: -y₁/u′ in image space, u′ taken along the light: positive for a concave mirror.
    back_focal_distance: from the last surface before the image to the rear focal point.
    front_focal_distance: from surface 1 to the front focal point.
    entrance_pupil_position: from surface 1; entrance_pupil_diameter > 0.
    exit_pupil_position: from the image surface; exit_pupil_diameter > 0.
    stop_height: of the marginal ray at the stop; negative where the entrance pupil is an inverted image of the stop.
    f_number: 1/|power| / entrance pupil diameter, which is 1/(2 n′ |u′|) for a distant object;
        paraxial_working_f_number: 1/(2 n′ |u′|) of the marginal ray.
    paraxial_image_distance: from the last surface before the image to the paraxial image of the object.
    magnification: of that image (0 for an object at infinity).
    angular_magnification: ū′/ū of the chief ray, the slopes through the centres of the pupils.
    optical_invariant: |H| = |n (ū y - u ȳ)| of the marginal ray and the chief ray of the largest field, Lagrange's; the
        field of a lens whose fields are image heights is that height in the paraxial image.
    object_na, image_na: n sin θ of the paraxial marginal ray.
    petzval_radius: radius of the Petzval surface, signed like a surface's.
    front_principal_plane, rear_principal_plane: from surface 1, and from the last surface before the image.
    length: of all thicknesses from surface 1 to the image, no column; telecentric: whether the fields are those of a
        telecentric object space.
    """

    power: Tensor
    effective_focal_length: Tensor
    back_focal_distance: Tensor
    front_focal_distance: Tensor
    entrance_pupil_position: Tensor
    entrance_pupil_diameter: Tensor
    exit_pupil_position: Tensor
    exit_pupil_diameter: Tensor
    stop_height: Tensor
    f_number: Tensor
    paraxial_working_f_number: Tensor
    paraxial_image_distance: Tensor
    magnification: Tensor
    angular_magnification: Tensor
    optical_invariant: Tensor
    object_na: Tensor
    image_na: Tensor
    petzval_radius: Tensor
    front_principal_plane: Tensor
    rear_principal_plane: Tensor
    length: Tensor
    telecentric: bool = False

    def columns(self) -> dict[str, Tensor]:
        """A row for each wavelength and lens."""
        names = (entry.name for entry in dataclasses.fields(self))
        return {name: getattr(self, name) for name in names if name not in ("length", "telecentric")}

    def column(self, name: str) -> Column:
        unit = next(unit for _, entry, unit in (*LINES, *FURTHER_LINES) if entry == name)
        return Column(name, next((length for length in ("1/mm", "mm") if unit.startswith(length)), ""))

    def infinite(self) -> dict[str, str]:
        """Entries that are infinite in practice, and the word of it; of several lenses those that are so in all.

        effective_focal_length: "afocal", and focal distances and principal planes "infinite"; entrance_pupil_position:
        "telecentric", chief rays are parallel in object space; exit_pupil_position: "telecentric", in image space, and
        its diameter "infinite". Lengths are compared with that of the lens.
        """
        limits = {"effective_focal_length": _AFOCAL, "entrance_pupil_position": _FAR, "exit_pupil_position": _FAR}
        reach = self.length.detach().clamp(min=1.0)
        far = {name for name, limit in limits.items() if bool((getattr(self, name).abs() > limit * reach).all())}
        far |= {"entrance_pupil_position"} if self.telecentric else set()
        words = {name: "telecentric" for name in limits if name in far}
        if "effective_focal_length" in words:
            words["effective_focal_length"] = "afocal"
            lengths = ("back_focal_distance", "front_focal_distance", "front_principal_plane", "rear_principal_plane")
            words |= dict.fromkeys(lengths, "infinite")
        if "exit_pupil_position" in words:
            words["exit_pupil_diameter"] = "infinite"
        return words

    @property
    def telecentric_spaces(self) -> list[str]:
        """The spaces, "object" and "image", in which chief rays are parallel."""
        spaces = {"entrance_pupil_position": "object", "exit_pupil_position": "image"}
        return [spaces[name] for name in self.infinite() if name in spaces]

    def tables(self) -> list[Table]:
        """A line for each quantity: its number, of several lenses or wavelengths the least and the largest."""
        figures, infinite = flat(self.columns()), self.infinite()
        lines, count = (*LINES, *FURTHER_LINES), len(figures["power"])
        ends = {"": min} if count == 1 else {"least": min, "largest": max}
        printed: dict = {Column("quantity", form="<", heading=" "): [words for words, *_ in lines]}
        for name, end in ends.items():
            texts = (quantity_text(end(figures[entry]), infinite.get(entry)) for _, entry, _ in lines)
            printed[Column(name, form=">")] = [*texts]
        computed = {entry: figures[entry][0] if count == 1 else float("inf") for _, entry, _ in lines}
        units = [unit + quantity_remark(computed[entry], infinite.get(entry)) for _, entry, unit in lines]
        printed[Column("unit", form="<", heading=" ")] = units
        return [Table(printed, [f"first-order data of {count} lenses or wavelengths"] if count > 1 else ())]


#: Pupils so many lengths of the lens away are at infinity, and focal lengths so many are those of an afocal lens.
_FAR, _AFOCAL = 1e3, 1e4


def brackets(powers: Sequence[Number], gaps: Sequence[Number]) -> Matrix:
    """(A, B, C, D) with y′ = A y + B ω, ω′ = C y + D ω; arguments as for `ynu`. Gauss's brackets (Herzberger 1943)."""
    (A, C), (B, D) = (ynu(y, omega, powers, gaps)[-1] for y, omega in ((1.0, 0.0), (0.0, 1.0)))
    return A, B, C, D


@dataclasses.dataclass(frozen=True)
class Gaussian:
    """System matrices of a lens at one wavelength, and the first-order data that follow; tensors or dual numbers.

    A, B, C, D: y′ = A y + B ω, ω′ = C y + D ω from surface 1 to behind the last surface before the image; front: A and
    B to the vertex of the stop; from_stop: computes B and D from the stop; n_object, n_image: signed indices. vergence:
    n over the object distance, 0 for an object at infinity. Source: Welford, Aberrations, ch. 3.
    """

    A: Number
    B: Number
    C: Number
    D: Number
    front: tuple[Number, Number]
    from_stop: Callable[[], tuple[Number, Number]]
    n_object: Number
    n_image: Number

    @functools.cached_property
    def rear(self) -> tuple[Number, Number]:
        """B and D from the stop to behind the last surface before the image."""
        return self.from_stop()

    @property
    def effective_focal_length(self) -> Number:
        return quotient(-abs(self.n_image), self.C)

    @property
    def focal_length_in_air(self) -> Number:
        """1/power, mm, signed as the effective focal length, which is longer by the index of image space."""
        return quotient(-1.0, self.C)

    @property
    def entrance_pupil_position(self) -> Number:
        """mm from surface 1."""
        return self.n_object * self.front[1] / self.front[0]

    @property
    def exit_pupil_distance(self) -> Number:
        """mm from the last surface before the image."""
        return quotient(-self.n_image * self.rear[0], self.rear[1])

    @property
    def pupil_magnification(self) -> Number:
        """Diameter of the exit pupil over that of the entrance pupil."""
        return abs(quotient(self.front[0], self.rear[1]))

    @property
    def angular_magnification(self) -> Number:
        return quotient(self.n_object * self.rear[1], self.n_image * self.front[0])

    def omega_behind(self, vergence: Number) -> Number:
        """ω′ per mm of height at surface 1 of an axial ray."""
        return self.C + self.D * vergence

    def image_distance(self, vergence: Number) -> Number:
        return quotient(-self.n_image * (self.A + self.B * vergence), self.omega_behind(vergence))

    def magnification(self, vergence: Number) -> Number:
        return quotient(vergence, self.omega_behind(vergence))

    def pupil_reach(self, vergence: Number) -> Number:
        """Height of an axial ray in the entrance pupil per mm of height at surface 1."""
        return 1 + self.entrance_pupil_position * vergence / self.n_object

    def entrance_pupil_diameter(
        self, kind: str, number: Number, distance: Number, vergence: Number, tan_cone: Number
    ) -> Number:
        """The diameter in mm that an aperture means; distance: mm, of the object; tan_cone: of its half angle there."""
        if kind == "entrance_pupil_diameter":
            return number
        if kind == "image_f_number":
            return abs(self.focal_length_in_air) / number
        if kind == "float_by_stop":
            return 2 * number / abs(self.front[0])
        if kind == "paraxial_working_f_number":
            slope = 0.5 / (number * abs(self.n_image))
            return 2 * abs(slope * self.n_image / self.omega_behind(vergence) * self.pupil_reach(vergence))
        return 2 * abs((distance + self.entrance_pupil_position) * tan_cone)

    def marginal_height(
        self, kind: str, diameter: Number, distance: Number, vergence: Number, tan_cone: Number
    ) -> Number:
        """Height in mm at surface 1 of the ray from the axial object point through the edge of the entrance pupil.

        The cone of an object NA or angle needs no pupil, which may lie at infinity.
        """
        reach = self.pupil_reach(vergence)
        if kind not in CONES:
            return 0.5 * diameter / reach
        height = abs(distance * tan_cone)
        return select(value_of(reach) < 0, -height, height)


#: Kinds of aperture that are given at the object.
CONES = "object_na", "object_cone_angle"


def field_scale(
    kind: str, *, at_infinity: bool, distance: Number, entrance_pupil: Number, power: Number, magnification: Number
) -> Number:
    """Slope of the chief ray at the object, or object height in mm, per tan θ or per mm of a field of some kind.

    kind: of `Fields`; power: -C/n of the object space, for an object at infinity; magnification: for a finite one.
    """
    if kind == "angle":
        return 1.0 if at_infinity else -(distance + entrance_pupil)
    if kind == "object_height":
        return 1.0
    return power if at_infinity else 1 / magnification


def chief_ray(
    extent: Number, *, at_infinity: bool, distance: Number, entrance_pupil: Number, parallel: bool
) -> tuple[Number, Number]:
    """(ȳ, ū) before surface 1 of a field whose extent is a slope, or an object height in mm.

    parallel: the entrance pupil of a finite object is at infinity.
    """
    if at_infinity:
        return -entrance_pupil * extent, extent
    if parallel:
        return extent, 0.0 * extent
    slope = -extent / (distance + entrance_pupil)
    return -entrance_pupil * slope, slope


def petzval_sum(curvatures: Sequence[Number], indices: Sequence[Number]) -> Number:
    """Σ c (n′ - n)/(n n′) in 1/mm; indices: signed, one more than curvatures. Any number type."""
    pairs = zip(curvatures, indices[:-1], indices[1:], strict=True)
    return sum(c * ((behind - before) / (before * behind)) for c, before, behind in pairs)


def system_matrix(
    surfaces: Sequence[Surface],
    indices: Sequence[Tensor],
    wavelength: Tensor | None = None,
) -> Matrix:
    """(A, B, C, D) with y′ = A y + B ω, ω′ = C y + D ω from the first vertex, before it, to behind the last surface.

    The axis is straightened: tilts, decentres and the mean slope of a grating are ignored, and a surface of different
    powers along x and y counts by its section along y. indices: signed, len(surfaces) + 1, entries (...); wavelength:
    (...) µm, which surfaces with a phase need. C is minus the power; AD - BC = 1.
    """
    powers, gaps = _powers_and_gaps(surfaces, indices, wavelength)
    return _matrices(powers, gaps[:-1], indices[0], -1)[0]


def _powers_and_gaps(
    surfaces: Sequence[Surface], indices: Sequence[Tensor], wavelength: Tensor | None
) -> tuple[list[Tensor], list[Tensor]]:
    """Powers in 1/mm of surfaces, and t/n behind each."""
    pairs = zip(surfaces, indices[:-1], indices[1:], strict=True)
    gaps = [surface.thickness / n for surface, n in zip(surfaces, indices[1:], strict=True)]
    return [power(surface, before, behind, wavelength) for surface, before, behind in pairs], gaps


def _matrices(powers: Sequence[Tensor], gaps: Sequence[Tensor], like: Tensor, *before: int) -> list[Matrix]:
    """(A, B, C, D) up to before some surfaces, from 0, -1 behind the last one: `ynu` of two rays at once."""
    axes = max(number.dim() for number in (like, *powers, *gaps))
    y, ones = like.new_tensor([1.0, 0.0]).reshape(2, *[1] * axes), torch.ones_like(like)
    rays, matrices = ynu(y, y.flip(0), powers, gaps), []
    for k in before:
        (A, B), (C, D) = (ones * part for part in rays[k])
        matrices.append((A, B, C, D))
    return matrices


def gaussian(lens: Lens, n: Sequence[Tensor], wavelength: Tensor) -> Gaussian:
    """The system matrices of a lens; n: signed indices (...) from the object's to that before the image."""
    surfaces, stop = lens.surfaces[1:-1], lens.stop - 1
    powers, gaps = _powers_and_gaps(surfaces, n, wavelength)

    def from_stop() -> tuple[Tensor, Tensor]:
        ((_, B, _, D),) = _matrices(powers[stop:], gaps[stop:-1], n[0], -1)
        return B, D

    (A, B, C, D), front = _matrices(powers, gaps[:-1], n[0], -1, stop)
    return Gaussian(A, B, C, D, front[:2], from_stop, n[0], n[-1])


@value
class Beam:
    """The axial beam of a lens at one wavelength: the first-order data of which rays start; every entry (...), mm.

    Entries as in `FirstOrder`. vergence: signed index over the object distance, 0 for an object at infinity.
    """

    data: Gaussian
    vergence: Tensor
    entrance_pupil_diameter: Tensor

    @property
    def entrance_pupil_position(self) -> Tensor:
        return self.data.entrance_pupil_position

    @property
    def stop_height(self) -> Tensor:
        return 0.5 * self.entrance_pupil_diameter * self.data.front[0]

    @property
    def power(self) -> Tensor:
        return -self.data.C

    @property
    def magnification(self) -> Tensor:
        return self.data.magnification(self.vergence)


@shared
def axial_beam(lens: Lens, wavelength: Tensor | None = None) -> Beam:
    """The axial beam; wavelength: (...) µm, the primary one by default."""
    wavelength = lens.primary if wavelength is None else wavelength
    lens = aligned(lens, wavelength.dim()) if wavelength.dim() else lens
    data = gaussian(lens, signed(lens.surfaces[1:-1], media(lens, wavelength)[:-1]), wavelength)
    vergence = data.n_object / object_distance_of(lens)
    kind, distance = lens.aperture.kind, lens.surfaces[0].thickness
    tan_cone = _tan_cone(lens, data.n_object)
    diameter = data.entrance_pupil_diameter(kind, lens.aperture.value, distance, vergence, tan_cone)
    if kind == "entrance_pupil_diameter":
        diameter = diameter * torch.ones_like(data.A)
    return Beam(data, vergence, diameter)


@shared
def first_order(lens: Lens, wavelength: Tensor | None = None) -> FirstOrder:
    """First-order data; wavelength: (...) µm, the primary one by default. Source: Welford, Aberrations, ch. 3.

    A quantity that does not exist, such as the focal length of an afocal lens, is infinite.
    """
    wavelength = lens.primary if wavelength is None else wavelength
    beam = axial_beam(lens, wavelength)
    lens = aligned(lens, wavelength.dim()) if wavelength.dim() else lens
    surfaces = lens.surfaces[1:-1]
    n = signed(surfaces, media(lens, wavelength)[:-1])
    data, diameter, vergence = beam.data, beam.entrance_pupil_diameter, beam.vergence
    n_object, n_image = data.n_object, data.n_image
    A, C, D, focal_length = data.A, data.C, data.D, data.effective_focal_length
    kind, distance, tan_cone = lens.aperture.kind, object_distance_of(lens), _tan_cone(lens, n_object)
    scale = data.marginal_height(kind, diameter, distance, vergence, tan_cone)
    slope_object, slope_image = scale * vergence / n_object, scale * data.omega_behind(vergence) / n_image
    # |n ū y| at the entrance pupil, |n u h| at the object or |n′ u′ h′| at the image, by the kind of field.
    largest = torch.hypot(*largest_field(lens))[0]
    if lens.fields.kind == "angle":
        invariant = n_object * (0.5 * diameter) * torch.tan(torch.deg2rad(largest))
    else:
        at_object = lens.fields.kind == "object_height"
        invariant = (n_object * slope_object if at_object else n_image * slope_image) * largest
    # Of an entrance pupil at infinity the exit pupil is as large as the axial beam there.
    finite, exit_distance = torch.isfinite(diameter), data.exit_pupil_distance
    width = 2 * (scale * (A + data.B * vergence) + slope_image * exit_distance).abs()
    exit_diameter = torch.where(finite, torch.where(finite, diameter, 1.0) * data.pupil_magnification, width)
    petzval = petzval_sum([vertex_curvature(s) for s in surfaces], n) * torch.ones_like(n_object)
    return FirstOrder(
        power=beam.power,
        effective_focal_length=focal_length,
        back_focal_distance=-n_image * A / C,
        front_focal_distance=n_object * D / C,
        entrance_pupil_position=data.entrance_pupil_position,
        entrance_pupil_diameter=diameter,
        exit_pupil_position=exit_distance - surfaces[-1].thickness,
        exit_pupil_diameter=exit_diameter,
        stop_height=beam.stop_height,
        f_number=abs(data.focal_length_in_air) / diameter,
        paraxial_working_f_number=0.5 / (n_image * slope_image).abs(),
        paraxial_image_distance=data.image_distance(vergence),
        magnification=beam.magnification,
        angular_magnification=data.angular_magnification,
        optical_invariant=invariant.abs(),
        object_na=(n_object * torch.sin(torch.atan(slope_object))).abs(),
        image_na=(n_image * torch.sin(torch.atan(slope_image))).abs(),
        petzval_radius=-1 / (n_image * petzval),
        front_principal_plane=n_object * (D - 1) / C,
        rear_principal_plane=n_image * (1 - A) / C,
        length=sum((surface.thickness.abs() for surface in surfaces), torch.zeros_like(n_object)),
        telecentric=lens.fields.telecentric,
    )


def object_distance_of(lens: Lens) -> Tensor:
    """The distance (...) mm of the object; for an object at surface 1 the smallest one that can be divided by."""
    distance = lens.surfaces[0].thickness
    return torch.where(distance == 0, torch.finfo(distance.dtype).tiny ** 0.5, distance)


def largest_field(lens: Lens) -> Tensor:
    """The field point (2, 1) along y at the distance of the lens's outermost field point from the axis, in its unit.

    In a lens without rotational symmetry it is the outermost field point itself.
    """
    if is_round_about_axis(lens):
        extent = lens.fields.extent
        return torch.stack([torch.zeros_like(extent), extent])[:, None]
    outermost = torch.hypot(lens.fields.x, lens.fields.y).argmax()
    return torch.stack([lens.fields.x[outermost], lens.fields.y[outermost]])[:, None]


def marginal_ray(lens: Lens) -> tuple[Tensor, Tensor]:
    """(y, ω) in mm and 1 of the marginal ray in front of surface 1, at the primary wavelength."""
    beam, kind, distance = axial_beam(lens), lens.aperture.kind, lens.surfaces[0].thickness
    tan_cone = _tan_cone(lens, beam.data.n_object)
    y = beam.data.marginal_height(kind, beam.entrance_pupil_diameter, distance, beam.vergence, tan_cone)
    return y, y * beam.vergence


def paraxial_image_distance(lens: Lens, object_distance: Tensor, wavelength: Tensor | None = None) -> Tensor:
    """Paraxial image distance (...) mm from the last surface before the image; object_distance: (...) mm or inf."""
    wavelength = lens.primary if wavelength is None else wavelength
    n = signed(lens.surfaces[1:-1], media(lens, wavelength)[:-1])
    return gaussian(lens, n, wavelength).image_distance(n[0] / object_distance)


def at_magnification(lens: Lens, magnification: Tensor | float, *, keep_sensor: bool) -> Lens:
    """The lens with its object where the paraxial image has a magnification, and the sensor in that image.

        d = n (1/m - D)/C,   A, B, C, D from surface 1 to behind the last surface before the image

    keep_sensor: leave the sensor where it is. Raises ValueError for 0, an afocal lens, and where object or image are
    virtual.
    """
    data = axial_beam(lens).data
    m = torch.as_tensor(magnification, dtype=data.A.dtype, device=data.A.device)
    if not bool(torch.isfinite(m).all()) or not bool((m != 0).all()):
        raise ValueError(f"magnification {magnification}: expected a number other than 0, such as -0.1; "
            "0 is an object at infinity, object_distance=inf")  # fmt: skip
    if not bool((data.C != 0).all()):
        raise ValueError("magnification: an afocal lens has the same one for every object; give object_distance")
    distance = data.n_object * (1 / m - data.D) / data.C
    image = data.image_distance(data.n_object / torch.where(distance == 0, torch.nan, distance))
    side = torch.sign(data.n_image)
    if not bool((distance > 0).all()) or not bool((side * image > 0).all()):
        least, behind = (float(each.detach().min()) for each in (distance, side * image))
        place = "behind surface 1" if least <= 0 else f"whose image, at {behind:.6g} mm, is virtual"
        sign = "negative" if float(data.C.detach().min()) < 0 else "other"
        raise ValueError(
            f"magnification {float(m.detach().min()):g} needs an object at {least:.6g} mm, {place}; "
            f"a real object and image have {sign} ones"
        )
    shape = () if lens.count is None else (-1,)
    lens = with_object_distance(lens, distance.reshape(shape))
    return lens if keep_sensor else with_sensor_distance(lens, image.reshape(shape))


def cone_angle(lens: Lens, n_object: Tensor) -> Tensor:
    """Half angle of the cone at the object, radians, of an aperture given as object NA or cone angle."""
    kind, number = lens.aperture.kind, lens.aperture.value
    return torch.asin(number / n_object) if kind == "object_na" else torch.deg2rad(number)


def _tan_cone(lens: Lens, n_object: Tensor) -> Tensor | None:
    return torch.tan(cone_angle(lens, n_object)) if lens.aperture.kind in CONES else None
