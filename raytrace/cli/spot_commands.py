"""`raytrace spot`."""

import argparse
import dataclasses

import torch
from torch import Tensor

from raytrace.analysis import chief_reference
from raytrace.cli.door import field_points, open_lens, print_json, ray_aiming, refuse_suffix, say
from raytrace.cli.progress import progress
from raytrace.cli.spots import pupil_points, spot_cells, spot_entry
from raytrace.files import write_atomically
from raytrace.maths import pupil
from raytrace.optics.arrivals import Arrivals, arrivals
from raytrace.optics.losses import STATUS, warn_of_losses
from raytrace.optics.spot import Spot, spot_of, spot_of_points
from raytrace.system.lens import FIELD_UNITS, Lens, name_of_field


def spot(arguments: argparse.Namespace) -> None:
    """Spot of every field and wavelength on the sensor."""
    if arguments.rays is not None:
        from raytrace.cli import spot_stream

        return spot_stream.spot(arguments)
    refuse_suffix("-o", arguments.output, (".csv", ""))
    lens = open_lens(arguments)
    fields = field_points(lens, arguments)
    points, weights = pupil_points(arguments)
    if arguments.weights == "equal":
        weights = torch.full_like(weights, 1 / len(weights))
    else:  # the rim carries no weight: it shows in the geometric radius, which Gaussian nodes inside the pupil miss
        points, weights = pupil.with_rim(points, weights)
    found = arrivals(
        lens,
        points,
        weights,
        fields=fields,
        ray_aiming=ray_aiming(arguments),
        progress=lambda each: progress(each, "field", what="spot"),
    )
    if unaimed := int((found.status == STATUS.index("unaimed")).sum()):
        say(f"warning: {unaimed} of {found.status.numel()} rays found no way to their point of the stop")
    about = None
    if arguments.reference == "chief":
        aiming = ray_aiming(arguments) or lens.ray_aiming
        about = chief_reference(dataclasses.replace(lens, ray_aiming=aiming), fields)
    spots = spot_of(found.rays, weights, about=about)
    warn_of_losses(lens, points, spots.rms_radius.isnan(), fields=fields, ray_aiming=ray_aiming(arguments))
    if arguments.plot:
        from raytrace import plot

        figure = plot.spot_diagram(lens, fields=fields, pupil=(points, weights), reference=arguments.reference)
        plot.save(figure, arguments.plot)
        say(f"spot diagram written to {arguments.plot}")
    if arguments.output:
        write_atomically(arguments.output, lambda file: found.to_frame().to_csv(file, index=False))
        say(f"rays written to {arguments.output}")
    if arguments.json:
        print_json(
            {**_spot_document(lens, found, spots), "reference": arguments.reference, "weights": arguments.weights}
        )
        return
    unit = FIELD_UNITS[lens.fields.kind]
    print(f"{'field':>10} {'wavelength':>11} {'centroid x':>13} {'centroid y':>13} {'RMS':>10} {'GEO':>10} {'rays':>7}")
    print(f"{unit:>10} {'µm':>11} {'mm':>13} {'mm':>13} {'µm':>10} {'µm':>10} {'lost':>7}")
    for f in range(fields.shape[1]):
        for w, wavelength in enumerate(lens.wavelengths.tolist()):
            lost = points.shape[1] - int(spots.rays[f, w])
            print(f"{name_of_field(fields[:, f]):>10} {wavelength:>11g} {spot_cells(spots, (f, w))} {lost:>7}")
        if len(lens.wavelengths) > 1:
            print(f"{'':>10} {'all':>11} {spot_cells(polychromatic(lens, spots, weights, f, about), ())}")


def polychromatic(lens: Lens, spots: Spot, weights: Tensor, field: int, about: Tensor | None = None) -> Spot:
    """The spot of one field over all wavelengths, by their weights; about: (2, F, 1) mm or the centroid."""
    wavelength_weights = lens.wavelength_weights / lens.wavelength_weights.sum()
    joint = (wavelength_weights[:, None] * weights).flatten()
    about = None if about is None else about[:, field, 0]
    return spot_of_points(spots.points[:, field].flatten(1), spots.valid[field].flatten(), joint, about=about)


def _spot_document(lens: Lens, found: Arrivals, spots: Spot) -> dict:
    vignetted = (found.status == STATUS.index("vignetted")).sum(-1)
    results = [
        {
            **spot_entry(found.fields, wavelength, spots, f, w),
            "vignetted": int(vignetted[f, w]),
            "launched": spots.valid.shape[-1],
        }
        for f in range(found.fields.shape[1])
        for w, wavelength in enumerate(lens.wavelengths.tolist())
    ]
    return {"field_type": lens.fields.kind, "field_unit": FIELD_UNITS[lens.fields.kind], "results": results}
