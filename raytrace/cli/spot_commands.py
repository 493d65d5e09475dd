"""`raytrace spot`."""

import argparse

import torch
from torch import Tensor

from raytrace import pupil
from raytrace.cli.door import field_points, open_lens, print_json, ray_aiming, say
from raytrace.cli.progress import progress
from raytrace.cli.spots import field_label, pupil_points, spot_cells, spot_entry, warn_of_losses
from raytrace.launch import launch
from raytrace.lens import FIELD_UNITS, Lens
from raytrace.rays import Rays
from raytrace.spot import Spot, spot_of_points
from raytrace.spot import spot as spot_of
from raytrace.trace import media, steps


def spot(arguments: argparse.Namespace) -> None:
    """Spot of every field and wavelength on the sensor."""
    if arguments.rays is not None or arguments.max_bytes is not None:
        from raytrace.cli import spot_stream

        return spot_stream.spot(arguments)
    lens = open_lens(arguments)
    fields = field_points(lens, arguments)
    # The rim carries no weight: it shows in the geometric radius, which Gaussian nodes inside the pupil miss.
    points, weights = pupil.with_rim(*pupil_points(arguments))
    rays, unaimed, vignetted = _to_sensor(lens, points, fields, ray_aiming(arguments))
    if unaimed:
        say(f"warning: {unaimed} of {rays.valid.numel()} rays found no way to their point of the stop")
    spots = spot_of(rays, weights)
    warn_of_losses(lens, fields, points, spots.rms_radius.isnan(), aiming=ray_aiming(arguments))
    if arguments.plot:
        from raytrace import plot

        plot.save(plot.spot_diagram(lens, fields=fields, pupil=(points, weights)), arguments.plot)
        say(f"spot diagram written to {arguments.plot}")
    if arguments.json:
        print_json(_spot_document(lens, fields, spots, vignetted))
        return
    unit = FIELD_UNITS[lens.fields.kind]
    print(f"{'field':>10} {'wavelength':>11} {'centroid x':>13} {'centroid y':>13} {'RMS':>10} {'GEO':>10} {'rays':>7}")
    print(f"{unit:>10} {'µm':>11} {'mm':>13} {'mm':>13} {'µm':>10} {'µm':>10} {'lost':>7}")
    for f in range(fields.shape[1]):
        for w, wavelength in enumerate(lens.wavelengths.tolist()):
            lost = rays.valid.shape[-1] - int(spots.rays[f, w])
            print(f"{field_label(fields[:, f]):>10} {wavelength:>11g} {spot_cells(spots, (f, w))} {lost:>7}")
        if len(lens.wavelengths) > 1:
            print(f"{'':>10} {'all':>11} {spot_cells(polychromatic(lens, spots, weights, f), ())}")


def _to_sensor(lens: Lens, points: Tensor, fields: Tensor, aiming: str | None) -> tuple[Rays, int, Tensor]:
    """Rays (3, F, W, P) on the sensor, traced field by field; how many were not aimed; which were vignetted."""
    indices = media(lens, lens.wavelengths[:, None])
    arrived, vignetted, unaimed = [], [], 0
    for field in progress(fields.unbind(1), "field", what="spot"):
        rays = launch(lens, points, fields=field[:, None], ray_aiming=aiming)
        unaimed += int((~rays.valid).sum())
        clipped = torch.zeros_like(rays.valid)
        for crossing in steps(lens.surfaces[1:], rays, indices=indices):
            rays, clipped = crossing.rays, clipped | crossing.clipped
        arrived.append(rays)
        vignetted.append(clipped)
    joined = Rays(
        torch.cat([rays.position for rays in arrived], 1),
        torch.cat([rays.direction for rays in arrived], 1),
        torch.cat([rays.valid for rays in arrived]),
    )
    return joined, unaimed, torch.cat(vignetted)


def polychromatic(lens: Lens, spots: Spot, weights: Tensor, field: int) -> Spot:
    """The spot of one field over all wavelengths, by their weights."""
    wavelength_weights = lens.wavelength_weights / lens.wavelength_weights.sum()
    joint = (wavelength_weights[:, None] * weights).flatten()
    return spot_of_points(spots.points[:, field].flatten(1), spots.valid[field].flatten(), joint)


def _spot_document(lens: Lens, fields: Tensor, spots: Spot, vignetted: Tensor) -> dict:
    results = [
        {
            **spot_entry(fields, wavelength, spots, f, w),
            "vignetted": int(vignetted[f, w].sum()),
            "launched": spots.valid.shape[-1],
        }
        for f in range(fields.shape[1])
        for w, wavelength in enumerate(lens.wavelengths.tolist())
    ]
    return {"field_type": lens.fields.kind, "field_unit": FIELD_UNITS[lens.fields.kind], "results": results}
