"""`raytrace focus`."""

import argparse
import warnings

import torch
from torch import Tensor

from raytrace.cli.door import CommandError, catalogs, field_points, find_lens, open_lens, primary, print_json, say
from raytrace.cli.spots import pupil_points
from raytrace.formats import read_lens, write_lens
from raytrace.maths.result import number, numbers
from raytrace.optics.focus import focus_of_mean_radius, focus_of_rms, image_rays, is_behind, mean_rms_radius
from raytrace.optics.losses import warn_of_losses
from raytrace.optics.paraxial import first_order, paraxial_image_distance
from raytrace.system.lens import FIELD_UNITS, Lens, name_of_field, with_object_distance, with_sensor_distance


def focus(arguments: argparse.Namespace) -> None:
    """Best sensor distance, before and after."""
    lens = open_lens(arguments)
    distances = arguments.object_distances or [float(lens.surfaces[0].thickness)]
    fields = field_points(lens, arguments, on_axis=True)
    wavelengths = lens.wavelengths if arguments.wavelengths else primary(lens)[None]
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
    rms = focus_of_rms(lens, points, weights, **rule)
    _tell_losses(arguments, lens, points, rule)
    if not bool(torch.isfinite(rms)):
        raise CommandError(f"{arguments.lens}: one ray, or parallel rays, have no focus; give more --rings or --points")
    shares = paraxial.new_tensor(arguments.distance_weights or [1.0] * len(distances))
    after = {"rms": rms, "paraxial": (shares * paraxial).sum() / shares.sum()}.get(arguments.criterion)
    if after is None:
        after = focus_of_mean_radius(lens, points, weights, **rule)
    result = {
        "object_distance": number(distances[0]) if len(distances) == 1 else [number(d) for d in distances],
        "sensor_before": number(before),
        "sensor_paraxial": number(paraxial[0]) if len(distances) == 1 else numbers(paraxial),
        "sensor_rms": number(rms),
        "sensor_after": number(after),
        "rms_before": _rms(lens, before, points, weights, rule),
        "rms_after": _rms(lens, after, points, weights, rule),
        "is_real": is_behind(lens, after),
    }
    if not result["is_real"]:
        place = f"{float(after):g} mm, on the side of the last surface that the light comes from"
        say(f"warning: the image is virtual, at {place}: no sensor can stand there; take the object further away")
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


def _tell_losses(arguments: argparse.Namespace, lens: Lens, points: Tensor, rule: dict) -> None:
    """Warn of rays that do not reach the image. Raises CommandError if none does."""
    arrived = []
    for distance in rule["object_distances"]:
        trial = with_object_distance(lens, distance)
        valid = image_rays(trial, points, fields=rule["fields"], wavelengths=rule["wavelengths"]).valid
        at = f"object at {distance:g} mm, " if len(rule["object_distances"]) > 1 else ""
        warn_of_losses(trial, points, ~valid.any(-1), fields=rule["fields"], wavelengths=rule["wavelengths"], at=at)
        arrived.append(float(valid.double().mean()))
    lost = 1 - sum(arrived) / len(arrived)
    if lost == 1:
        raise CommandError(f"{arguments.lens}: no ray reaches the image")
    if lost > 0:
        say(f"warning: {lost:.2%} of the rays are lost; the focus is of the rest")


def _as_in_file(focused: Lens, arguments: argparse.Namespace) -> Lens:
    """The lens as the file has it, with the new sensor distance: a trial object distance is not part of the lens."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # said when the file was read first
        original = read_lens(find_lens(arguments.lens), catalogs=catalogs(arguments))
    return with_sensor_distance(original, focused.surfaces[-2].thickness)


def _rms(lens: Lens, sensor: Tensor, points: Tensor, weights: Tensor, rule: dict) -> float | None:
    """RMS radius over distances, fields and wavelengths, mm; None where no ray arrives."""
    return number(mean_rms_radius(with_sensor_distance(lens, sensor), points, weights, **rule))


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
    at = ", ".join(name_of_field(field) for field in fields.unbind(1))
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
