"""The closed form of co-design with rays that are drawn anew at every step: where is the lens in focus?

    python docs/experiments/codesign_redrawn.py double_gauss --data DIR -o docs/codesign/redrawn.csv

A network that is trained with rays drawn at random for every step knows neither the object distance nor the draw. The
closed form of this training is the mean square error behind one filter for all kernels: those of 33 object distances
and `--draws` draws of N rays, uniform over the pupil. Columns: aperture, number of rays (0: converged to the
tolerance), model, ρ of the paraxial model, sensor distance of the least error, the object distances in focus there, of
paraxial rays and of the least RMS spot, and the root of the error.
"""

import argparse
import dataclasses
import math
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path

import torch
from torch import Tensor, nn
from tqdm import tqdm

import raytrace as rt
from raytrace.files import write_table
from raytrace.imaging.camera import Camera
from raytrace.imaging.closed_form import even_distances, focus_columns
from raytrace.imaging.codesign import lens_at_start, sensor_at_start, spectrum_of, variables
from raytrace.imaging.pictures import files, read
from raytrace.imaging.restoration import kernel_error
from raytrace.psf_models.models import Model, model_of
from raytrace.settings import CodesignSettings
from raytrace.system.lens import Lens
from raytrace.tracing.focus import paraxial_sensor

_FOCI = 15e3, 200e3  # mm, object distances whose paraxial images are the ends of the sensor distances


def disc(count: int, generator: torch.Generator) -> Tensor:
    """Pupil points (2, count), uniform over the unit disc."""
    radius = torch.rand(count, generator=generator, dtype=torch.float64).sqrt()
    angle = 2 * math.pi * torch.rand(count, generator=generator, dtype=torch.float64)
    return torch.stack([radius * angle.cos(), radius * angle.sin()])


@torch.no_grad()
def optimum(lens: Lens, settings: CodesignSettings, models: Sequence[Model], spectrum: Tensor, sensors: int) -> dict:
    """The sensor of the least error behind one filter for the kernels of all models, by a scan and a parabola."""
    lens_variables = variables(lens, settings)
    cameras = [
        Camera(
            lens_variables, nn.Identity(), sensor=sensor_at_start(settings), model=model, pixels=settings.size,
            object_distances=(settings.near, settings.far), fields=settings.fields, normalise=settings.normalise,
            tol=settings.tol, center="chief",
        )
        for model in models
    ]  # fmt: skip
    distances = even_distances(cameras[0])
    sigma = cameras[0].sensor.noise_deviation(spectrum)
    (sensor,) = lens_variables.variables
    parameter = lens_variables.get_parameter(sensor.name)

    def error(place: float) -> float:
        parameter.fill_((place - sensor.start) / sensor.unit)
        kernels = torch.cat([camera.kernels_over_field(distances) for camera in cameras])
        return float(kernel_error(kernels, spectrum.to(kernels.dtype), sigma).mean())

    foci = torch.tensor(_FOCI[::-1], dtype=torch.float64)
    far, near = (float(place) for place in paraxial_sensor(lens_variables(), foci))
    step = (near - far) / (sensors - 1)
    places = [far - 0.25 + step * k for k in range(round((near - far + 0.5) / step) + 1)]
    errors = [error(place) for place in places]
    k = min(range(1, len(places) - 1), key=errors.__getitem__)
    before, here, after = errors[k - 1 : k + 2]
    place = places[k] + 0.5 * step * (before - after) / (before - 2 * here + after)
    least = error(place)
    return {**focus_columns(lens_variables()), "rms_error": math.sqrt(least)}


def rows(options: argparse.Namespace) -> Iterator[dict]:
    """A row for each aperture, model and number of rays."""
    samples = read(files(options.data, options.limit), least=84)
    usual = CodesignSettings()
    spectrum = spectrum_of(samples, usual)
    lens = rt.read_lens(options.lens)
    for f_number in options.f_number:
        settings = dataclasses.replace(usual, f_number=f_number)
        plain = [
            ("paraxial", 0.5, 0),
            ("paraxial", 0.7, 0),
            *((name, None, 0) for name in ("fourier", "gaussian", "drt")),
        ]
        drawn = [("gaussian", None, count) for count in options.rays]
        for model, rho, count in tqdm(plain + drawn, desc=f"F/{f_number:g}", unit="rows", mininterval=5):
            generator = torch.Generator().manual_seed(0)
            models = [model_of(model, rays=disc(count, generator)) for _ in range(options.draws if count else 0)]
            if not models:
                models = [model_of(model, **({} if rho is None else {"rho": rho}))]
            least = optimum(lens_at_start(lens, settings), settings, models, spectrum, options.sensors)
            yield {"f_number": f_number, "rays": count, "model": model, "rho": rho} | least


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("lens", metavar="LENS", help="lens file, or the name of a shipped lens")
    parser.add_argument("--data", metavar="DIR", required=True, help="folder of pictures, whose spectrum is taken")
    parser.add_argument("--limit", metavar="N", type=int, help="use N of them, evenly spaced")
    parser.add_argument("--f-number", metavar="N", type=float, nargs="+", default=[3.0, 2.0])
    parser.add_argument("--rays", metavar="N", type=int, nargs="+", default=[37, 100], help="of a draw of Gaussian DRT")
    parser.add_argument("--draws", metavar="N", type=int, default=16, help="of the rays (default 16)")
    parser.add_argument("--sensors", metavar="N", type=int, default=25, help="between 15 and 200 m (default 25)")
    parser.add_argument("-o", "--output", metavar="FILE", type=Path, required=True, help="table, .csv")
    options = parser.parse_args()
    warnings.simplefilter("ignore", rt.DarkPlaces)  # far from focus the light is beside the window
    written: list[dict] = []
    for row in rows(options):
        written.append(row)
        write_table(options.output, written, floats="{:.7g}".format)


if __name__ == "__main__":
    main()
