"""What the package answers to the cases of tests/oracles/opticstudio.json.gz: systems from numbers, a function a call.

Every answer is a flat list in the order and the units of OpticStudio's report: transverse lengths of fans, spots and
PSFs in µm, OPD in waves with the sign turned, distortion in %.
"""

import dataclasses
import functools
import gzip
import json
import math
import os
from pathlib import Path

import torch

import raytrace as rt
from raytrace.io.zemax.surfaces import AIMINGS
from raytrace.materials import glass
from raytrace.materials.catalogs import find_glass
from raytrace.materials.environment import Environment
from raytrace.maths import zernike
from raytrace.maths.sampling import gauss_rings, hexapolar
from raytrace.psf_models import wave
from raytrace.psf_models.strehl import strehl as strehl_of
from raytrace.system.lens import FIELD_UNITS, Fields, Lens, SystemAperture, media
from raytrace.system.rays import Rays
from raytrace.system.surface import Aperture, Surface
from raytrace.tracing.launch import launch, stop_radius
from raytrace.tracing.paraxial import first_order
from raytrace.tracing.scene import Scene, scene
from raytrace.tracing.trace import steps, trace_lens
from raytrace.tracing.wavefront import peak_to_valley, rms, wavefront_of

ORACLE = Path(__file__).parent / "oracles" / "opticstudio.json.gz"

APERTURES = {"ENPD": "entrance_pupil_diameter", "FNUM": "image_f_number", "OBNA": "object_na"}


def read(path: Path) -> dict:
    """The systems and cases of a file, compressed or not."""
    data = path.read_bytes()
    return json.loads(gzip.decompress(data) if data[:2] == b"\x1f\x8b" else data)


#: Another file of the same schema: every case of it is run instead. One that cannot be read fails the run.
ELSEWHERE = os.environ.get("RAYTRACE_OPTICSTUDIO")
FILE = read(Path(ELSEWHERE) if ELSEWHERE else ORACLE)
CASES = FILE["cases"]


def tensor(numbers) -> torch.Tensor:
    return torch.as_tensor(numbers, dtype=torch.float64)


# ---------------------------------------------------------------- systems

#: atm behind surfaces: operands of the files (PRES 0, those between it and PRES 1) that the descriptions do not have.
PRESSURES = {"f_vacuum_cell": {3: 0.0, 5: 0.0}}


def description(name: str) -> dict:
    """The keys of a system, those of its base first."""
    found = FILE["systems"][name]
    return {**(description(found["base"]) if "base" in found else {}), **found}


@functools.cache
def system(name: str) -> Lens:
    """The lens of a name."""
    system = description(name)
    surfaces = [_surface(k, row, system) for k, row in enumerate(system["surfaces"])]
    for k, pressure in PRESSURES.get(name, {}).items():
        surfaces[k] = dataclasses.replace(surfaces[k], environment=Environment(tensor(20.0), tensor(pressure)))
    kind, size = system["aperture"][:2]
    stop = system["stop"]
    if kind == "FLOA":
        aperture = SystemAperture("float_by_stop", tensor(surfaces[stop].semi_diameter))
    else:
        aperture = SystemAperture(APERTURES[kind], tensor(float(size)))
    fields, waves = system["fields"], system["wavelengths"]
    x, y = (tensor([float(v) for v in fields[axis]]) for axis in "xy")
    factors = tensor(fields["vignetting"]) if "vignetting" in fields else None
    return Lens(
        surfaces=tuple(surfaces),
        stop=stop,
        aperture=aperture,
        fields=Fields(list(FIELD_UNITS)[fields["type"]], x, y, torch.ones_like(x), factors),
        wavelengths=tensor([wavelength for wavelength, _ in waves]),
        wavelength_weights=tensor([weight for _, weight in waves]),
        primary_wavelength=system["primary"],
        catalogs=tuple(system.get("catalogs", ())),
        ray_aiming=AIMINGS[system["ray_aiming"]],
    )


def _surface(number: int, row: list, system: dict) -> Surface:
    """[curvature, thickness, glass, conic, coefficients of r², r⁴, …, semi-diameter, apertures]."""
    curvature, thickness, medium, conic, coefficients, semi_diameter, *apertures = row
    thickness = system.get("thickness", {}).get(str(number), thickness)
    curvature = system.get("curvature", {}).get(str(number), curvature)
    return Surface(
        thickness=tensor(float(thickness)),
        curvature=tensor(float(curvature)) if curvature else None,
        conic=tensor(float(conic)) if conic else None,
        coefficients=tensor(coefficients) if coefficients else None,
        glass=_medium(medium, system),
        semi_diameter=semi_diameter,
        apertures=tuple(_aperture(*one) for one in apertures if one),
    )


def _aperture(shape: str, extent: list, obscures: bool = False, centre=(0.0, 0.0)) -> Aperture:
    return Aperture(shape, tuple(extent), obscures, tuple(centre))


def _medium(medium, lens: dict) -> glass.Glass:
    """Air (null), MIRROR, an index, [nd, Vd, ΔPgF], or a name: by the indices of the system, else of a catalog."""
    if medium is None:
        return glass.AIR
    if isinstance(medium, int | float):
        return glass.constant(float(medium))
    if isinstance(medium, list):
        return glass.model_glass(*medium)
    if medium == "MIRROR":
        return glass.MIRROR
    if medium not in lens.get("indices", {}):
        return find_glass(medium, catalogs=lens.get("catalogs", ()))
    # The printed indices of at most three wavelengths, by n² = a + b λ² + c/λ², which passes through them.
    listed = lens["indices"][medium]
    waves, indices = tensor([float(w) for w in listed]), tensor(list(listed.values()))
    powers = torch.stack([waves ** (2 * k) for k in (0, 1, -1)][: len(waves)], 1)
    found = torch.linalg.solve(powers, indices * indices)
    return glass.Glass(medium, "schott", torch.cat([found, found.new_zeros(6 - len(found))]))


# ---------------------------------------------------------------- conditions of a case


def lens_of(case: dict) -> Lens:
    return system(case["system"])


def fields_of(case: dict) -> torch.Tensor:
    """(2, F) of `fields`, heights along y or pairs; the lens's own where there is none."""
    lens = lens_of(case)
    if "fields" not in case:
        return torch.stack([lens.fields.x, lens.fields.y])
    return tensor([f if isinstance(f, list) else [0.0, float(f)] for f in case["fields"]]).T


def waves_of(case: dict) -> torch.Tensor:
    """(W,) µm of `wavelength`, one or several; the primary one where there is none."""
    lens = lens_of(case)
    if "wavelength" not in case:
        return lens.primary.reshape(1)
    return tensor(case["wavelength"]).reshape(-1)


def of_waves(case: dict, values: torch.Tensor) -> torch.Tensor:
    """Values (F, W, ...) at the wavelengths of a lens: those of the case, whatever is primary."""
    known = lens_of(case).wavelengths.tolist()
    return values[:, [known.index(wavelength) for wavelength in waves_of(case).tolist()]]


def points_of(case: dict) -> tuple[torch.Tensor, torch.Tensor]:
    """Pupil points (2, P) and weights of `sampling`: ["grid", N], ["points", list] or ["gq", rings, arms]."""
    kind, *numbers = case.get("sampling", ["gq", 14, 56])
    if kind == "gq":
        points, weights = gauss_rings(*numbers, dtype=torch.float64)
        if "sampling" in case:  # OpticStudio's arms begin at +x
            first = torch.atan2(points[1, 0], points[0, 0])
            c, s = torch.cos(first), torch.sin(first)
            points = torch.stack([c * points[0] + s * points[1], c * points[1] - s * points[0]])
        return points, weights
    if kind == "points":
        points = tensor(numbers[0]).T
    else:
        half = numbers[0] // 2 - 1
        line = torch.arange(-half, half + 1, dtype=torch.float64) / half
        y, x = torch.meshgrid(line, line, indexing="ij")
        inside = x * x + y * y <= 1 + 1e-12
        points = torch.stack([x[inside], y[inside]])
    return points, torch.full_like(points[0], 1 / points.shape[1])


def scene_at(case: dict, wavelengths: torch.Tensor) -> Scene:
    lens = lens_of(case)
    return scene(lens, fields_of(case), lens.surfaces[0].thickness[None], wavelengths)


def front_of(case: dict):
    return wavefront_of(scene_at(case, waves_of(case)), *points_of(case))


def flat(*parts: torch.Tensor) -> list[float]:
    return torch.cat([part.detach().reshape(-1) for part in parts]).tolist()


# ---------------------------------------------------------------- answers


def first(case):
    waves = waves_of(case)[0] if "wavelength" in case else None
    return flat(case.get("factor", 1) * getattr(first_order(lens_of(case), waves), case["item"]))


def marginal_solve(case):
    return flat(first_order(lens_of(case)).paraxial_image_distance)


def stop_semi_diameter(case):
    return flat(stop_radius(lens_of(case)))


def index(case):
    medium = find_glass(case["glass"], catalogs=case["catalogs"])
    return flat(glass.refractive_index(medium, waves_of(case)))


def _rows(case, crossings, count):
    """x, y, z, L, M, N of the surfaces asked for, with N > 0 as OpticStudio lists them."""
    rays = [crossing.rays for crossing in crossings]
    rows = []
    for k in case.get("surfaces", range(1, count + 1)):
        position, direction = rays[k - 1].position.reshape(3), rays[k - 1].direction.reshape(3)
        rows.append(torch.cat([position, direction * torch.sign(direction[2])]))
    return rows


def ray(case):
    lens, waves = lens_of(case), waves_of(case)
    rays = launch(lens, tensor(case["pupil"])[:, None].double(), fields=fields_of(case), wavelengths=waves)
    crossings = steps(lens.surfaces[1:], rays, indices=media(lens, waves[0]))
    return flat(*_rows(case, crossings, len(lens.surfaces) - 1))


def ray_from(case):
    """Of a start in the frame whose origin lies `vertex_1` before surface 1; points are listed in that frame."""
    lens, waves = lens_of(case), waves_of(case)
    shift = case["vertex_1"]
    start, direction = tensor(case["start"]) - tensor([0.0, 0.0, shift]), tensor(case["direction"])
    rays = Rays(start[:, None], (direction / direction.norm())[:, None], torch.ones(1, dtype=torch.bool))
    rows = _rows(case, steps(lens.surfaces[1:], rays, indices=media(lens, waves[0])), len(lens.surfaces) - 1)
    ends = [lens.surfaces[k].thickness for k in range(1, len(lens.surfaces) - 1)]
    vertices = shift + torch.cat([torch.zeros(1).double(), torch.stack(ends).cumsum(0)])
    for k, row in zip(case["surfaces"], rows, strict=True):
        row[2] += vertices[k - 1]
    return flat(*rows)


def semi_diameter(case):
    """The largest height of the four axial rim rays, over all fields and wavelengths."""
    lens = lens_of(case)
    rim = tensor([[0.0, 0.0, 1.0, -1.0], [1.0, -1.0, 0.0, 0.0]])
    rays = launch(lens, rim)
    heights = []
    for crossing in steps(lens.surfaces[1:], rays, indices=media(lens, lens.wavelengths[:, None])):
        x, y, _ = crossing.rays.position
        heights.append(torch.where(crossing.rays.valid, torch.hypot(x, y), 0.0).max())
    return flat(torch.stack([heights[k - 1] for k in case["surfaces"]]))


def _fan(found, case, scale):
    every = case.get("every", 1)
    curves = (of_waves(case, scale * curve[..., ::every]) for curve in (found.tangential, found.sagittal))
    return flat(*curves)


def ray_fan(case):
    found = rt.ray_fan(lens_of(case), fields=fields_of(case), points=case["size"])
    return _fan(found, case, 1000.0)


def opd_fan(case):
    found = rt.opd_fan(lens_of(case), fields=fields_of(case), points=case["size"])
    return _fan(found, case, -1.0)


def spot(case):
    """By field: the chief ray's x, y in mm; RMS, RMS x, RMS y about it and the largest distance, µm.

    Rays count alike, and a wavelength of weight w has √(w / the largest) times the rings.
    """
    lens, fields = lens_of(case), fields_of(case)
    primary = lens.primary[None]
    rays = launch(lens, fields.new_zeros(2, 1), fields=fields, wavelengths=primary)
    chief = trace_lens(lens, rays, primary).position[:2]
    off = []
    shares = lens.wavelength_weights / lens.wavelength_weights.max()
    for wavelength, share in zip(lens.wavelengths, shares.tolist(), strict=True):
        points = hexapolar(case["rings"] * share**0.5, dtype=torch.float64)[0]
        rays = trace_lens(lens, launch(lens, points, fields=fields, wavelengths=wavelength[None]), wavelength)
        off.append(1000 * (rays.position[:2] - chief)[:, :, 0])
    off = torch.cat(off, -1)
    x, y = torch.sqrt((off * off).mean(-1))
    largest = off.norm(dim=0).amax(-1)
    return flat(torch.stack([*chief[:, :, 0, 0], torch.hypot(x, y), x, y, largest], -1))


def wavefront_rms(case):
    front = front_of(case)
    return flat(rms(front)[0] / (1e-3 * front.wavelength))


def wavefront_pv(case):
    front = front_of(case)
    return flat(peak_to_valley(front)[0] / (1e-3 * front.wavelength))


def wavefront_map(case):
    front = front_of(case)
    return flat(-front.opd[0] / (1e-3 * front.wavelength[:, None]))


def wavefront_rms_cli(case):
    return flat(of_waves(case, rt.wavefront(lens_of(case), fields=fields_of(case)).rms))


def wavefront_pv_cli(case):
    return flat(of_waves(case, rt.wavefront(lens_of(case), fields=fields_of(case)).peak_to_valley))


def _zernike(case, orders, scales):
    front = front_of(case)
    basis = zernike.polynomials(orders, *front.pupil)
    waves = -front.opd[0] / (1e-3 * front.wavelength[:, None])
    return flat(zernike.fit(waves, basis, front.valid[0].double()) * tensor(scales))


def zernike_standard(case):
    return _zernike(case, [zernike.noll(j) for j in range(1, case["terms"] + 1)], [1.0] * case["terms"])


def zernike_fringe(case):
    orders = [zernike.fringe(j) for j in range(1, case["terms"] + 1)]
    return _zernike(case, orders, [zernike.norm(*order) for order in orders])


def distortion(case):
    return flat(100 * of_waves(case, rt.distortion(lens_of(case), fields=fields_of(case)).f_tan))


def chief_height(case):
    return flat(of_waves(case, rt.distortion(lens_of(case), fields=fields_of(case)).height))


def field_curvature(case):
    found = rt.field_curvature(lens_of(case), fields=fields_of(case))
    return flat(of_waves(case, found.tangential), of_waves(case, found.sagittal))


def lateral(case):
    """The longest wavelength against the shortest, µm."""
    lens = lens_of(case)
    shift = 1000 * rt.lateral_colour(lens, fields=fields_of(case)).shift
    short, long = lens.wavelengths.argmin(), lens.wavelengths.argmax()
    return flat(tensor(case["sign"]) * (shift[:, long] - shift[:, short]))


def illumination(case):
    found = rt.relative_illumination(lens_of(case), fields=fields_of(case), wavelengths=waves_of(case))
    return flat(found.illumination)


def mtf_fft(case):
    found = rt.mtf(lens_of(case), tensor(case["frequency"]), fields=fields_of(case))
    return flat(found.tangential, found.sagittal)


def mtf_geometric(case):
    """OpticStudio multiplies by the MTF of the perfect lens."""
    lens, frequencies = lens_of(case), tensor(case["frequency"])
    found = rt.mtf(lens, frequencies, geometric=True, fields=fields_of(case))
    share = lens.wavelength_weights / lens.wavelength_weights.sum()
    s = (1e-3 * lens.wavelengths[:, None] * case["working_f_number"] * frequencies).clamp_max(1.0)
    limit = (share[:, None] * 2 / math.pi * (torch.acos(s) - s * torch.sqrt(1 - s * s))).sum(0)
    return flat(found.tangential * limit, found.sagittal * limit)


def mtf_through_focus(case):
    lens = lens_of(case)
    distances = lens.surfaces[-2].thickness + tensor(case["shift"])
    found = [rt.mtf(lens.at(sensor_distance=d), case["frequency"], fields=fields_of(case)) for d in distances]
    return flat(*(mtf.tangential for mtf in found), *(mtf.sagittal for mtf in found))


def encircled(case):
    found = rt.encircled_energy(
        lens_of(case), 1e-3 * tensor(case["radius"]), geometric=case["kind"] == "geometric", fields=fields_of(case)
    )
    return flat(found.share * tensor(case.get("scale", 1.0)))


def intensities(case, x, y):
    """I(y, x) (W, Y, X) of each wavelength about its chief ray, 1 over the whole plane, and what it is at best (W,).

    x, y: mm; at best: without aberrations.
    """
    lens = lens_of(case)
    view = scene_at(case, lens.wavelengths)
    light = wave.waves(view, torch.hypot(x.abs().max(), y.abs().max()), order=2)
    U = wave.amplitude(light, x, y)[0, 0]
    best = light.amplitude.sum(-1)[0, 0] / (1e-3 * lens.wavelengths / light.wavefront.index)
    return U.real**2 + U.imag**2, best**2


def share_of(case):
    """(W, 1, 1) weights of the wavelengths, which sum to 1."""
    weights = lens_of(case).wavelength_weights
    return (weights / weights.sum())[:, None, None]


def psf(case):
    found, best = intensities(case, 1e-3 * tensor(case["x"]), 1e-3 * tensor(case["y"]))
    return flat((share_of(case) * found / best[:, None, None]).sum(0))


def mtf_huygens(case):
    """Of the intensity at n × n points about the chief ray, as OpticStudio transforms it."""
    count, pitch = case["image"]
    line = 1e-3 * pitch * (torch.arange(count, dtype=torch.float64) - count // 2)
    profile = (share_of(case) * intensities(case, line, line)[0]).sum((0, 2))
    phase = 2 * math.pi * tensor(case["frequency"])[:, None] * line
    otf = torch.complex((profile * torch.cos(phase)).sum(-1), (profile * torch.sin(phase)).sum(-1))
    return flat(otf.abs() / profile.sum())


def strehl(case):
    """The peak of all wavelengths together, by weight."""
    if len(lens_of(case).wavelengths) == 1:
        return flat(strehl_of(scene_at(case, waves_of(case))))
    found, best = intensities(case, tensor([0.0]), tensor([0.0]))
    return flat((share_of(case) * found / best[:, None, None]).sum(0))


ANSWERS = {
    function.__name__: function
    for function in (
        first, marginal_solve, stop_semi_diameter, index, ray, ray_from, semi_diameter, ray_fan, opd_fan, spot,
        wavefront_rms, wavefront_pv, wavefront_map, wavefront_rms_cli, wavefront_pv_cli, zernike_standard,
        zernike_fringe, distortion, chief_height, field_curvature, lateral, illumination, mtf_fft, mtf_geometric,
        mtf_through_focus, encircled, psf, mtf_huygens, strehl,
    )
}  # fmt: skip
