"""`raytrace spot --rays`: spots of any number of rays, of which none is kept."""

import argparse

from torch import Tensor

from raytrace.cli.door import CommandError, field_points, open_lens, print_json, ray_aiming
from raytrace.cli.progress import progress
from raytrace.cli.spots import spot_cells, spot_entry
from raytrace.maths import pupil
from raytrace.maths.result import number
from raytrace.optics.losses import warn_of_losses
from raytrace.optics.streaming import MAX_BYTES, StreamedSpot, stream_spots
from raytrace.system.lens import FIELD_UNITS, Lens, name_of_field

_TRIED = 4096  # rays that tell where all are lost
_RIM = 72  # rays on the rim of the pupil, for the largest radius, as the spot of few rays has them


def spot(arguments: argparse.Namespace) -> None:
    """Spot of every field and wavelength; results are printed when all rays are through, or not at all."""
    _check(arguments)
    lens = open_lens(arguments)
    fields = field_points(lens, arguments)
    total = arguments.rays * fields.shape[1] * len(lens.wavelengths)
    with progress(total, "ray", what="spot") as bar:
        each, whole = stream_spots(
            lens,
            arguments.rays,
            fields=fields,
            sampling="random" if arguments.sampling == "random" else "sobol",
            seed=arguments.seed,
            rim=_RIM,
            ray_aiming=ray_aiming(arguments),
            max_bytes=MAX_BYTES if arguments.max_bytes is None else arguments.max_bytes,
            progress=bar.update,
        )
    points = pupil.sobol(min(arguments.rays, _TRIED))[0]
    warn_of_losses(lens, points, each.rays == 0, fields=fields, ray_aiming=ray_aiming(arguments))
    if arguments.json:
        print_json(_document(lens, fields, each))
    else:
        _print(lens, fields, each, whole)


def _check(arguments: argparse.Namespace) -> None:
    if arguments.reference != "centroid" or arguments.weights != "area":
        raise CommandError("--rays gives radii about the centroid by area: leave --reference and --weights out")
    for name in ("rings", "points"):
        if getattr(arguments, name) is not None:
            raise CommandError(f"--rays and --{name} exclude each other: both are a number of rays")
    if arguments.sampling in ("hexapolar", "square"):
        raise CommandError(f"--rays takes --sampling sobol (its default) or random, not {arguments.sampling}")
    for option, given in (("--plot", arguments.plot), ("-o", arguments.output)):
        if given:
            raise CommandError(f"{option} needs the rays, and --rays keeps none: leave one out")


def _document(lens: Lens, fields: Tensor, spots: StreamedSpot) -> dict:
    results = [
        {
            **spot_entry(fields, wavelength, spots, f, w),
            "geometric_bound": number(spots.geometric_bound[f, w]),
            "launched": spots.launched,
        }
        for f in range(fields.shape[1])
        for w, wavelength in enumerate(lens.wavelengths.tolist())
    ]
    return {"field_type": lens.fields.kind, "field_unit": FIELD_UNITS[lens.fields.kind], "results": results}


def _print(lens: Lens, fields: Tensor, each: StreamedSpot, whole: StreamedSpot) -> None:
    unit = FIELD_UNITS[lens.fields.kind]
    print(
        f"{'field':>10} {'wavelength':>11} {'centroid x':>13} {'centroid y':>13} {'RMS':>10} {'GEO':>10} {'rays':>12}"
    )
    print(f"{unit:>10} {'µm':>11} {'mm':>13} {'mm':>13} {'µm':>10} {'µm':>10} {'lost':>11}")
    for f in range(fields.shape[1]):
        label = name_of_field(fields[:, f])
        for w, wavelength in enumerate(lens.wavelengths.tolist()):
            print(
                f"{label:>10} {wavelength:>11g} {spot_cells(each, (f, w))} {each.launched - int(each.rays[f, w]):>11}"
            )
        if len(lens.wavelengths) > 1:
            print(f"{'':>10} {'all':>11} {spot_cells(whole, (f,))}")
