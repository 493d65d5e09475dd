"""The lens of a file, assembled and checked: the same for every format; and its glasses, by name from catalogs.

A reader collects the data of a file in a `LensDraft`, in mm and µm; `assemble` checks them and makes the lens.
"""

import dataclasses
import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path

import torch
from torch.utils import _pytree as pytree

from raytrace.io.source import FORMULA, NEAREST, Draft, LensFileError, Place, double, shown
from raytrace.materials.catalogs import (
    SAME_INDEX,
    AmbiguousGlass,
    Catalog,
    CatalogError,
    UnknownGlass,
    find_glass,
    load,
    missing_catalogs,
    nearest_glasses,
    shipped_difference,
    user_catalogs,
)
from raytrace.materials.environment import Environment, objection
from raytrace.materials.glass import Glass, constant, mil_glass, model_glass
from raytrace.system.apertures import SHAPES, Aperture
from raytrace.system.configurations import count
from raytrace.system.lens import Fields, Lens, SystemAperture
from raytrace.system.optimization_data import OptimizationData, Solve, Vary
from raytrace.system.parameter_paths import OF_LENS, modelled, parse_bounds, path_of
from raytrace.system.poses import Pose, undone
from raytrace.system.surface import SHAPE, SIZES, Surface
from raytrace.words import option

#: More characters than the name of any glass has.
_LONGEST = 80

#: Catalogs that come with a lens, by name in capitals: a description of their source, and a function that reads them.
CatalogSources = Mapping[str, tuple[str, Callable[[], Catalog]]]


# -- reading ----------------------------------------------------------------------------------------------------------


def listed_glass(
    name: str,
    *,
    catalogs: Sequence[str | Catalog],
    user: Sequence[Path],
    place: Place,
    report: Draft,
    figures: tuple[float, float] | None = None,
) -> Glass:
    """The glass of a name, or its substitute, with a warning in the report. Raises UnknownGlass.

    figures: n_d and V_d of the file, for the nearest glass where that was requested.
    """
    other, nearest = report.substitutes.of(name), report.substitutes.nearest
    if other is not None:
        report.substituted.add(name.upper())
    if other is not None and other not in (NEAREST, FORMULA):
        glass = mil_glass(other) if is_code(other) else _catalog_glass(other, catalogs, user, place, report)
        report.warn(f"{glass_words(glass)} is taken for the glass {name}, as requested", place)
        return glass
    try:
        return _catalog_glass(name, catalogs, user, place, report)
    except UnknownGlass as error:
        if (other == NEAREST or nearest) and figures is not None:
            nd, vd = figures
            (glass,) = nearest_glasses((nd, vd), user=user, count=1)
            d_nd, d_vd = (glass.nd_listed or 0.0) - nd, (glass.abbe_listed or 0.0) - vd
            off = f"its nd differs by {d_nd:+.1e}, its Vd by {d_vd:+.2g}"
            reason = f"the nearest to nd {nd:.7g}, Vd {vd:.5g} of the file"
            report.warn(f"{glass_words(glass)} is taken for the unknown glass {name}: {reason}; {off}", place)
            report.glass(place, name, f"{glass_words(glass)}, the nearest glass by nd and Vd")
            return glass
        lacks = "the file has no nd and Vd to find the nearest glass by; " if nearest or other else ""
        hint = f"{lacks}specify a substitute by {option('substitute', f'{name}=OTHER')}"
        raise UnknownGlass(error.name, error.where, error.suggestions, error.searched, hint) from None


def glass_words(glass: Glass) -> str:
    """The name of a glass with its catalog."""
    return f"{glass.name} ({glass.catalog})" if glass.catalog else glass.name


def _catalog_glass(
    name: str, catalogs: Sequence[str | Catalog], user: Sequence[Path], place: Place, report: Draft
) -> Glass:
    """The glass of a name by `find_glass`, with its warnings in the report. Raises UnknownGlass.

    Reports where a catalog that came with the lens differs from the shipped one of its name.
    """
    if len(name) > _LONGEST:
        raise LensFileError(f"the glass {shown(name)} has {len(name)} characters; no glass has such a name", place)
    readable = []
    for catalog in catalogs:
        if isinstance(catalog, Catalog):
            try:
                catalog.find(name)
            except CatalogError as error:
                message = f"the catalog {catalog.name} that came with the lens is left out: {error}"
                report.warn(message, Place(report.file))
                continue
        readable.append(catalog)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        glass = find_glass(name, catalogs=readable, user=user, where=str(place))
    for warning in caught:
        if issubclass(warning.category, AmbiguousGlass):
            report.warn(str(warning.message).removeprefix(f"{place}: "), place)
        else:
            report.note(str(warning.message))
    came = any(isinstance(catalog, Catalog) and catalog.name == glass.catalog for catalog in readable)
    gap = shipped_difference(glass) if came else 0.0
    if gap > SAME_INDEX:
        message = f"{name} is that of the {glass.catalog} that came with the lens; its index differs from that of the"
        report.warn(f"{message} shipped {glass.catalog} by up to {gap:.1e}", place)
    alias = f" as {glass.listed_name}" if glass.listed_name and glass.listed_name.upper() != name.upper() else ""
    report.glass(place, name, f"{glass.catalog or 'user catalog'}{alias}")
    return glass


def catalogs_in_folder(file: str) -> CatalogSources:
    """The glass catalogs (.agf) in the folder of a lens file."""
    try:
        paths = sorted(path for path in Path(file).parent.iterdir() if path.suffix.lower() == ".agf" and path.is_file())
    except (OSError, ValueError):
        return {}
    return {
        path.stem.upper(): (f"{path.name} in the folder of the lens", partial(load, path, listed=True))
        for path in paths
    }


def catalogs_of_lens(
    names: Sequence[str], user: Sequence[Path], report: Draft, packed: CatalogSources | None = None
) -> tuple[str | Catalog, ...]:
    """The catalogs that a lens file names, in its order: a `Catalog` that came with the lens, others by name.

    A catalog comes with the lens as NAME.agf in its folder, in upper or lower case, or `packed` in an archive. It
    precedes a shipped catalog of its name, and is ignored where `user` has one. The report lists the catalogs that were
    found, and those that are unavailable.
    """
    came = catalogs_in_folder(report.file) if packed is None else packed
    stated = {path.stem.upper() for path in user_catalogs(user)}
    catalogs: list[str | Catalog] = []
    missing: list[str] = []
    for name in dict.fromkeys(names):
        source = None if name.upper() in stated else came.get(name.upper())
        catalog = None if source is None else _came(name, *source, report)
        catalogs.append(catalog or name)
        missing += [] if catalog else missing_catalogs([name], user=user)
    if missing:
        report.note(f"catalogs that are not shipped: {', '.join(missing)}; their glasses are sought in the others")
    return tuple(catalogs)


def _came(name: str, where: str, read: Callable[[], Catalog], report: Draft) -> Catalog | None:
    """A catalog that came with the lens; None, with a warning, where it cannot be read."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            catalog = read()
        except CatalogError as error:
            report.warn(f"the catalog {name} that came with the lens is left out: {error}", Place(report.file))
            return None
    for warning in caught:
        report.note(str(warning.message))
    shipped = "" if missing_catalogs([name]) else ", which precedes the shipped one"
    report.note(f"catalog {name}: {where}{shipped}")
    return catalog


def is_code(name: str) -> bool:
    """True for a MIL code, six digits that give index and Abbe number."""
    return len(name) == 6 and name.isascii() and name.isdigit()


def by_figures(nd: float, vd: float, dpgf: float, name: str) -> Glass:
    """The medium of numbers in a file: a constant index where it has no dispersion, else a model glass."""
    return constant(nd, name) if vd == dpgf == 0 else model_glass(nd, vd, dpgf, name=name)


# -- writing ----------------------------------------------------------------------------------------------------------


def is_left_out(glass: Glass) -> bool:
    """True for the medium that files leave out: unnamed, of index 1."""
    return glass.formula == "constant" and glass.name == "" and bool((glass.coefficients == 1).all())


def is_listed(glass: Glass) -> bool:
    """True for a glass that a file holds by name only; its dispersion is that of a catalog."""
    return glass.formula not in ("constant", "model", "mirror")


def catalogs_needed(lens: Lens, user: Sequence[Path], file: str) -> tuple[str, ...]:
    """The lens's catalogs, with further catalogs that its glasses need, also to be found without ambiguity.

    Raises LensFileError for a glass whose name is not found, or has other coefficients.
    """
    names = lens.catalogs
    for number, surface in enumerate(lens.surfaces):
        glass, place = surface.glass, Place(file, None, number)
        if not is_listed(glass) or _finds(glass, names, user, place):
            continue
        if glass.catalog and _finds(glass, (*names, glass.catalog), user, place):
            names = (*names, glass.catalog)
            continue
        message = f"the figures of {glass.name!r} are not those of its catalog; a file holds its name only"
        hint = "use the listed glass or a model glass, or put its catalog into the folder of the file"
        raise LensFileError(f"{message}: {hint}", place)
    return names


def _finds(glass: Glass, names: tuple[str, ...], user: Sequence[Path], place: Place) -> bool:
    """True if the name finds the same coefficients in one catalog alone, or belongs to one that is unavailable."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", AmbiguousGlass)
            catalogs = catalogs_of_lens(names, user, Draft(place.file, ""))
            listed = find_glass(glass.name, catalogs=catalogs, user=tuple(user), where=str(place))
    except UnknownGlass:
        return bool(glass.catalog)
    except AmbiguousGlass:
        return not glass.catalog
    return same_figures(listed, glass)


def same_figures(a: Glass, b: Glass) -> bool:
    """Whether two glasses have the same formula and coefficients."""
    first, second = (glass.coefficients.detach().double().cpu() for glass in (a, b))
    return a.formula == b.formula and torch.equal(first, second)


def listed_name(glass: Glass, place: Place) -> str:
    """The name of a glass as one word."""
    if not glass.name or len(glass.name.split()) != 1 or not glass.name.isprintable():
        raise LensFileError(f"the name of the glass is {glass.name!r}, expected one word", place)
    return glass.name


def pose_of(numbers: Mapping[str, float], *, tilts_first: bool = False) -> Pose | None:
    """The pose of decentres x, … in mm and tilts tilt_x, … in degrees; numbers that are 0 are not modelled."""
    modelled = {name: double(number) for name, number in numbers.items() if number}
    return Pose(**modelled, tilts_first=tilts_first) if modelled else None


#: Axes behind a surface with decentres and tilts: its own; those before it; turned back without a pose of the surface
#: itself; tilted again by the same angle, as the axis of light behind a mirror.
ONWARD, RETURNED, REVERSED, BENT = "onward", "returned", "reversed", "bent"


def poses_of(numbers: Mapping[str, float], axes: str, *, tilts_first: bool = False) -> tuple[Pose | None, Pose | None]:
    """The pose before a surface and that behind it, of the numbers of `pose_of`, by the axes behind it."""
    pose = pose_of(numbers, tilts_first=tilts_first)
    if pose is None or axes == ONWARD:
        return pose, None
    if axes == BENT:
        return pose, pose_of({name: number for name, number in numbers.items() if name.startswith("tilt")})
    return None if axes == REVERSED else pose, undone(pose)


def environment_at(numbers: Sequence[float], place: Place) -> Environment:
    """The environment of a temperature in °C and a pressure in atm. Raises LensFileError out of range."""
    environment = Environment(*map(double, numbers))
    if wrong := objection(environment):
        raise LensFileError(wrong.replace("`", ""), place)
    return environment


def clear_aperture(
    shape: str, sizes: Sequence[float], obscures: bool, centre: Sequence[float], label: str, place: Place
) -> Aperture:
    """The aperture of sizes and centre in mm. Raises LensFileError, with a label, for sizes out of range."""
    if wrong := SHAPES[shape].objection(tuple(sizes)):
        raise LensFileError(f"{label} {wrong}", place)
    return Aperture(shape, tuple(sizes), obscures, tuple(centre))


#: More field points or wavelengths than any file has.
MOST_POINTS = 1000

#: Keyword of the file and its place, by the name of a field of `LensDraft`.
Sources = dict[str, tuple[str, Place]]


@dataclasses.dataclass
class LensDraft:
    """The data of a lens file before they are checked; fields as those of `Lens`.

    aperture: mm, degrees or a pure number, by its kind; x, y: mm or degrees; vignetting: VDX, VDY, VCX, VCY, VAN, a
    number for each field; wavelengths: µm. sources: for the messages of errors, that of the aperture with its value.
    """

    surfaces: Sequence[Surface]
    stop: int
    aperture_kind: str
    aperture: float
    field_kind: str
    x: Sequence[float]
    y: Sequence[float]
    wavelengths: Sequence[float]
    field_weights: Sequence[float] | None = None
    vignetting: Sequence[Sequence[float]] | None = None
    telecentric: bool = False
    wavelength_weights: Sequence[float] | None = None
    primary_wavelength: int = 1
    name: str = ""
    notes: tuple[str, ...] = ()
    catalogs: tuple[str, ...] = ()
    ray_aiming: str = "auto"
    afocal: bool = False
    environment: Environment | None = None
    sources: Sources = dataclasses.field(default_factory=dict)


TILTED_OBJECT = (
    "a tilt or decentre of the object, which lens files do not hold here; tilt the axes of surface 1, a break, instead"
)


def assemble(draft: LensDraft, file: str) -> Lens:
    """The lens of a draft. Raises LensFileError for a quantity out of range, at the keyword that gave it."""

    def refuse(quantity: str, message: str) -> None:
        keyword, place = draft.sources.get(quantity, (quantity, Place(file)))
        raise LensFileError(f"{keyword}{message}", place)

    last = len(draft.surfaces) - 1
    if draft.surfaces[0].before is not None or draft.surfaces[0].after is not None:
        raise LensFileError(TILTED_OBJECT, Place(file, None, 0))
    if not 0 < draft.stop < last:
        refuse("stop", f" is surface {draft.stop}, expected 1 to {last - 1}: a surface between object and image")
    if not draft.aperture > 0:
        refuse("aperture", ", expected a positive number")
    count = len(draft.x)
    if not 1 <= count <= MOST_POINTS or len(draft.y) != count:
        refuse("fields", f" has {len(draft.y)} values for {count} fields, expected 1 to {MOST_POINTS} of each")
    field_weights = [1.0] * count if draft.field_weights is None else draft.field_weights
    waves = draft.wavelengths
    if not 1 <= len(waves) <= MOST_POINTS:
        refuse("wavelengths", f" has {len(waves)} values, expected 1 to {MOST_POINTS} wavelengths")
    for wave in waves:
        if not 0 < wave < math.inf:
            refuse("wavelengths", f": wavelength {wave:g} µm, expected a positive number")
    weights = [1.0] * len(waves) if draft.wavelength_weights is None else draft.wavelength_weights
    if len(weights) != len(waves):
        refuse("wavelength_weights", f": {len(weights)} weights for {len(waves)} wavelengths, expected as many")
    if min(weights) < 0:
        refuse("wavelength_weights", f": weight {min(weights):g} of a wavelength, expected 0 or more")
    primary = draft.primary_wavelength
    if not 1 <= primary <= len(waves):
        refuse("primary_wavelength", f" is {primary}, expected 1 to {len(waves)}, the number of wavelengths")
    vignetting = None if draft.vignetting is None else double([list(row) for row in draft.vignetting])
    lens = Lens(
        surfaces=tuple(draft.surfaces),
        stop=draft.stop,
        aperture=SystemAperture(draft.aperture_kind, double(draft.aperture)),
        fields=Fields(
            kind=draft.field_kind,
            x=double([*draft.x]),
            y=double([*draft.y]),
            weight=double([*field_weights]),
            vignetting=vignetting if vignetting is not None and bool(vignetting.any()) else None,
            telecentric=draft.telecentric,
        ),
        wavelengths=double([*waves]),
        wavelength_weights=double([*weights]),
        primary_wavelength=primary,
        name=draft.name,
        notes=draft.notes,
        catalogs=draft.catalogs,
        ray_aiming=draft.ray_aiming,
        afocal=draft.afocal,
        environment=draft.environment,
    )
    _refuse_overflow(lens, file)
    return lens


def _refuse_overflow(lens: Lens, file: str) -> None:
    """Raise LensFileError where a number left the 64-bit range when it was converted to mm."""

    def finite(numbers: Sequence[object]) -> bool:
        leaves = [
            torch.as_tensor(leaf, dtype=torch.float64) for leaf in pytree.tree_leaves(numbers) if leaf is not None
        ]
        return all(bool(torch.isfinite(leaf).all()) for leaf in leaves)

    for k, surface in enumerate(lens.surfaces):
        numbers = [getattr(surface, name) for name in SHAPE if name != "kind"]
        numbers += [surface.phase, surface.before, surface.after, *(getattr(surface, name) for name in SIZES)]
        numbers += [surface.thickness] if k else []
        numbers += [(*aperture.extent, *aperture.centre) for aperture in surface.apertures]
        if not finite(numbers):
            raise LensFileError("a number is too large once converted to mm", Place(file, None, k))
    if not finite([lens.aperture.value, lens.fields.x, lens.fields.y]):
        raise LensFileError("aperture or field is too large once converted to mm", Place(file))
    distance = lens.surfaces[0].thickness
    if torch.isnan(distance) or distance == -torch.inf:
        raise LensFileError("the object distance is too large once converted to mm", Place(file, None, 0))


def _in_order(data: OptimizationData | None) -> OptimizationData | None:
    """Optimisation data with variables and solves in the order of surfaces, the only order that a file keeps."""
    if data is None:
        return None

    def place(rule: Vary | Solve) -> tuple[int, str, int, int]:
        return rule.surface, rule.quantity, rule.configuration, rule.operand or 0

    variables, solves = sorted(data.variables, key=place), sorted(data.solves, key=place)
    return dataclasses.replace(data, variables=tuple(variables), solves=tuple(solves))


def written_variables(lens: Lens) -> str:
    """The variables of a lens of one configuration, with their bounds, as "curvature_1 thickness_2:1.0..20.0"."""
    variables = () if lens.optimization_data is None else lens.optimization_data.variables
    return " ".join(
        variable.name + (f":{variable.bounds[0]!r}..{variable.bounds[1]!r}" if variable.bounds else "")
        for variable in variables
        if variable.operand is None and variable.address not in OF_LENS
    )


def with_written_variables(lens: Lens, words: str, place: Place) -> Lens:
    """The lens with the variables of a line of its file, each of them modelled."""
    surfaces, variables = list(lens.surfaces), []
    for word in words.split():
        name, colon, _ = word.partition(":")
        quantity, _, digits = name.rpartition("_")
        surface = int(digits) if digits.isdecimal() else -1
        if not 0 <= surface < len(surfaces):
            message = f"variables: {shown(word)}, expected a number and its surface, 0 to {len(surfaces) - 1}"
            raise LensFileError(f"{message}, as curvature_1 or thickness_2:1..20", place)
        try:
            bounds = parse_bounds(word)[name] if colon else ()
            if quantity != "thickness":
                surfaces[surface] = modelled(surfaces[surface], quantity)
            path_of(surfaces[surface], quantity, f"surface {surface}: ")
        except ValueError as error:
            raise LensFileError(f"variables: {error}", place) from error
        variables.append(Vary(surface, quantity, bounds=bounds))
    if not variables:
        return lens
    sized = tuple(k for k, surface in enumerate(surfaces) if surface.semi_diameter)
    data = lens.optimization_data or OptimizationData(semi_diameters=sized)
    data = dataclasses.replace(data, variables=tuple(variables))
    return dataclasses.replace(lens, surfaces=tuple(surfaces), optimization_data=data)


def written_automatic(lens: Lens) -> str:
    """The surfaces whose stored semi-diameters follow the rays, and their margin, as "1 3 4 margin 5.0 0.1"."""
    if (data := lens.optimization_data) is None:
        return ""
    sized = [
        str(k) for k, surface in enumerate(lens.surfaces) if surface.semi_diameter and k not in data.semi_diameters
    ]
    margin = ["margin", *map(repr, data.semi_diameter_margin)] if any(data.semi_diameter_margin) else []
    return " ".join([*sized, *margin])


def with_written_automatic(lens: Lens, words: str, place: Place) -> Lens:
    """The lens with the automatic semi-diameters of a line of its file, and their margin in per cent and mm."""
    if not words.strip():
        return lens
    numbers, _, margin = words.partition("margin")
    try:
        automatic, parts = (
            {int(number) for number in numbers.split()},
            [float(part) for part in margin.split()] or [0.0, 0.0],
        )
        percent, length = parts
    except ValueError as error:
        message = f"automatic: {shown(words)}, expected surfaces and their margin, as 1 3 4 margin 5 0.1"
        raise LensFileError(message, place) from error
    sized = (k for k, surface in enumerate(lens.surfaces) if surface.semi_diameter and k not in automatic)
    data = OptimizationData(semi_diameters=tuple(sized), semi_diameter_margin=(percent, length))
    return dataclasses.replace(lens, optimization_data=data)


def written_conditions(lens: Lens, place: Place) -> str:
    """The conditions of a lens, in words, but for those that take values of other rows of its merit function."""
    try:
        return " ".join(str(condition) for condition in lens.conditions if condition.is_worded)
    except ValueError as error:
        raise LensFileError(str(error), place) from error


def with_written_conditions(lens: Lens, words: str, place: Place) -> Lens:
    """The lens with the conditions of a line of its file."""
    try:
        return lens.with_conditions(words)
    except ValueError as error:
        raise LensFileError(str(error), place) from error


def changes(lens: Lens, again: Lens) -> list[str]:
    """The texts, configurations and optimisation data of a lens that its file does not bring back."""
    pairs: list[tuple[str, object, object]] = [
        ("the title", lens.name, again.name),
        ("a note", lens.notes, again.notes),
    ]
    pairs += [(f"the catalog {name}", name, "") for name in lens.catalogs if name not in again.catalogs]
    surfaces = zip(lens.surfaces, again.surfaces, strict=True)
    pairs += [(f"the comment of surface {k}", a.comment, b.comment) for k, (a, b) in enumerate(surfaces)]
    if count(lens.operands) != count(again.operands):
        pairs.append((f"the other configurations, {count(lens.operands)} in all", lens.current_configuration, 0))
    else:
        pairs += [(str(a), a.values(), b.values()) for a, b in zip(lens.operands, again.operands, strict=False)]
    data, read_again = _in_order(lens.optimization_data), _in_order(again.optimization_data)
    if data is not None and read_again != data and (data.rules or data.merit or data.tolerances):
        pairs.append(("the optimisation data", f"{len(data.merit)} rows of a merit function", ""))
    return [f"{quantity} ({shown(str(before))})" for quantity, before, after in pairs if before != after]
