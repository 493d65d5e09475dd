"""Systems that carry their exact answers, and short ways to write a lens down.

Every problem states the law that makes it exact, so that a test needs no second tracer.
"""

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from decimal import Decimal, localcontext
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from scipy.signal import resample

from raytrace.io import read_lens
from raytrace.materials.glass import AIR, MIRROR, Glass, constant
from raytrace.optimization.merit import Evaluation
from raytrace.optimization.variables import DesignVariables
from raytrace.system.lens import Fields, Lens, SystemAperture, media
from raytrace.system.optimization_data import Row
from raytrace.system.rays import Rays
from raytrace.system.surface import Aperture, Surface
from raytrace.tracing.launch import rays_from_infinity, rays_from_point, rays_of_field, vignette
from raytrace.tracing.paraxial import first_order
from raytrace.tracing.scene import Scene, scene
from raytrace.tracing.trace import trace_surfaces

#: Files of third parties, which no clone has: tests of them are marked `needs(FOLDER, …)`.
SHARED = Path(__file__).parents[2] / "shared"

#: Runs a test by torch alone and by the compiled trace (fixture `engine`).
both_engines = pytest.mark.parametrize("engine", ["eager", "compiled"], indirect=True)


def for_examples(count: int, test: Callable, **strategies) -> None:
    """Runs a function on so many examples of hypothesis: few of them in the default suite, many in the slow one."""
    settings(max_examples=count, deadline=None)(given(**strategies)(test))()


#: Lengths in mm, for tolerances that carry a unit.
MICROMETRE = 1e-3
NANOMETRE = 1e-6
PICOMETRE = 1e-9
FEMTOMETRE = 1e-12


def number(x) -> torch.Tensor:
    """A number, or nested lists of them, as they are written down."""
    return torch.tensor(x, dtype=torch.float64)


def scalar(number: float) -> torch.Tensor:
    return torch.tensor(float(number), dtype=torch.float64)


def floats(values) -> list[float]:
    return [float(value) for value in values]


def field(*y: float) -> torch.Tensor:
    """Field points (2, F) along y."""
    return number([[0.0] * len(y), list(y)])


def own_fields(lens: Lens) -> torch.Tensor:
    """The field points (2, F) of a lens."""
    return torch.stack([lens.fields.x, lens.fields.y])


def rotation(axis: str, degrees: float) -> torch.Tensor:
    """The right-handed turn (3, 3) about an axis, as the vendor's help writes it."""
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    rows = {"x": [[1, 0, 0], [0, c, -s], [0, s, c]], "y": [[c, 0, s], [0, 1, 0], [-s, 0, c]]}
    return torch.tensor((rows | {"z": [[c, -s, 0], [s, c, 0], [0, 0, 1]]})[axis], dtype=torch.float64)


def points(count: int, reach: float, seed: int = 0) -> torch.Tensor:
    """Points (2, count) within a square of half width `reach` mm."""
    generator = torch.Generator().manual_seed(seed)
    return (2 * torch.rand(2, count, generator=generator, dtype=torch.float64) - 1) * reach


def vector(*numbers: float) -> torch.Tensor:
    return torch.tensor(numbers, dtype=torch.float64)


def surface(
    curvature=None, thickness=0.0, glass: Glass | float = AIR, *, conic=None, coefficients=None, **others
) -> Surface:
    """A surface from plain numbers (tensors pass as they are); glass may be an index."""

    def tensor(x):
        return x if x is None or isinstance(x, torch.Tensor) else torch.as_tensor(x, dtype=torch.float64)

    return Surface(
        thickness=tensor(thickness),
        curvature=tensor(curvature),
        conic=tensor(conic),
        coefficients=tensor(coefficients),
        glass=glass if isinstance(glass, Glass) else constant(glass),
        **others,
    )


def fields(kind: str = "angle", y=(0.0,), x=None, **others) -> Fields:
    y = vector(*y)
    x = torch.zeros_like(y) if x is None else vector(*x)
    return Fields(kind, x, y, torch.ones_like(y), **others)


def lens(
    surfaces,
    *,
    stop: int = 1,
    object_distance=math.inf,
    aperture=("entrance_pupil_diameter", 10.0),
    field: Fields | None = None,
    wavelengths=(0.55,),
    **others,
) -> Lens:
    """A lens of the surfaces from number 1 to the last before the image; a plane object and image are added."""
    kind, number = aperture
    return Lens(
        surfaces=(surface(None, object_distance), *surfaces, surface()),
        stop=stop,
        aperture=SystemAperture(kind, number if isinstance(number, torch.Tensor) else scalar(number)),
        fields=fields() if field is None else field,
        wavelengths=vector(*wavelengths),
        wavelength_weights=torch.ones(len(wavelengths), dtype=torch.float64),
        **others,
    )


def double_gauss(glasses=None, **others) -> Lens:
    """The 100 mm double Gauss of the co-design comparison at 0.530 µm, media by their indices there."""
    sk2, sk16, f5 = glasses or (constant(1.6110909192), constant(1.6239670970), constant(1.6089032455))
    table = [
        (0.0184661976, 8.74664, sk2),
        (0.0065564346, 0.5, AIR),
        (0.027815929, 14.0, sk16),
        (0.0, 3.77696, f5),
        (0.04490361, 14.253, AIR),
        (None, 12.4281, AIR),
        (-0.03893318, 3.777, f5),
        (0.0, 10.834, sk16),
        (-0.027041482, 0.5, AIR),
        (0.0050912, 6.8581, sk16),
        (-0.014892576, 58.5, AIR),
    ]
    options = {
        "stop": 6,
        "aperture": ("entrance_pupil_diameter", 33.33),
        "field": fields("angle", (0.0, 10.0, 14.0)),
        "wavelengths": (0.530,),
    }
    return lens([surface(c, t, glass) for c, t, glass in table], **{**options, **others})


def sharp_double_gauss(stop: float | None = None, sensor: float = 57.8817685) -> Lens:
    """The shipped double Gauss at the focus of 25 m; `stop`: semi-diameter in mm of an aperture that clips the beam."""
    found = read_lens("double_gauss").at(sensor_distance=sensor)
    return found if stop is None else found.replace(5, apertures=vignetting_aperture(stop))


def plano_hyperbolic(
    defocus: float = 0.0, *, diameter: float = 10.0, focus: float = 50.0, apertures=(), **others
) -> Lens:
    """A lens perfect on the axis, its sensor `defocus` mm behind its focus; apertures: of its plane face."""
    surfaces = [surface(None, 10.0, 1.5, apertures=apertures), surface(-2 / focus, focus + defocus, conic=-2.25)]
    return lens(surfaces, aperture=("entrance_pupil_diameter", diameter), **others)


def scene_of(lens: Lens, y: float = 0.0, distance: float = math.inf, *, x: float = 0.0) -> Scene:
    """One field, one object distance, all wavelengths of a lens."""
    return scene(lens, vector(x, y)[:, None], vector(distance), lens.wavelengths)


def aspheric_singlet(**others) -> Lens:
    """An f = 35 mm plastic singlet with r², r⁴ and r⁶ terms in front and a conic behind."""
    front = surface(0.02, 5.0, 1.53, conic=-0.4, coefficients=[2e-3, -1e-5, 2e-8], semi_diameter=9.0)
    return lens([front, surface(-0.02, 30.0, conic=0.5)], **{"aperture": ("entrance_pupil_diameter", 8.0), **others})


@dataclass(frozen=True)
class Stigmatic:
    """A system that images one point into one point without any aberration, at every aperture.

    surfaces, media: as for `trace.steps`; source: (3,) mm in the frame of the first surface, or None for a plane wave
    along +z; image: (3,) mm in the frame of the last; heights: where rays meet the first surface.
    """

    name: str
    surfaces: tuple[Surface, ...]
    media: tuple[float, ...]
    source: tuple[float, float, float] | None
    image: tuple[float, float, float]
    heights: tuple[float, ...]


def stigmatic_problems() -> list[Stigmatic]:
    n = 1.5
    focus = 50.0
    radius = 20.0
    heights = (0.0, 1e-6, 1.0, 4.0, 8.0)
    return [
        # All points of z = r²/4f lie as far from the focus as from the plane z = -f.
        Stigmatic(
            "parabolic mirror",
            (surface(-0.5 / focus, -focus, MIRROR, conic=-1.0), surface()),
            (1.0, 1.0, 1.0),
            None,
            (0.0, 0.0, 0.0),
            (0.0, 1e-6, 1.0, 30.0, 99.0),
        ),
        # An ellipse reflects one focus into the other: vertex distances a(1 ∓ e), c = 1/(a (1 - e²)), k = -e².
        Stigmatic(
            "elliptic mirror",
            (surface(-1 / (100 * (1 - 0.36)), -160.0, MIRROR, conic=-0.36), surface()),
            (1.0, 1.0, 1.0),
            (0.0, 0.0, -40.0),
            (0.0, 0.0, 0.0),
            heights,
        ),
        # The oval of a point at infinity, z + n √(r² + (f - z)²) = n f: an ellipse, c = n/((n - 1) f), k = -1/n².
        Stigmatic(
            "elliptic front",
            (surface(n / ((n - 1) * focus), focus, n, conic=-1 / n**2), surface()),
            (1.0, n, n),
            None,
            (0.0, 0.0, 0.0),
            heights,
        ),
        # Leaving the glass, n z + √(r² + (f - z)²) = f: a hyperbola, c = -1/((n - 1) f), k = -n².
        Stigmatic(
            "plano-hyperbolic lens",
            (surface(None, 10.0, n), surface(-1 / ((n - 1) * focus), focus, conic=-(n**2)), surface()),
            (1.0, n, 1.0, 1.0),
            None,
            (0.0, 0.0, 0.0),
            (0.0, 1e-6, 1.0, 10.0, 20.0),
        ),
        # Both points finite: the oval itself, as an even asphere.
        Stigmatic(
            "Cartesian oval",
            (surface(None, 40.0, n, coefficients=cartesian_oval(60.0, 40.0, n, reach=7.0)), surface()),
            (1.0, n, n),
            (0.0, 0.0, -60.0),
            (0.0, 0.0, 0.0),
            (0.0, 1e-6, 1.0, 4.0, 6.0),
        ),
        # Aplanatic points of a sphere of glass: R/n and n R beyond its centre, without aberration at any aperture.
        Stigmatic(
            "aplanatic sphere",
            (surface(-1 / radius, 0.0), surface()),
            (n, 1.0, 1.0),
            (0.0, 0.0, -radius - radius / n),
            (0.0, 0.0, -radius - radius * n),
            (0.0, 1e-6, 1.0, 5.0, 10.0),
        ),
        # A sphere images its centre into itself.
        Stigmatic(
            "concentric sphere",
            (surface(-1 / radius, 0.0), surface()),
            (n, 1.0, 1.0),
            (0.0, 0.0, -radius),
            (0.0, 0.0, -radius),
            (0.0, 1e-6, 1.0, 10.0, 19.0),
        ),
    ]


def cartesian_oval(source: float, image: float, n: float, *, reach: float, terms: int = 16) -> list[float]:
    """Coefficients of r², r⁴, … of the oval |O P| + n |P I| = s + n i, from s before the vertex to i behind it in n.

    The oval is solved for z at `terms` Chebyshev points of r² up to reach² by bisection in 60 digits, and interpolated.
    """
    with localcontext() as context:
        context.prec = 60
        s, i, index = Decimal(source), Decimal(image), Decimal(n)
        nodes = [Decimal((1 - math.cos(math.pi * (j + 0.5) / terms)) / 2) * Decimal(reach) ** 2 for j in range(terms)]
        rows = [[u**j for j in range(1, terms + 1)] + [_oval_sag(s, i, index, u)] for u in nodes]
        return [float(x) for x in _solve(rows)]


def _oval_sag(s: Decimal, i: Decimal, n: Decimal, r_squared: Decimal) -> Decimal:
    low, high = Decimal(0), i / 2  # the path falls as the sag grows: glass is replaced by air
    for _ in range(190):
        z = (low + high) / 2
        excess = ((s + z) ** 2 + r_squared).sqrt() + n * ((i - z) ** 2 + r_squared).sqrt() - (s + n * i)
        low, high = (z, high) if excess > 0 else (low, z)
    return (low + high) / 2


def _solve(rows: list[list[Decimal]]) -> list[Decimal]:
    """Gauss-Jordan elimination of an augmented matrix."""
    for j in range(len(rows)):
        pivot = max(range(j, len(rows)), key=lambda k: abs(rows[k][j]))
        rows[j], rows[pivot] = rows[pivot], rows[j]
        rows[j] = [x / rows[j][j] for x in rows[j]]
        for k in range(len(rows)):
            if k != j:
                rows[k] = [x - rows[k][j] * y for x, y in zip(rows[k], rows[j], strict=True)]
    return [row[-1] for row in rows]


def focal_length(lens: Lens) -> float:
    """Effective focal length, mm."""
    return float(first_order(lens).effective_focal_length.detach())


def relative_l1(found: torch.Tensor, expected: torch.Tensor) -> float:
    return float((found - expected).detach().abs().sum() / expected.detach().abs().sum())


def turned(vectors: torch.Tensor) -> torch.Tensor:
    """Vectors (3, …) turned by a right angle about z."""
    return torch.stack([-vectors[1], vectors[0], vectors[2]])


def generator(seed: int = 5) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def draws(*shape: int, seed: int = 0, dtype: torch.dtype = torch.float64) -> torch.Tensor:
    """Numbers between 0 and 1, always the same of one seed."""
    return torch.rand(shape, generator=generator(seed), dtype=dtype)


def gaussian(width: float, size: int = 9) -> torch.Tensor:
    """A round kernel (size, size) of standard deviation `width` in pixels that sums to 1."""
    x = torch.arange(size, dtype=torch.float64) - (size - 1) / 2
    kernel = torch.exp(-0.5 * (x[:, None] ** 2 + x**2) / width**2)
    return kernel / kernel.sum()


def covariance(spectrum: torch.Tensor) -> torch.Tensor:
    """The matrix E[x xᵀ] of periodic pictures of a power spectrum."""
    rows, columns = spectrum.shape
    correlation = torch.fft.ifft2(spectrum).real
    i, j = (n.flatten() for n in torch.meshgrid(torch.arange(rows), torch.arange(columns), indexing="ij"))
    return correlation[(i[:, None] - i) % rows, (j[:, None] - j) % columns]


def vignetting_aperture(radius: float) -> tuple[Aperture, ...]:
    return (Aperture("circular", (0.0, radius)),)


def values(lens: Lens, asked: Sequence[Row], **how) -> np.ndarray:
    """Values (R,) of rows of a merit function."""
    return Evaluation(DesignVariables(lens), asked, **how)(np.zeros(0)).values


def fisheye(**others):
    """Two negative menisci before a positive group; chief rays from 75° reach the stop, the pupil wanders."""
    elements = [
        surface(1 / 80, 4.0, 1.6),
        surface(1 / 22, 22.0),
        surface(1 / 150, 3.0, 1.6),
        surface(1 / 20, 25.0),
        surface(1 / 40, 8.0, 1.7),
        surface(-1 / 60, 10.0),
        surface(None, 4.0),
        surface(-1 / 100, 3.0, 1.75),
        surface(1 / 30, 8.0, 1.6),
        surface(-1 / 25, 40.0),
    ]
    return lens(elements, **{"stop": 7, "aperture": ("entrance_pupil_diameter", 2.0), **others})


def random(*shape, seed=0):
    """Uniform numbers from 0 to 1, the same for a seed."""
    return torch.rand(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


@functools.cache
def semi_diameters(found) -> list[float]:
    """By torch's trace, surface by surface."""
    angles = torch.arange(12, dtype=torch.float64) * (math.pi / 6)
    points = torch.stack([angles.sin(), angles.cos()])
    percent, length = found.optimization_data.semi_diameter_margin
    sizes = [0.0 if found.surfaces[0].semi_diameter is None else found.surfaces[0].semi_diameter]
    for k in range(1, len(found.surfaces)):
        if k in found.optimization_data.semi_diameters:
            sizes.append(found.surfaces[k].semi_diameter)
            continue
        heights = [torch.zeros(())]
        for wavelength in found.wavelengths:
            for x, y in zip(found.fields.x, found.fields.y, strict=True):
                field = torch.stack([x, y])[:, None]
                rays = rays_of_field(found, field, vignette(found, field, points), wavelength=wavelength)
                indices = media(found, wavelength)[: k + 1]
                rays = trace_surfaces(found.surfaces[1 : k + 1], rays, indices=indices, wavelength=wavelength)
                each = torch.hypot(*rays.position[:2])[rays.valid]
                if len(each) == 12:  # all arrive
                    each = torch.cat([each, torch.from_numpy(resample(each.numpy() ** 2, 180)).sqrt()])
                heights += [*each]
        bare = k in (found.stop, len(found.surfaces) - 1)
        sizes.append(float(max(heights)) * (1 if bare else 1 + percent / 100) + (0 if bare else length))
    return sizes


def rays_of_problem(problem) -> Rays:
    """Rays through the heights of the problem, turned about z by an angle each, with the path from the source."""
    height = vector(*problem.heights)
    angle = torch.arange(len(height), dtype=torch.float64)
    zero = torch.zeros_like(height)
    aim = torch.stack([height * torch.cos(angle), height * torch.sin(angle), zero])
    index = scalar(problem.media[0])
    if problem.source is None:
        return rays_from_infinity(torch.stack([zero, zero, zero + 1]), aim, index=index)
    return rays_from_point(vector(*problem.source)[:, None].expand_as(aim), aim, index=index)
