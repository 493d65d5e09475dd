"""Fields that no ray reaches, and results that show nothing: told before tables and axes stay empty."""

import argparse
import warnings

import torch
from torch import Tensor

from raytrace.analysis import Distortion, FieldCurvature, LateralColour, RelativeIllumination
from raytrace.cli.door import CommandError, primary, say
from raytrace.maths.pupil import hexapolar
from raytrace.maths.result import Result, flat
from raytrace.optics.losses import beam_hint, losses
from raytrace.system.lens import FIELD_UNITS, Lens, name_of_field

_RINGS = 8  # of the rays that try a field
_OVER_FIELD = (Distortion, FieldCurvature, LateralColour, RelativeIllumination)


def check_reach(arguments: argparse.Namespace, lens: Lens, fields: Tensor, *, every: bool) -> None:
    """Tell of fields (2, F) of which no ray reaches the sensor at the primary wavelength, why, and what helps.

    Raises CommandError if there is one and the command needs every field, else if no field is left; else warns.
    """
    pupil, _ = hexapolar(_RINGS, dtype=lens.wavelengths.dtype)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the command itself tells what aiming has to say
        found = losses(lens, pupil, fields=fields, wavelengths=primary(lens)[None])
    dark = (found.arrived[:, 0] == 0).nonzero()[:, 0].tolist()
    if not dark:
        return
    unit = FIELD_UNITS[lens.fields.kind]
    named = ((f, f"{name_of_field(fields[:, f])} {unit}") for f in dark)
    told = [f"no ray of field {field} reaches the sensor: {found.words(f, 0)}" for f, field in named]
    if every or len(dark) == fields.shape[1]:
        raise CommandError(f"{arguments.lens}: {told[0]}; {_help(arguments, lens)}")
    for words in told:
        say(f"warning: {words}; {_help(arguments, lens)}")


def _help(arguments: argparse.Namespace, lens: Lens) -> str:
    """What to do about a field out of reach."""
    if hint := beam_hint(lens):
        return f"{hint}; see --f-number and --entrance-pupil-diameter"
    if getattr(arguments, "fields", None):
        largest = float(torch.hypot(lens.fields.x, lens.fields.y).amax())
        return f"the lens's own fields go to {largest:g} {FIELD_UNITS[lens.fields.kind]}, give --field within"
    return "give other fields by --field, a smaller beam by --f-number or --entrance-pupil-diameter"


def refuse_empty(arguments: argparse.Namespace, lens: Lens, found: Result) -> None:
    """Raise CommandError for a result that shows nothing, with the cause and the option that helps."""
    columns = found.columns()
    if isinstance(found, LateralColour) and len(found.wavelengths) < 2:
        one = float(found.wavelengths[0])
        raise CommandError(
            f"{arguments.lens}: nothing to show: lateral colour is a difference of wavelengths, and there is one, "
            f"{one:g} µm; give several by --wavelength"
        )
    on_axis = isinstance(found, _OVER_FIELD) and not bool(found.fields.any())
    if on_axis and (isinstance(found, Distortion | LateralColour) or arguments.plot or not arguments.fields):
        raise CommandError(
            f"{arguments.lens}: nothing to show over the field: all fields are on the axis; give others by --field"
        )
    values = {name: column for name, column in columns.items() if name not in ("field_x", "field_y", "wavelength")}
    if not any(torch.from_numpy(column).isfinite().any() for column in flat(values).values()):
        raise CommandError(
            f"{arguments.lens}: nothing to show: no number of {arguments.command} exists for this lens; "
            "`raytrace info` tells whether it has a focal length and an image"
        )
