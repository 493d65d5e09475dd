"""`raytrace focus`."""

import argparse
import warnings

import torch
from torch import Tensor

from raytrace.cli.door import (
    CommandError,
    catalogs,
    field_points,
    find_lens,
    number,
    numbers,
    open_lens,
    primary,
    print_json,
    say,
)
from raytrace.cli.spots import field_label, pupil_points
from raytrace.focus import focus as best_focus
from raytrace.focus import focus_moments, focus_of_merit, image_rays
from raytrace.formats import read_lens, write_lens
from raytrace.lens import FIELD_UNITS, Lens, with_object_distance, with_sensor_distance
from raytrace.numerics import safe_sqrt
from raytrace.paraxial import first_order, paraxial_image_distance
from raytrace.spot import spot as spot_of


def focus(arguments: argparse.Namespace) -> None:
    """Best sensor distance, before and after."""
    lens = open_lens(arguments)
    distances = arguments.object_distance or [float(lens.surfaces[0].thickness)]
    fields = field_points(lens, arguments, on_axis=True)
    wavelengths = lens.wavelengths if arguments.wavelength else primary(lens)[None]
    points, weights = pupil_points(arguments)
    _check_weights(arguments, distances, fields, wavelengths)
    rule = {
        "object_distances": distances,
        "distance_weights": arguments.distance_weights,
        "fields": fields,
        "wavelengths": wavelengths,
        "field_weights": _optional(arguments.field_weights),
        "wavelength_weights": _optional(arguments.wavelength_weights),
    }
    before = lens.surfaces[-2].thickness
    paraxial = paraxial_image_distance(lens, before.new_tensor(distances))
    if not bool(torch.isfinite(paraxial).all()):
        raise CommandError(f"{arguments.lens}: the lens is afocal for this object distance; there is no focus to find")
    arrived = _refuse_without_focus(arguments, lens, points, rule)
    if arrived < 1:
        say(f"warning: {1 - arrived:.2%} of the rays are lost; the focus is of the rest")
    rms = best_focus(lens, points, weights, **rule)
    shares = paraxial.new_tensor(arguments.distance_weights or [1.0] * len(distances))
    after = {"rms": rms, "paraxial": (shares * paraxial).sum() / shares.sum()}.get(arguments.criterion)
    if after is None:
        after = focus_of_merit(lambda s: _mean_distance(lens, s, points, weights, rule), rms).detach()
    result = {
        "object_distance": number(distances[0]) if len(distances) == 1 else [number(d) for d in distances],
        "sensor_before": number(before),
        "sensor_paraxial": number(paraxial[0]) if len(distances) == 1 else numbers(paraxial),
        "sensor_rms": number(rms),
        "sensor_after": number(after),
        "rms_before": _rms(lens, before, points, weights, rule),
        "rms_after": _rms(lens, after, points, weights, rule),
    }
    focused = with_sensor_distance(lens, after)
    if arguments.plot:
        from raytrace import plot

        figure = plot.focus_report(
            lens,
            focused,
            object_distances=distances,
            fields=fields,
            wavelengths=wavelengths,
            wavelength_weights=rule["wavelength_weights"],
            pupil=(points, weights),
        )
        plot.save(figure, arguments.plot)
    if arguments.output:
        write_lens(_as_in_file(focused, arguments), arguments.output)
    if arguments.json:
        print_json(result)
    else:
        _print_focus(lens, arguments, distances, fields, wavelengths, paraxial, result, points, weights, rule)
    for path in filter(None, (arguments.plot, arguments.output)):
        say(f"written: {path}")


def _refuse_without_focus(arguments: argparse.Namespace, lens: Lens, points: Tensor, rule: dict) -> float:
    """The fraction of rays that reach the image. Raises CommandError if too few do, or all are parallel."""
    valid, variance = [], 0.0
    for distance in rule["object_distances"]:
        rays = image_rays(
            with_object_distance(lens, distance), points, fields=rule["fields"], wavelengths=rule["wavelengths"]
        )
        valid.append(rays.valid.double().mean())
        variance += float(focus_moments(rays)[1].sum())
    arrived = float(torch.stack(valid).mean())
    if arrived == 0:
        raise CommandError(f"{arguments.lens}: no ray reaches the image; `raytrace trace` says where they are lost")
    if variance == 0:
        raise CommandError(f"{arguments.lens}: one ray, or parallel rays, have no focus; ask for more rays (--size)")
    return arrived


def _as_in_file(focused: Lens, arguments: argparse.Namespace) -> Lens:
    """The lens as the file has it, with the new sensor distance: a trial object distance is not part of the lens."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # said when the file was read first
        original = read_lens(find_lens(arguments.lens), catalogs=catalogs(arguments))
    return with_sensor_distance(original, focused.surfaces[-2].thickness)


def _rms(lens: Lens, sensor: Tensor, points: Tensor, weights: Tensor, rule: dict) -> float | None:
    """Root of the weighted mean of the mean square radii over distances, fields and wavelengths, mm."""
    square = _average(lens, sensor, points, rule, lambda rays: spot_of(rays, weights).mean_square_radius)
    return None if square is None else number(safe_sqrt(square))


def _mean_distance(lens: Lens, sensor: Tensor, points: Tensor, weights: Tensor, rule: dict) -> Tensor:
    """Weighted mean distance of the hits from their centroid, mm."""

    def merit(rays):
        found = spot_of(rays, weights)
        offset = rays.position[:2] - found.centroid[..., None]
        distance = torch.where(rays.valid, safe_sqrt(offset[0] ** 2 + offset[1] ** 2), 0.0)
        return (weights * distance).sum(-1) / torch.where(rays.valid, weights, 0.0).sum(-1).clamp_min(1e-300)

    return _average(lens, sensor, points, rule, merit)


def _average(lens: Lens, sensor: Tensor, points: Tensor, rule: dict, merit) -> Tensor | None:
    """Mean of a merit (F, W) over distances × fields × wavelengths by the rule's weights; None if no ray arrives."""
    total = share = 0.0
    distance_weights = rule["distance_weights"] or [1.0] * len(rule["object_distances"])
    for distance, distance_weight in zip(rule["object_distances"], distance_weights, strict=True):
        trial = with_sensor_distance(with_object_distance(lens, distance), sensor)
        rays = image_rays(trial, points, fields=rule["fields"], wavelengths=rule["wavelengths"])
        portion = rays.valid.any(-1).to(rays.position.dtype) * distance_weight
        portion = portion if rule["field_weights"] is None else portion * rule["field_weights"][:, None]
        portion = portion if rule["wavelength_weights"] is None else portion * rule["wavelength_weights"]
        total, share = total + (portion * merit(rays)).sum(), share + portion.sum()
    return total / share if float(share) > 0 else None


def _print_focus(lens, arguments, distances, fields, wavelengths, paraxial, result, points, weights, rule) -> None:
    data = first_order(lens, primary(lens))
    print(f"{arguments.lens}: {lens.name}" if lens.name else arguments.lens)
    print(
        f"  effective focal length {float(data.effective_focal_length):.6f} mm, F/{float(data.f_number):.4g}, ", end=""
    )
    print(f"back focal distance {float(data.back_focal_distance):.6f} mm")
    place = float(data.entrance_pupil_position)
    print(f"  entrance pupil {float(data.entrance_pupil_diameter):.5g} mm across, {place:.5g} mm from surface 1")
    shown = ", ".join("infinity" if d == float("inf") else f"{d:g} mm" for d in distances)
    unit = FIELD_UNITS[lens.fields.kind]
    at = ", ".join(field_label(field) for field in fields.unbind(1))
    colours = ", ".join(f"{w:g}" for w in wavelengths.tolist())
    print(f"  object at {shown}; field {at} {unit}; {colours} µm; criterion {arguments.criterion}\n")
    rows = [("before", result["sensor_before"]), ("after", result["sensor_after"])]
    rows += [
        (
            f"paraxial image of {'infinity' if d == float('inf') else f'{d:g} mm'}"
            if len(distances) > 1
            else "paraxial",
            p,
        )
        for d, p in zip(distances, paraxial.tolist(), strict=True)
    ]
    rows.append(("best RMS", result["sensor_rms"]))
    print(f"  {'':<28} {'sensor distance':>18} {'RMS spot radius':>18}")
    for words, sensor in rows:
        rms = _rms(lens, paraxial.new_tensor(sensor), points, weights, rule)
        print(f"  {words:<28} {sensor:>15.6f} mm {'no rays' if rms is None else f'{1000 * rms:>15.4f} µm'}")


def _check_weights(arguments, distances, fields, wavelengths) -> None:
    for name, given, count in (
        ("--distance-weights", arguments.distance_weights, len(distances)),
        ("--field-weights", arguments.field_weights, fields.shape[1]),
        ("--wavelength-weights", arguments.wavelength_weights, len(wavelengths)),
    ):
        if given is not None and len(given) != count:
            raise CommandError(f"{name}: {len(given)} given, expected {count}, one for each")


def _optional(values: list[float] | None) -> Tensor | None:
    return None if values is None else torch.tensor(values, dtype=torch.float64)
