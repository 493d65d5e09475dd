"""Fields that no ray reaches, and results that show nothing: told before tables and axes stay empty."""

import argparse

import torch
from torch import Tensor

from raytrace.analysis import Distortion, FieldCurvature, LateralColour, RelativeIllumination
from raytrace.cli.door import CommandError
from raytrace.maths.result import Result, flat
from raytrace.optics import losses
from raytrace.system.lens import Lens

_OVER_FIELD = (Distortion, FieldCurvature, LateralColour, RelativeIllumination)


def check_reach(arguments: argparse.Namespace, lens: Lens, fields: Tensor, *, every: bool) -> None:
    """Tell of fields (2, F) that are out of reach, as the library does, with the name of the lens."""
    try:
        losses.check_reach(lens, fields if arguments.fields else None, every=every)
    except losses.OutOfReach as error:
        raise CommandError(f"{arguments.lens}: {error}") from error


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
