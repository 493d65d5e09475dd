"""Settings of trainings: every field decides the result, so that other settings are another run. Imports no torch."""

import dataclasses
from collections.abc import Mapping
from typing import Any, ClassVar, Literal, Self, TypeVar

T = TypeVar("T")


@dataclasses.dataclass(frozen=True)
class Settings:
    """seed: of all random numbers."""

    seed: int = 0

    #: Values of fields in runs that do not record them, where the default is another one now.
    UNRECORDED: ClassVar[Mapping[str, object]] = {}

    @classmethod
    def recorded(cls, document: Mapping) -> dict[str, Any]:
        """The value of every field in the `settings.json` of a run, which may be older than the field."""
        defaults: dict[str, Any] = {field.name: field.default for field in dataclasses.fields(cls)}
        return {**defaults, **cls.UNRECORDED, **{name: document[name] for name in defaults if name in document}}

    @classmethod
    def of(cls, values: Mapping, **more: Any) -> Self:
        """Settings from those of the values that are fields and not None; `more` overrides them."""
        stated = {field.name: values.get(field.name) for field in dataclasses.fields(cls)}
        return read(cls, {name: value for name, value in stated.items() if value is not None} | more)


def read(kind: type[T], document: Mapping) -> T:
    """A dataclass of plain fields from JSON, whose lists become tuples. Raises TypeError for fields of another kind."""
    return kind(**{name: tuple(value) if isinstance(value, list) else value for name, value in document.items()})


#: PSF models that a lens is trained with.
MODELS = ("paraxial", "fourier", "gaussian", "drt")
#: Grades of tolerances, as of `tolerancing.grades`.
GRADES = ("commercial", "precision", "high")
#: Suffixes of drawings: sheets, profiles, solids, and the table of parts.
DRAWINGS = (".pdf", ".svg", ".png", ".dxf", ".step", ".stp", ".csv", ".json")
#: Suffixes of reports.
REPORTS = (".pdf", ".html", ".htm", ".json")
#: Sections of a report in their order, and those that are in it on request alone.
SECTIONS = (
    *("first-order", "prescription", "layout", "spots", "fans", "wavefront", "mtf", "encircled-energy"),
    *("field-curves", "distortion", "illumination", "seidel", "conditions", "tolerances", "as-built", "temperature"),
    "drawings",
)
ON_REQUEST = ("encircled-energy", "seidel", "as-built", "temperature", "drawings")
#: Analyses by which two lenses are compared, as of `analysis.compare`.
COMPARED = (
    *("layout", "spot", "ray-fan", "opd-fan", "wavefront", "mtf", "encircled-energy", "distortion", "field-curvature"),
    *("lateral-colour", "relative-illumination", "rms-over-field", "longitudinal-aberration", "chromatic-focal-shift"),
    *("incidence", "distortion-grid", "psf", "seidel", "thermal"),
)
#: A model, and a start: the optimum of its closed form.
GAUSSIAN = "gaussian"


@dataclasses.dataclass(frozen=True)
class CodesignSettings(Settings):
    """Settings of co-design (`imaging.codesign`). Lengths in mm, wavelengths in µm, angles in degrees.

    sensor: width and height; () for a grey camera of field points. Pictures of a sensor have the channels of its
    response and random places on it; its pixels, shot noise (full_well), read noise (of a full well in electrons, else
    `noise`), mosaic and bits are those of `imaging.sensor`, and the pictures are linear in light.
    model: PSF model of step 1; vary, bounds, hold: variables, their bounds and constraints, as texts; no_hold: without
    the conditions of the lens; step: unit of the variables, "sag" or "blur"; optimizer: of the lens, "lm", steps of
    second order to the optimum of the closed form, behind which the network is trained, or "adam", together with the
    network; turns: of the lens, by steps of second order for the loss of a network that adapts to it, and of the
    network again, as many epochs; relearn: epochs of step 1 again with the nearest glasses of the catalogs, in place of
    model glasses that vary; glasses: a selection of them, as text (`rt.glasses`); filters: of the closed form,
    "separate" or "joint", of colours; filter_each_field: with filters for each field, by default one for all;
    glass_thickness, air_thickness, edge: limits; start: of the sensor, for an object at focus_distance; near, far,
    spread: range and distribution of object distances; fields: points in y, one after the other for successive samples;
    pixel, size: window of the PSF; network: "red-net" or "u-net"; depth, width: its layers, or poolings, and maps;
    rays, drt_rays, sampling: fixed pupil points instead of `tol`.
    as_built: training draws a perturbed lens for each sample; grade, limits: its tolerances, by default those of the
    file; refocus: "sensor", or "none"; cameras: perturbed ones of the test; center: of the PSF window, "" for the
    centroid of the light with tolerances and the chief ray without.
    A stored run without one of the fields has its default (`recorded`), one without `optimizer` is of Adam, and one
    without `filter_each_field` has filters for each field.
    """

    UNRECORDED: ClassVar[Mapping[str, object]] = {"optimizer": "adam", "filter_each_field": True}

    model: str = "gaussian"
    vary: str = "sensor"
    bounds: str = ""
    glass_thickness: str = ""
    air_thickness: str = ""
    edge: float | None = None
    hold: str = ""
    no_hold: bool = False
    step: Literal["sag", "blur"] = "sag"
    optimizer: Literal["adam", "lm"] = "lm"
    turns: int = 0
    relearn: int = 0
    glasses: str = ""
    filters: str = "separate"
    filter_each_field: bool = False
    start: str = "paraxial"
    focus_distance: float = 25e3
    f_number: float | None = None
    wavelengths: tuple[float, ...] = (0.53,)
    wavelength_weights: tuple[float, ...] = (1.0,)
    near: float = 10e3
    far: float = 50e3
    spread: str = "uniform"
    fields: tuple[float, ...] = (0.0,)
    pixel: float = 0.005
    size: int = 21
    normalise: Literal["window", "energy"] = "window"
    noise: float = 0.1
    network: str = "red-net"
    depth: int = 10
    width: int = 32
    epochs: int = 30
    batch: int = 32
    patch: int = 64
    crops: int = 4
    rate_network: float = 1e-3
    rate_optics: float = 1e-3
    precision: str = "float32"
    tol: float = 1e-2
    rho: float = 0.5
    rays: int | None = None
    drt_rays: int | None = None
    sampling: str = "sobol"
    vignetting: str = "none"
    ray_aiming: str | None = None
    decay: str = "none"
    as_built: bool = False
    grade: str = ""
    limits: str = ""
    refocus: str = "sensor"
    cameras: int = 32
    center: Literal["", "chief", "centroid"] = ""
    sensor: tuple[float, ...] = ()
    response: str = "rgb"
    mosaic: str = "none"
    full_well: float | None = None
    read_noise: float = 0.0
    bits: int | None = None

    @property
    def is_toleranced(self) -> bool:
        """Whether cameras as built are trained or tested."""
        return self.as_built or bool(self.grade or self.limits)


@dataclasses.dataclass(frozen=True)
class DesignSettings(Settings):
    """Settings of the design of a phase element (`imaging.wave_design`). Lengths in mm.

    kind: "smooth" (even powers of r), "rings" (free heights, started at the smooth optimum), "zernike" (Noll's, no
    symmetry); terms: of the smooth start (Zernike terms without angle), or Noll's last; pitch: of rings; levels: of
    etched rings, 0 for any height; rate: in µm, or a fraction of it; spread: of random starts, µm; start_steps: of
    each; size: of the periodic pictures; noise: range of the standard deviation drawn for "images"; tolerance: uniform
    random error of the heights of rings, resampled at every step.
    """

    kind: str = "rings"
    glass: str = "F_SILICA"
    terms: int = 7
    pitch: float = 2e-3
    levels: int = 0
    loss: str = "spectral"
    restoration: str = "blind"
    optimizer: str = "adam"
    schedule: str = "cosine"
    rate: float = 0.02
    steps: int = 120
    starts: int = 4
    spread: float = 0.5
    start_steps: int = 60
    size: int = 256
    batch: int = 4
    noise: tuple[float, float] = (0.01, 0.01)
    tolerance: float = 0.0
