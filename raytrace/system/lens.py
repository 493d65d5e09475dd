"""Lens: surfaces, stop, aperture, fields and wavelengths, as one value."""

import contextlib
import dataclasses
import functools
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextvars import ContextVar
from typing import TYPE_CHECKING, Any, NoReturn, ParamSpec, TypeVar

import torch
from torch import Tensor
from torch.utils import _pytree as pytree

from raytrace.materials.catalogs import medium
from raytrace.materials.environment import (
    REFERENCE,
    Environment,
    NoThermalCoefficients,
    index_in,
    objection,
    unknown_change,
)
from raytrace.materials.glass import Glass, check_unit, check_wavelengths, is_air, label, refractive_index
from raytrace.materials.mounts import expansion_of
from raytrace.maths.numerics import broadcast_shape, check_precision, holds_numbers, in_transform, is_any, value, varies
from raytrace.maths.result import point_text
from raytrace.system import configurations as multiple
from raytrace.system.apertures import SHAPES
from raytrace.system.configurations import Operand, ScaledPath
from raytrace.system.expansion import expanded, growth, in_contact, spaces, unexpanded
from raytrace.system.optimization_data import OptimizationData, Row, Solve, Vary
from raytrace.system.poses import Pose
from raytrace.system.shapes import KINDS
from raytrace.system.surface import SIZES, Surface, is_posed, is_round, medium_surfaces
from raytrace.words import both_spellings, calling_level, did_you_mean, option

if TYPE_CHECKING:
    from raytrace.optimization.conditions import Condition

#: Units of a field point by the kind of field.
FIELD_UNITS = dict(angle="degrees", object_height="mm", paraxial_image_height="mm", real_image_height="mm")

#: How rays find the stop. "auto" is that of a lens, or of a file, that specifies none.
RAY_AIMING = {
    "auto": "real where the axis bends in front of the stop, or the stop is off it; else off",
    "off": "through points of the paraxial entrance pupil",
    "paraxial": "to points of the stop, whose radius is that of the paraxial marginal ray",
    "real": "to points of the stop, whose radius is that of the real marginal ray",
}

#: The unit and meaning of the number of a system aperture.
APERTURE_KINDS = {
    "entrance_pupil_diameter": "mm",
    "image_f_number": "EFL in air / entrance pupil diameter",
    "paraxial_working_f_number": "paraxial working F/#",
    "object_na": "n sin θ of the marginal ray at the object",
    "object_cone_angle": "degrees, half angle of the marginal ray at the object",
    "float_by_stop": "mm, semi-diameter of the stop",
}

# -- results that several analyses of a lens share ---------------------------------------------------------------------

P = ParamSpec("P")
#: Radii of contact, mm, of surfaces of a lens by their numbers: `tracing.geometry.contact_heights`.
Contact = Callable[["Lens", Sequence[int]], dict[int, Tensor]]
T = TypeVar("T")
_results: ContextVar[dict | None] = ContextVar("results", default=None)
_MOST = 256  # results; the oldest is dropped first
_FEW = 64  # numbers of an argument that are compared


@contextlib.contextmanager
def computed_once() -> Iterator[None]:
    """Within the block, indices, first-order data, base rays and stop radius of every lens are computed once.

    Results that may be differentiated are computed anew. No number of a lens may be changed in place within the block.
    Every public function of a lens runs within such a block, which functions that it calls share.
    """
    if _results.get() is not None:
        yield
        return
    token = _results.set({})
    try:
        yield
    finally:
        _results.reset(token)


def shared(compute: Callable[P, T]) -> Callable[P, T]:
    """A function of a lens, and of wavelengths, whose result is shared within `computed_once`."""

    @functools.wraps(compute)
    def result(*arguments: P.args, **options: P.kwargs) -> T:
        # torch.compile does not trace context variables; results within a transform belong to it.
        if torch.compiler.is_compiling() or options or (results := _results.get()) is None or in_transform():
            return compute(*arguments, **options)
        if any(_is_not_shared(argument, results) for argument in arguments):
            return compute(*arguments, **options)
        key = compute, *map(_key, arguments)
        if key not in results:
            _store(results, key, compute(*arguments, **options), arguments)
        return results[key][0]

    return result


def _store(results: dict, key: object, result: object, arguments: object) -> None:
    """Stores a result with its arguments: an object that lives shares its identity with no other."""
    if len(results) >= _MOST:
        del results[next(iter(results))]
    results[key] = result, arguments


def _is_not_shared(argument: object, results: dict) -> bool:
    """Whether results of an argument are not shared: many wavelengths, or a number that may be differentiated."""
    if isinstance(argument, Tensor):
        return argument.numel() > _FEW or varies(argument)
    if id(argument) not in results:
        _store(results, id(argument), any(map(varies, pytree.tree_leaves(argument))), argument)
    return results[id(argument)][0]


def _key(argument: object) -> object:
    """A lens by its identity, wavelengths by their values, or by their identity on another device."""
    if isinstance(argument, Tensor) and argument.device.type == "cpu":
        return argument.dtype, *argument.shape, *argument.flatten().tolist()
    return id(argument)


# -- batches of lenses -------------------------------------------------------------------------------------------------
# The axis of the lenses follows the axes that a number has in one lens, as the terms of an asphere. `aligned`
# puts axes of 1 behind it, against which fields, wavelengths and pupil points broadcast: rays (3, L, F, W, P).

#: The values whose numbers may differ between lenses, and the axes that some of these have in one lens.
_OWN_AXES: dict[str, dict[str, int]] = {
    **{name: {"coefficients": 1} for name in ("Surface", "Glass", "ZernikeSag", "FringeSag", "PolynomialSag")},
    **{name: {"coefficients": 1} for name in ("PowerSag", "RadialPhase", "PolynomialPhase", "FringePhase")},
    **{name: {"coefficients": 1} for name in ("PolynomialPath", "RadialPath")},
    **{name: {"first": 1, "second": 1} for name in ("Hologram", "HologramPath")},
    **{name: {} for name in ("Pose", "Environment", "SystemAperture", "IrregularSag", "TiltSag")},
    **{name: {} for name in ("Grating", "IdealLens")},
    "GridSag": {"heights": 2},
    "SplineSag": {"coefficients": 2},
    "Turn": {"rotation": 2, "shift": 1},
}

#: The parts of a lens whose numbers may differ between the lenses of a batch.
_PARTS = ("surfaces", "aperture", "environment")


def lens_count(lens: "Lens") -> int | None:
    """L, the number of lenses that a batch describes; None for a single lens.

    Raises ValueError for numbers of different counts.
    """
    counts: dict[int, str] = {}
    for number, axes, name, surface in _numbers(lens):
        if number.dim() > axes and number.shape[axes] not in counts:
            counts[number.shape[axes]] = name if surface is None else f"surface {surface}: {name.replace('_', ' ')}"
    several = [count for count in counts if count != 1]
    if len(several) > 1:
        first, second, *_ = several
        raise ValueError(
            f"{counts[first]} has numbers of {first} lenses, {counts[second]} of {second}; expected as many, or one"
        )
    return next(iter(several or counts), None)


def batch_shape(lens: "Lens") -> torch.Size:
    """The shape (L, 1, …) that the numbers of an `aligned` batch broadcast to; () of a single lens."""
    return broadcast_shape(*{number.shape[axes:] for number, axes, *_ in _numbers(lens)})


@shared
def aligned(lens: "Lens", axes: int, *, exactly: bool = False) -> "Lens":
    """The lens with numbers (…, L) of a batch as (…, L, 1, …), with at least, or exactly, `axes` axes of 1 behind.

    A number that is common to all lenses, or has the axes, stays the same tensor.
    """

    def align(number: Tensor, inner: int) -> Tensor:
        missing = inner + 1 + axes - number.dim()
        if number.dim() <= inner or missing == 0 or (missing < 0 and not exactly):
            return number
        return number.reshape(*number.shape[: inner + 1], *(1,) * axes)

    return _mapped(lens, align)


def per_lens(number: Tensor) -> Tensor:
    """A number of one lens (), or of L lenses (L,) as (L, 1, 1, 1)."""
    return number.reshape(-1, 1, 1, 1) if number.dim() else number


def one_lens(lens: "Lens", number: int | slice | Tensor) -> "Lens":
    """Lens `number` of a batch, from 0; of a slice or of a tensor of numbers, a batch of them.

    Raises TypeError for a single lens, IndexError beyond the last lens.
    """
    count = lens_count(lens)
    if count is None:
        raise TypeError("a single lens, not a batch of lenses: no number has the shape (L,)")
    if isinstance(number, int) and not -count <= number < count:
        raise IndexError(f"lens {number} of a batch of {count} lenses; expected 0 to {count - 1}")

    def take(entries: Tensor, axes: int) -> Tensor:
        if entries.dim() <= axes or (entries.shape[axes] == 1 and not isinstance(number, int)):
            return entries
        return entries[(*(slice(None),) * axes, 0 if entries.shape[axes] == 1 else number)]

    return _mapped(lens, take)


def batch(lenses: Sequence["Lens"]) -> "Lens":
    """One batch of several lenses that differ in their numbers alone.

    A number that is equal in all of them stays single. Raises ValueError for no lenses, and for lenses of different
    structure: other surfaces, glass formulas, apertures.
    """
    if not lenses:
        raise ValueError("a batch of no lenses; expected one or more")
    if any(lens_count(lens) is not None for lens in lenses):
        raise ValueError("a lens of the batch is a batch itself; expected single lenses")
    parts = [{name: part for name in _PARTS if (part := getattr(lens, name)) is not None} for lens in lenses]
    flat = [pytree.tree_flatten(held) for held in parts]
    leaves, structures = zip(*flat, strict=True)
    for k, (numbers, structure) in enumerate(zip(leaves, structures, strict=True)):
        if structure != structures[0] or [n.shape for n in numbers] != [n.shape for n in leaves[0]]:
            raise ValueError(f"lens {k} has other surfaces, glasses or apertures than lens 0; expected other numbers")
    rows = {id(column[0]): column for column in zip(*leaves, strict=True)}

    def join(number: Tensor, axes: int) -> Tensor:
        column = rows[id(number)]
        if all(entry is number or (not entry.requires_grad and torch.equal(entry, number)) for entry in column):
            return number
        return torch.stack(column, axes)

    return _mapped(lenses[0], join)


@functools.cache
def _fields_of(kind: type) -> tuple[tuple[str, int], ...]:
    """The fields of a value that hold numbers of a batch, and the axes that these have in one lens."""
    axes = _OWN_AXES.get(kind.__name__)
    if axes is None:
        return ()
    return tuple(
        (field.name, axes.get(field.name, 0)) for field in dataclasses.fields(kind) if holds_numbers(field.type)
    )


def _numbers(lens: "Lens") -> Iterator[tuple[Tensor, int, str, int | None]]:
    """Every number that may differ between lenses: its axes in one lens, name, and surface, None of the whole lens."""

    def walk(part: object, surface: int | None) -> Iterator[tuple[Tensor, int, str, int | None]]:
        kind: type = type(part)
        for name, axes in _fields_of(kind):
            entry = getattr(part, name)
            if isinstance(entry, Tensor):
                yield entry, axes, name, surface
            elif entry is not None:
                yield from walk(entry, surface)

    yield from walk(lens.aperture, None)
    yield from walk(lens.environment, None)
    for k, surface in enumerate(lens.surfaces):
        yield from walk(surface, k)


def _mapped(lens: "Lens", change: Callable[[Tensor, int], Tensor]) -> "Lens":
    """The lens with changed numbers; change: number, its axes in one lens -> number.

    A number that occurs in several places (the coefficients of air, say) stays one.
    """
    made: dict[int, Tensor] = {}

    def walk(part: Any) -> Any:
        kind: type = type(part)
        changes: dict[str, Any] = {}
        for name, axes in _fields_of(kind):
            before = getattr(part, name)
            if isinstance(before, Tensor):
                if id(before) not in made:
                    made[id(before)] = change(before, axes)
                after: Any = made[id(before)]
            else:
                after = before if before is None else walk(before)
            if after is not before:
                changes[name] = after
        return dataclasses.replace(part, **changes) if changes else part

    parts = {name: walk(getattr(lens, name)) for name in ("aperture", "environment")}
    surfaces = tuple(map(walk, lens.surfaces))
    if any(after is not before for after, before in zip(surfaces, lens.surfaces, strict=True)):
        parts["surfaces"] = surfaces
    changes = {name: part for name, part in parts.items() if part is not getattr(lens, name)}
    return dataclasses.replace(lens, **changes) if changes else lens


# -- the lens ----------------------------------------------------------------------------------------------------------


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

    @property
    def unit(self) -> str:
        """The unit of field points."""
        return FIELD_UNITS[self.kind]

    @property
    def extent(self) -> Tensor:
        """() distance of the outermost field from the axis, in that unit."""
        return torch.hypot(self.x, self.y).amax()


#: Names that a lens lacks: methods of torch's modules and tensors, first-order data; the function in their place.
_ELSEWHERE = {
    **dict.fromkeys(
        ("to", "cpu", "cuda", "float", "double", "dtype", "device"),
        "; `rt.to(lens, dtype=…, device=…)` converts it, and its tensors have dtype and device",
    ),
    **dict.fromkeys(
        ("parameters", "named_parameters", "requires_grad_", "train", "state_dict", "load_state_dict"),
        '; it is a value: `rt.Variables(lens, "curvature thickness")` is the module of its numbers',
    ),
    **dict.fromkeys(("efl", "focal_length", "effective_focal_length"), "; rt.first_order(lens).effective_focal_length"),
    "f_number": "; rt.first_order(lens).f_number",
    **dict.fromkeys(("save", "write", "export", "to_file", "to_zmx"), "; rt.write_lens(lens, path) writes its file"),
    "plot": "; rt.layout(lens).plot(path) draws it",
    **{name: f"; rt.{name}(lens)" for name in ("info", "layout", "draw", "trace", "spot", "mtf", "psf", "optimize")},
}


@value
class Lens:
    """A sequential lens in mm and µm. `lens.surfaces[k]` is surface k of the file: 0 the object, the last the image.

    surfaces: tuple of Surface; surfaces[0].thickness is the object distance (inf allowed), surfaces[-2].thickness
        the sensor distance.
    stop: number of the stop surface.
    aperture, fields: SystemAperture, Fields.
    wavelengths: (W,) µm; wavelength_weights: (W,); primary_wavelength: its number in
        `wavelengths`, from 1, the first where none is specified; `lens.primary` is it, () µm.
    name, notes: title and comment lines of the file.
    catalogs: glass catalogs in the order of the file.
    ray_aiming: a key of RAY_AIMING.
    environment: temperature and pressure of the lens and the air around it; None: every glass as its catalog has it.
    operands: what differs from one configuration to the next; current_configuration: which one this is, from 1.
        `lens.configurations` are all of them, `lens.configuration(2)` is one.
    optimization_data: variables, solves and the merit function of the file; None without any.
    afocal: whether image space is afocal: the lens as built is judged in angle. Spots are those on the image surface.
    A number of the surfaces, the aperture or the environment may be a tensor (L,), and a coefficient (m, L): a batch of
    `count` lenses, of which `lens[k]` is one and `lens[:10]` some.
    """

    surfaces: tuple[Surface, ...]
    stop: int
    aperture: SystemAperture
    fields: Fields
    wavelengths: Tensor
    wavelength_weights: Tensor
    primary_wavelength: int = 1
    name: str = ""
    notes: tuple[str, ...] = ()
    catalogs: tuple[str, ...] = ()
    ray_aiming: str = "auto"
    environment: Environment | None = None
    operands: tuple[Operand, ...] = ()
    current_configuration: int = 1
    optimization_data: OptimizationData | None = None
    afocal: bool = False

    __getitem__ = one_lens
    with_configurations = multiple.made
    configuration = multiple.chosen

    @property
    def count(self) -> int | None:
        """L, the number of lenses of a batch; None for a single lens."""
        return lens_count(self)

    @property
    def configurations(self) -> tuple["Lens", ...]:
        """The lens in all its configurations; itself if it has one."""
        return multiple.every(self)

    @property
    def primary(self) -> Tensor:
        """The primary wavelength, () µm."""
        return self.wavelengths[self.primary_wavelength - 1]

    @property
    def conditions(self) -> tuple["Condition", ...]:
        """The conditions that optimisations meet exactly: rows of negative weight of the merit function, lengths
        in mm, and those that are off. Raises BadHold for one of a surface that the lens does not have."""
        from raytrace.optimization.conditions import stored_conditions

        return stored_conditions(self)

    def with_conditions(self, conditions: "str | Sequence[str | Condition]", *, only: bool = False) -> "Lens":
        """The lens with conditions in addition, as "efl=50 total_track<=80 edge>=1" (`optimization.conditions`), each
        instead of those of the same quantity; "off:efl=50" is stored and not met. only: no others. Raises BadHold."""
        from raytrace.optimization.conditions import with_conditions

        return with_conditions(self, conditions, only=only)

    def with_tolerances(self, tolerances: Iterable[Any], compensators: Iterable[Any] = ()) -> "Lens":
        """The lens with these tolerances instead of its own, as lines of a .zmx file: those of `rt.tolerances`, or of
        a study, `rt.tolerance(…).tolerances`, tightened ones too, or rows `Tolerance`; () removes all. compensators:
        `Compensator`, besides those of a table. An Abbe number in % is stored as a number; radial tilts and runouts are
        two lines with comments that link them. Raises BadTolerance for one that the lens or OpticStudio has not."""
        from raytrace.tolerancing.files import with_tolerances

        return with_tolerances(self, tolerances, compensators)

    def __getattr__(self, name: str) -> NoReturn:
        raise AttributeError(f"'Lens' object has no attribute {name!r}{_ELSEWHERE.get(name, '')}", name=name, obj=self)

    def __repr__(self) -> str:
        several = "" if self.count is None else f"{self.count} lenses of "
        kinds = {"surface": self.surfaces, "field": self.fields.y, "wavelength": self.wavelengths}
        counts = ", ".join(f"{len(part)} {kind}{'' if len(part) == 1 else 's'}" for kind, part in kinds.items())
        return f"<Lens: {self.name}{self.name and '; '}{several}{counts}>"

    def __str__(self) -> str:
        from raytrace.tracing.lens_report import text

        return text(self)

    def _repr_html_(self) -> str:
        from raytrace.analysis.layout import page

        return page(self)

    @both_spellings
    def at(
        self,
        *,
        object_distance: Tensor | float | None = None,
        magnification: Tensor | float | None = None,
        sensor_distance: Tensor | float | None = None,
        f_number: Tensor | float | None = None,
        entrance_pupil_diameter: Tensor | float | None = None,
        wavelengths: Tensor | Sequence[float] | None = None,
        wavelength_weights: Tensor | Sequence[float] | None = None,
        primary_wavelength: int | None = None,
        fields: Tensor | Sequence | None = None,
        field_weights: Tensor | Sequence[float] | None = None,
        ray_aiming: str | None = None,
        temperature: Tensor | float | None = None,
        pressure: Tensor | float | None = None,
        mount: str | float | None = None,
        configuration: int | None = None,
    ) -> "Lens":
        """The same lens under other conditions; a condition that is None stays.

        object_distance: mm from the object to surface 1, inf allowed; the sensor distance is unchanged: refocus by
        `rt.focus`; magnification: of the paraxial image, instead: the object where the image has it, by first-order
        data at the primary wavelength, and the sensor in that image unless sensor_distance is given;
        sensor_distance: mm from the last surface before the image; f_number: image-space, EFL in air /
        entrance_pupil_diameter, which is in mm; wavelengths: (W,) µm, alike in weight and the first one primary
        unless wavelength_weights (W,) and primary_wavelength, its number from 1, are given; fields: y, or (x, y), in
        the lens's own kind, without vignetting factors, alike in weight unless field_weights (F,) are given; weights:
        relative;
        temperature: °C, pressure: atm, 0 in vacuum; where one of the two is None, it stays, or is 20 °C or 1 atm. From
        one temperature to another indices change, and radii, thicknesses, aspheres and semi-diameters expand, as
        `system.expansion` has it; a lens without an environment is one at 20 °C. mount: material of the spacers of all
        spaces behind surface 1 without a stated `Surface.expansion`, of `materials.MOUNTS`, or 1e-6/K; without it they
        keep their length. Warns NoThermalCoefficients.
        configuration: one of `lens.configurations`, from 1; the other conditions hold in all.
        Raises ValueError for conditions that no lens has.
        """
        from raytrace.tracing.geometry import contact_heights
        from raytrace.tracing.paraxial import at_magnification

        if magnification is not None and object_distance is not None:
            raise ValueError("magnification and object_distance exclude each other: leave one out")

        lens = self if configuration is None else self.configuration(configuration)
        if mount is not None:
            lens = with_mount(lens, mount)
        if temperature is not None:
            lens = with_expansion(lens, temperature, contact_heights)
        lens = multiple.freed(
            lens,
            **dict(object_distance=object_distance, sensor_distance=sensor_distance, f_number=f_number),
            **dict(magnification=magnification),
            **dict(entrance_pupil_diameter=entrance_pupil_diameter, wavelengths=wavelengths),
            **dict(wavelength_weights=wavelength_weights, primary_wavelength=primary_wavelength),
            **dict(fields=fields, field_weights=field_weights),
            **dict(ray_aiming=ray_aiming, temperature=temperature, pressure=pressure),
        )
        if object_distance is not None:
            lens = with_object_distance(lens, object_distance)
        if sensor_distance is not None:
            lens = with_sensor_distance(lens, sensor_distance)
        if f_number is not None and entrance_pupil_diameter is not None:
            raise ValueError("f_number and entrance_pupil_diameter exclude each other: both are the size of the beam")
        for kind, number in (("image_f_number", f_number), ("entrance_pupil_diameter", entrance_pupil_diameter)):
            if number is not None:
                lens = dataclasses.replace(lens, aperture=SystemAperture(kind, _like(number, self.aperture.value)))
        if wavelengths is not None:
            lens = with_wavelengths(lens, wavelengths)
        if fields is not None:
            x, y = field_points(fields, like=self.fields.y)
            points = dataclasses.replace(self.fields, x=x, y=y, weight=torch.ones_like(y), vignetting=None)
            lens = dataclasses.replace(lens, fields=points)
        if wavelength_weights is not None:
            weights = _weights("wavelength", wavelength_weights, like=lens.wavelengths)
            lens = dataclasses.replace(lens, wavelength_weights=weights)
        if primary_wavelength is not None:
            lens = dataclasses.replace(lens, primary_wavelength=int(primary_wavelength))
        if field_weights is not None:
            weights = _weights("field", field_weights, like=lens.fields.y)
            lens = dataclasses.replace(lens, fields=dataclasses.replace(lens.fields, weight=weights))
        if ray_aiming is not None:
            lens = dataclasses.replace(lens, ray_aiming=ray_aiming)
        if temperature is not None or pressure is not None:
            changes = temperature is not None and not _is_at(self, temperature)
            lens = with_environment(lens, temperature, pressure, expands=changes)
        if magnification is not None:
            lens = at_magnification(lens, magnification, keep_sensor=sensor_distance is not None)
        check(lens)
        return lens

    def with_temperatures(self, temperatures: Sequence[float], *, mount: str | float | None = None) -> "Lens":
        """The lens with configurations: the first as it is, then one for each of these temperatures, °C, but its own.

        Operands TEMP, CRVT, THIC, PRAM and SDIA hold its numbers, as OpticStudio's thermal pickups: in an optimisation
        those of the first configuration vary, and the others follow by expansion. Solved numbers stay solved in every
        configuration. Semi-diameters hold still, as the spacers have contact there; automatic ones follow the rays in
        `with_semi_diameters` and after an optimisation. mount: as of `at`. Raises ValueError for a lens with
        configurations, surfaces other than conics and even aspheres, and no other temperature.
        """
        from raytrace.tracing.geometry import fixed_semi_diameters

        lens = with_environment(self if mount is None else with_mount(self, mount), None, None)
        others = [celsius for celsius in temperatures if not _is_at(lens, celsius)]
        if not others:
            reference = f"{temperature_of(lens):g} °C, that of the lens"
            raise ValueError(f"{option('temperatures')} {[*temperatures]}: expected one other than {reference}")
        # stored automatic ones may be those of another design
        lens = lens.with_semi_diameters(fixed=[k for k in fixed_semi_diameters(lens) if k])
        data = lens.optimization_data
        assert data is not None
        sized = tuple(k for k, surface in enumerate(lens.surfaces) if surface.semi_diameter)
        held = dataclasses.replace(lens, optimization_data=dataclasses.replace(data, semi_diameters=sized))
        return multiple.at_temperatures(lens, [held.at(temperature=celsius) for celsius in others])

    def with_semi_diameters(
        self, *, fixed: Sequence[int] | None = None, margin: tuple[float, float] | None = None
    ) -> "Lens":
        """The lens with its clear semi-diameters stored, as a file holds them; automatic ones still follow the rays.

        fixed: the surfaces whose semi-diameters no longer follow the rays; all others do, () frees all; None: as they
        are. margin: per cent and mm added to automatic ones, but for the stop and the image; None: as it is. Semi-
        diameters never clip rays. A stored automatic one that differs by less than 1e-6 of it keeps its digits; those
        that a rule, an operand or a floating stop gives, and radii of normalisation, stay. A batch of lenses stores
        none. Raises ValueError for a surface that the lens does not have, and for a negative margin.
        """
        from raytrace.tracing.geometry import with_semi_diameters

        return with_semi_diameters(self, fixed=fixed, margin=margin)

    def with_missing_semi_diameters(self) -> "Lens":
        """The lens with an automatic semi-diameter, by the rays, at each surface that stores none: as files have it."""
        from raytrace.tracing.geometry import with_missing_semi_diameters

        return with_missing_semi_diameters(self)

    def replace(self, surface: int, **numbers: Any) -> "Lens":
        """The lens with other numbers of one surface: curvature, thickness, conic, coefficients, glass, …

        surface: its number in the file, 0 the object; numbers: fields of Surface, radius (mm), or numbers of its poses:
        x, y, z (mm), tilt_x, tilt_y, tilt_z (degrees) and tilts_first, behind the surface x_after, …; plain numbers, or
        tensors that may require a gradient; glass: a name, an index, (nd, Vd) or a Glass, as in the rows of `rt.lens`.
        A tilted object has its vertex on the axis of surface 1, and object heights along its own axes. A semi_diameter
        that is given is fixed; None lets it follow the rays. Raises
        ValueError for fields that a surface does not have, UnknownGlass.
        """
        if not 0 <= surface < len(self.surfaces):
            raise ValueError(f"surface {surface}: this lens has surfaces 0 to {len(self.surfaces) - 1}")
        surfaces = list(self.surfaces)
        where = f"surface {surface}"
        if "glass" in numbers:
            numbers = {**numbers, "glass": medium(numbers["glass"], self.catalogs, where)}
        surfaces[surface] = changed(surfaces[surface], numbers, where, like=self.wavelengths)
        lens = dataclasses.replace(self, surfaces=tuple(surfaces))
        if "semi_diameter" in numbers and (data := lens.optimization_data) is not None:
            others = (k for k in data.semi_diameters if k != surface)
            fixed = tuple(sorted((*others, surface) if surfaces[surface].semi_diameter else others))
            lens = dataclasses.replace(lens, optimization_data=dataclasses.replace(data, semi_diameters=fixed))
        _check_object(lens)
        return multiple.kept(lens) if self.operands else lens


#: Fields of a surface and of its pose, by the name of a number of a pose: tilt_x; behind the surface, tilt_x_after.
_POSED = {
    field.name + behind: (side, field.name)
    for side, behind in (("before", ""), ("after", "_after"))
    for field in dataclasses.fields(Pose)
}

# Plain data of a lens, for torch.load; values are known to it already (`numerics.value`).
torch.serialization.add_safe_globals([OptimizationData, Row, ScaledPath, Solve, Vary])


def changed(surface: Surface, numbers: Mapping[str, Any], where: str, *, like: Tensor) -> Surface:
    """A surface with some of its fields replaced by plain numbers, tensors or values; radius: mm, for the curvature;
    tilt_x, … and tilt_x_after, …: of its poses, whose other numbers stay."""
    known = [field.name for field in dataclasses.fields(Surface)]
    numeric = {field.name for field in dataclasses.fields(Surface) if field.type in (Tensor, Tensor | None)}
    given = dict(numbers)
    for name in given:
        if name not in (*known, "radius", *_POSED):
            meant = did_you_mean(name, [*known, "radius", *_POSED])
            listed = ", ".join([*known, "radius", *_POSED])
            raise ValueError(f"{where} has no {name!r}{meant} (it has {listed})")
    for name in [name for name in given if name in _POSED]:
        side, field = _POSED[name]
        if side in numbers:
            raise ValueError(f"{where}: both {side} and {name} are given; leave one out")
        given[side] = dataclasses.replace(
            given.get(side) or getattr(surface, side) or Pose(), **{field: given.pop(name)}
        )
    if "radius" in given:
        if "curvature" in given:
            raise ValueError(f"{where}: both radius and curvature are given; leave one out")
        radius = _like(given.pop("radius"), like)
        if bool((radius == 0).any()):
            raise ValueError(f"{where}: radius 0; a plane has radius inf")
        given["curvature"] = 1 / radius
    if isinstance(given.get("expansion"), str):
        given["expansion"] = expansion_of(given["expansion"])
    made: dict[str, Any] = {
        name: _like(v, like) if name in numeric and v is not None else v for name, v in given.items()
    }
    made |= {name: _with_tensors(v, like) for name, v in made.items() if name in ("phase", "before", "after")}
    result = dataclasses.replace(surface, **made)
    _check_kinds(result, where)
    return result


def field_points(fields: Tensor | Sequence | float | None, *, like: "Lens | Tensor") -> Tensor:
    """(2, F) field points of a y, of several y or pairs (x, y), or of a tensor (2, F) itself; None: the lens's.

    like: the lens whose kind of field it is, or a tensor of their dtype and device. Raises ValueError, also where the
    lens is in float16.
    """
    if isinstance(like, Lens):
        check_precision(like.wavelengths.dtype)
        if fields is None:
            return torch.stack([like.fields.x, like.fields.y])
        points = field_points(fields, like=like.fields.y)
        angles = [] if isinstance(fields, Tensor) or like.fields.kind != "angle" else points.flatten().tolist()
        for angle in angles:
            if abs(angle) >= 90:
                message = "a field angle is below 90 degrees, for rays start from the plane of the entrance pupil"
                raise ValueError(f"{option('fields', f'{angle:g}')}: {message}")
        return points
    if isinstance(fields, Tensor):
        if fields.dim() > 2 or (fields.dim() == 2 and len(fields) != 2):
            raise ValueError(f"fields of shape {tuple(fields.shape)}: expected y (F,), or (2, F), all x and then all y")
        return fields if fields.dim() == 2 else torch.stack([torch.zeros_like(fields), fields])
    listed: Iterable[Any] = fields if isinstance(fields, Iterable) else [fields]
    pairs = [(0.0, point) if isinstance(point, (int, float)) else tuple(point) for point in listed]
    if not pairs or any(len(pair) != 2 for pair in pairs):
        raise ValueError(f"fields {fields!r}: expected numbers y, or pairs (x, y)")
    return torch.tensor(pairs, dtype=like.dtype, device=like.device).T


def vector(numbers: Tensor | Iterable[Tensor | float] | float, *, like: Lens) -> Tensor:
    """(n,) of a number or several, in the dtype and on the device of a lens; tensors keep their graph."""
    if isinstance(numbers, Tensor):
        return numbers.reshape(-1)
    listed = [*numbers] if isinstance(numbers, Iterable) else [numbers]
    if not listed:
        raise ValueError("expected a number, or several; found none")
    return torch.stack([_like(number, like.wavelengths) for number in listed])


def wavelengths_of(lens: Lens, wavelengths: Tensor | Iterable[float] | float | None) -> Tensor:
    """The wavelengths (W,) µm: the lens's own, or those given; its media are checked at new ones, as `check_media`."""
    if wavelengths is None:
        return lens.wavelengths
    wavelengths = vector(wavelengths, like=lens)
    check_media(lens, wavelengths[~torch.isin(wavelengths, lens.wavelengths)])
    return wavelengths


def _with_tensors(part: Any, like: Tensor) -> Any:
    """A value whose plain numbers are tensors."""
    if part is None:
        return None
    names = [field.name for field in dataclasses.fields(part) if field.type in (Tensor, Tensor | None)]
    numbers = {name: number for name in names if (number := getattr(part, name)) is not None}
    return dataclasses.replace(part, **{name: _like(number, like) for name, number in numbers.items()})


def _weights(kind: str, weights: Tensor | Sequence[float], *, like: Tensor) -> Tensor:
    """Weights of the wavelengths or fields `like`, one for each. Raises ValueError."""
    shares = _like(weights, like)
    if shares.shape != like.shape:
        raise ValueError(
            f"{option(f'{kind}_weights')}: {shares.numel()} found; expected {len(like)}, one for each {kind}"
        )
    if not bool((torch.isfinite(shares) & (shares >= 0)).all() and (shares > 0).any()):
        raise ValueError(
            f"{option(f'{kind}_weights')} {shares.tolist()}: expected numbers from 0 up, at least one above 0"
        )
    return shares


def _like(number: Tensor | float | Sequence, like: Tensor) -> Tensor:
    if isinstance(number, Tensor):
        return number
    try:
        return torch.as_tensor(number, dtype=like.dtype, device=like.device)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{number!r} is not a number") from error


def with_object_distance(lens: Lens, object_distance: Tensor | float) -> Lens:
    """The lens with its object at another distance, mm from surface 1; inf allowed."""
    return _with_thickness(lens, 0, object_distance)


def with_sensor_distance(lens: Lens, sensor_distance: Tensor | float) -> Lens:
    """The lens with its sensor at another distance, mm from the last surface before the image."""
    return _with_thickness(lens, len(lens.surfaces) - 2, sensor_distance)


def with_wavelengths(
    lens: Lens, wavelengths: Tensor | Sequence[float] | float, weights: Tensor | None = None, *, where: str = ""
) -> Lens:
    """The lens at other wavelengths (W,) µm, the first one primary, by weights (W,), alike by default.

    Those that the lens does not have yet are checked as by `check_media`, whose place `where` is.
    """
    wavelengths = vector(wavelengths, like=lens).to(lens.wavelengths)
    check_media(lens, wavelengths[~torch.isin(wavelengths, lens.wavelengths)], where=where)
    weights = torch.ones_like(wavelengths) if weights is None else weights
    return dataclasses.replace(lens, wavelengths=wavelengths, wavelength_weights=weights, primary_wavelength=1)


def with_mount(lens: Lens, mount: str | float) -> Lens:
    """The lens whose spaces behind surface 1 and further have spacers of a material of MOUNTS, or of 1e-6/K.

    A stated `Surface.expansion` stays. Raises ValueError for an unknown material.
    """
    expansion, surfaces = _like(expansion_of(mount), lens.wavelengths), [*lens.surfaces]
    for k in spaces(surfaces):
        if surfaces[k].expansion is None:
            surfaces[k] = dataclasses.replace(surfaces[k], expansion=expansion)
    return dataclasses.replace(lens, surfaces=tuple(surfaces))


def temperature_of(lens: Lens) -> Tensor:
    """°C, at which the lens has its radii and thicknesses: 20 °C without an environment."""
    return (lens.environment or _reference(lens.wavelengths)).temperature


def with_expansion(lens: Lens, temperature: Tensor | float, contact: Contact) -> Lens:
    """The lens with the radii, thicknesses, aspheres and semi-diameters of another temperature, °C, in all its
    configurations; its indices and its environment stay. contact: lens, surfaces -> their radii of contact, mm."""
    temperature = _like(temperature, lens.wavelengths)

    def grown(lens: Lens) -> Lens:
        warmer = temperature - temperature_of(lens)
        if not varies(warmer) and not is_any(warmer != 0):
            return lens
        surfaces = expanded(lens.surfaces, warmer, contact(lens, in_contact(lens.surfaces)))
        lens = dataclasses.replace(lens, surfaces=surfaces)
        if lens.aperture.kind != "float_by_stop":
            return lens
        size = lens.aperture.value * growth(lens.surfaces, warmer)[0][lens.stop]
        return dataclasses.replace(lens, aperture=SystemAperture("float_by_stop", size))

    if not lens.operands:
        return grown(lens)
    operands, each = list(lens.operands), range(multiple.count(lens.operands))
    for k in each:
        at_temperature = grown(multiple.with_operands(lens, k + 1))
        operands = [multiple.taken(operand, at_temperature, k) for operand in operands]
    current = grown(multiple.with_operands(lens, lens.current_configuration))
    return dataclasses.replace(current, operands=tuple(operands))


def _is_at(lens: Lens, temperature: Tensor | float) -> bool:
    return not is_any(_like(temperature, lens.wavelengths) != temperature_of(lens))


def with_environment(
    lens: Lens, temperature: Tensor | float | None, pressure: Tensor | float | None, *, expands: bool = False
) -> Lens:
    """The lens at another temperature in °C and pressure in atm; where one is None, it stays, or is 20 °C or 1 atm.

    Radii and thicknesses stay. A surface with an environment of its own keeps it. Raises ValueError for a temperature
    or pressure that air cannot have; warns NoThermalCoefficients, once for each glass whose change is not known.
    expands: whether the lens has expanded to that temperature, and glasses without an expansion are warned of, too.
    """
    before = lens.environment or _reference(lens.wavelengths)
    temperature = before.temperature if temperature is None else _like(temperature, lens.wavelengths)
    pressure = before.pressure if pressure is None else _like(pressure, lens.wavelengths)
    lens = dataclasses.replace(lens, environment=Environment(temperature, pressure))
    _check_environments(lens)
    messages = unknown_changes(lens)
    for number, name in unexpanded(lens.surfaces).items() if expands else ():
        start = f"{messages[number]}; " if number in messages else f"{name}: "
        messages[number] = f"{start}no expansion is listed: its radii and thickness stay"
    for number, message in sorted(messages.items()):
        warnings.warn(f"surface {number}: {message}", NoThermalCoefficients, stacklevel=calling_level())
    return lens


def unknown_changes(lens: Lens) -> dict[int, str]:
    """Messages about glasses whose change with the environment is not known, by the first surface of each."""
    messages: dict[tuple[str, str], tuple[int, str]] = {}
    for number, surface in enumerate(lens.surfaces):
        place = surface.environment or lens.environment
        if place is not None and (message := unknown_change(surface.glass, place)):
            messages.setdefault((message, surface.glass.catalog), (number, message))
    return dict(messages.values())


@shared
def index_behind(lens: Lens, number: int, wavelength: Tensor) -> Tensor:
    """n (...) of the medium behind a surface at wavelengths (...) µm, relative to the lens's air; a mirror has none."""
    surface, air = lens.surfaces[number], lens.environment
    if air is None and surface.environment is None:
        return refractive_index(surface.glass, wavelength)
    return index_in(surface.glass, wavelength, air or _reference(wavelength), surface.environment)


@shared
def media(lens: Lens, wavelength: Tensor) -> list[Tensor]:
    """Refractive index behind every surface, object first; positive also behind a mirror.

    wavelength: (...) µm; returns one tensor (...) for each surface, in the lens's dtype. A mirror, a coordinate break
    and the image keep the medium. A medium that does not change is the same tensor, so that a trace refracts nothing
    there: rays on the sensor have the direction and the index of the last gap.
    """
    dtype, numbers = lens.surfaces[-2].thickness.dtype, medium_surfaces(lens.surfaces)
    in_air = lens.environment is None and all(surface.environment is None for surface in lens.surfaces)
    # Air lies between all elements: each medium is evaluated once.
    distinct: dict[tuple, int] = {}
    keys = []
    for number in numbers:
        surface = lens.surfaces[number]
        glass, air = surface.glass, () if in_air else (surface.glass.records, id(surface.environment))
        keys.append((glass.formula, id(glass.coefficients), *air))
        distinct.setdefault(keys[-1], number)
    if in_air:
        indices = _refractive_indices([lens.surfaces[number].glass for number in distinct.values()], wavelength)
    else:
        indices = [index_behind(lens, number, wavelength) for number in distinct.values()]
    by_medium = {key: n.to(dtype) for key, n in zip(distinct, indices, strict=True)}
    return [by_medium[key] for key in keys]


def glass_on_image(lens: Lens) -> str:
    """The name of a glass on the image surface, "" where it is air or the medium in front of it.

    No light enters it: rays, spots, wavefronts and PSFs are those in the last gap.
    """
    glass = lens.surfaces[-1].glass
    if lens.surfaces[-1].is_mirror or is_air(glass):
        return ""
    before = lens.surfaces[medium_surfaces(lens.surfaces)[-1]].glass
    return "" if multiple.same(glass, before) else label(glass)


def _refractive_indices(glasses: Sequence[Glass], wavelength: Tensor) -> list[Tensor]:
    """`refractive_index` of each glass; glasses of one formula are evaluated together."""
    groups: dict[object, list[int]] = {}
    for number, glass in enumerate(glasses):
        together = glass.formula not in ("mirror", "constant")
        groups.setdefault((glass.formula, glass.coefficients.shape) if together else number, []).append(number)
    indices: dict[int, Tensor] = {}
    for numbers in groups.values():
        if len(numbers) == 1:
            indices[numbers[0]] = refractive_index(glasses[numbers[0]], wavelength)
            continue
        stacked = torch.stack([glasses[number].coefficients for number in numbers], 1)
        count, size, *batch = stacked.shape
        stacked = stacked.reshape(count, size, *(1,) * (wavelength.dim() - len(batch)), *batch)
        group = dataclasses.replace(glasses[numbers[0]], coefficients=stacked)
        indices |= dict(zip(numbers, refractive_index(group, wavelength).unbind(0), strict=True))
    return [indices[number] for number in range(len(glasses))]


def _reference(like: Tensor) -> Environment:
    """The air of catalogs."""
    return Environment(*(torch.as_tensor(number, dtype=torch.float64, device=like.device) for number in REFERENCE))


def with_field_kind(lens: Lens, kind: str) -> Lens:
    """The lens with the same field numbers, of another kind of FIELD_UNITS."""
    return dataclasses.replace(lens, fields=dataclasses.replace(lens.fields, kind=kind))


def name_of_field(field: Tensor) -> str:
    """A field point (2,) in words: its y alone on the axis of x."""
    return point_text(*field.tolist())


def field_label(lens: Lens, field: Sequence[float]) -> str:
    """A field point in a figure: `10°`, `(3, 4)°`, `5 mm`; its y alone where x is 0."""
    x, y = (float(component) + 0.0 for component in field)
    point = f"{y:.6g}" if x == 0 else f"({x:.6g}, {y:.6g})"
    return point.replace("-", "−") + ("°" if lens.fields.kind == "angle" else " mm")


def field_title(lens: Lens) -> str:
    """The kind of field of this lens, in a figure."""
    titles = {"real_image_height": "Image height", "angle": "Field angle"}
    return titles.get(lens.fields.kind) or lens.fields.kind.replace("_", " ").capitalize()


def check_media(lens: Lens, wavelengths: Tensor, *, where: str = "") -> None:
    """Refuse wavelengths (W,) µm at which a glass of the lens has no index; warn of glasses used outside their range.

    where: the lens, to name in the message. Raises ImplausibleWavelength where neither a glass nor the wavelengths of
    the lens reach that far, also for a lens without glass, and `glass.InvalidIndex`; warns `glass.OutOfRange`, once for
    each glass.
    """
    media = [surface.glass for surface in lens.surfaces[:-1]]
    check_unit(wavelengths, media, believed=lens.wavelengths, where=where)
    seen = set()
    for number, glass in enumerate(media):
        key = (glass.name, glass.catalog)
        if glass.formula != "constant" and key not in seen:
            seen.add(key)
            place = f"{where}, surface {number}" if where else f"surface {number}"
            check_wavelengths(glass, wavelengths, where=place)


def _with_thickness(lens: Lens, number: int, thickness: Tensor | float) -> Lens:
    like = lens.surfaces[number].thickness.dtype
    return lens.replace(number, thickness=torch.as_tensor(thickness, dtype=like, device=lens.wavelengths.device))


def check(lens: Lens) -> None:
    """Raise ValueError for a lens that cannot be traced as a whole."""
    check_precision(lens.wavelengths.dtype)
    last = len(lens.surfaces) - 1
    if lens.ray_aiming not in RAY_AIMING:
        raise ValueError(f"ray aiming {lens.ray_aiming!r}: expected one of {', '.join(RAY_AIMING)}")
    if last < 2:
        raise ValueError(f"{last + 1} surfaces found; expected at least the object, one surface and the image")
    if not 1 <= lens.stop < last:
        raise ValueError(f"the stop is surface {lens.stop}; expected one from 1 to {last - 1}")
    check_unit(lens.wavelengths, believed=lens.wavelengths)
    if not 1 <= lens.primary_wavelength <= len(lens.wavelengths):
        last_one = len(lens.wavelengths)
        raise ValueError(f"primary wavelength number {lens.primary_wavelength}; expected one from 1 to {last_one}")
    lens_count(lens)  # refuses numbers of different counts
    if not bool((lens.aperture.value > 0).all()):
        smallest = float(lens.aperture.value.min())
        raise ValueError(f"aperture {lens.aperture.kind} {smallest:g}: expected a number above 0")
    for number, surface in enumerate(lens.surfaces[1:], 1):
        if not bool((finite := torch.isfinite(surface.thickness)).all()):
            wrong = float(surface.thickness[~finite][0])
            raise ValueError(f"surface {number} has thickness {wrong}; only the object's may be inf")
    if bool(torch.isnan(lens.surfaces[0].thickness).any()):
        raise ValueError("the object distance is nan; expected mm, or inf")
    if not bool((torch.isfinite(lens.fields.x) & torch.isfinite(lens.fields.y)).all()):
        raise ValueError(f"{option('fields')} hold a number that is not finite; expected numbers y, or pairs (x, y)")
    at_infinity = bool(torch.isinf(lens.surfaces[0].thickness).any())
    if at_infinity and lens.fields.kind == "object_height":
        raise ValueError("fields are object heights but the object is at infinity: give angles, or an object distance")
    if at_infinity and lens.fields.telecentric:
        raise ValueError("object space is telecentric but the object is at infinity: give an object distance")
    if at_infinity and lens.aperture.kind in ("object_na", "object_cone_angle"):
        raise ValueError(f"aperture {lens.aperture.kind} needs an object at a finite distance")
    _check_environments(lens)
    _check_cone(lens)
    _check_object(lens)
    for number, surface in enumerate(lens.surfaces):
        _check_kinds(surface, f"surface {number}")
    if lens.fields.kind == "angle" and bool(lens.fields.extent >= 90):
        extent = f"{option('fields')} reach {float(lens.fields.extent):g} degrees"
        raise ValueError(f"{extent}; expected below 90 degrees: rays start from the plane of the entrance pupil")


def _check_environments(lens: Lens) -> None:
    """Refuse a temperature or a pressure that air cannot have."""
    places = {"": lens.environment, **{f"surface {k}: ": part.environment for k, part in enumerate(lens.surfaces)}}
    for where, environment in places.items():
        if environment is not None and (wrong := objection(environment)):
            raise ValueError(where + wrong)


def _check_kinds(surface: Surface, where: str) -> None:
    """Refuse an unknown kind of sag or shape of aperture, sizes that a shape does not have, and negative sizes."""
    if surface.kind not in KINDS:
        raise ValueError(f"{where}: kind {surface.kind!r}; expected one of {', '.join(KINDS)}")
    kind, count = KINDS[surface.kind], 0 if surface.coefficients is None else len(surface.coefficients)
    if not kind.least <= count <= (kind.most or count):
        names = ", ".join(kind.name_of(entry) for entry in range(kind.most or count))
        expected = kind.least if kind.most == kind.least else f"{kind.least} to {kind.most}"
        raise ValueError(f"{where}: a {kind.name} of {count} coefficients; expected {expected}: {names}")
    for name in SIZES:
        if (size := getattr(surface, name)) is not None and not size >= 0:
            raise ValueError(f"{where}: {name} {size}: expected a length in mm, 0 or more; or None")
    for aperture in surface.apertures:
        if aperture.shape not in SHAPES:
            known = ", ".join(SHAPES)
            raise ValueError(f"{where}: an aperture of shape {aperture.shape!r}; expected one of {known}")
        if wrong := SHAPES[aperture.shape].objection(aperture.extent):
            raise ValueError(f"{where}: an aperture ({aperture.shape}) {wrong}")


def _check_cone(lens: Lens) -> None:
    """Refuse a cone at the object of a right angle, of 180° and more, or of an NA that is not below the index."""
    # Of a cone beyond a right angle rays leave on the same lines forwards, within 180 degrees less the angle.
    kind, number = lens.aperture.kind, float(lens.aperture.value.max())
    if kind == "object_cone_angle" and (number == 90 or number >= 180):
        raise ValueError(f"aperture object_cone_angle {number:g} degrees: expected less than 180, and not 90")
    if kind == "object_na":
        index = float(index_behind(lens, 0, lens.primary).min())
        if number >= index:
            raise ValueError(f"aperture object_na {number:g}: expected less than the index {index:g} before surface 1")


def _check_object(lens: Lens) -> None:
    """Refuse poses of the object other than tilts of a surface at a finite distance whose points are the fields."""
    source = lens.surfaces[0]
    if source.after is not None:
        raise ValueError("surface 0: a pose behind the object; expected tilt_x, tilt_y or tilt_z, which tilt it alone")
    if source.before is None:
        return
    moved = ", ".join(name for name in ("x", "y", "z") if getattr(source.before, name) is not None)
    if moved:
        message = f"surface 0: the object is decentred ({moved})"
        raise ValueError(f"{message}; its place is that of the fields and of the object distance: expected tilts alone")
    if is_any(torch.isinf(source.thickness)):
        raise ValueError("surface 0: a tilted object at infinity; give an object distance")
    if lens.fields.kind not in ("object_height", "real_image_height"):
        kind = lens.fields.kind.replace("_", " ")
        message = f"surface 0: a tilted object, with fields of the kind {kind}, which does not locate its points"
        raise ValueError(f"{message}; expected object heights, along its tilted axes, or real image heights")


def is_round_about_axis(lens: Lens) -> bool:
    """Whether the lens is rotationally symmetric, by the kinds and poses of its surfaces, whatever their values."""
    return all(is_round(surface) and not is_posed(surface) for surface in lens.surfaces)
