"""Settings of co-design: rows that are the options of the command and what a run is known by. No torch."""

import dataclasses

from raytrace.cli.options import count, field_point, positive, positive_finite
from raytrace.studies import options
from raytrace.studies.options import option

MODELS = ("paraxial", "fourier", "gaussian", "drt")
AFTER_PARAXIAL = "gaussian-after-paraxial"
GAUSSIAN = "gaussian"  # a model, and a start: where its closed form has its optimum
#: What the rows of a study are called in tables and figures.
NAMES = dict(
    zip(
        (*MODELS, AFTER_PARAXIAL),
        ("paraxial", "Fourier", "Gaussian DRT", "DRT", "Gaussian DRT from paraxial"),
        strict=True,
    )
)


@dataclasses.dataclass(frozen=True)
class Settings(options.Settings):
    """All that decides the result of a run. Lengths in mm but for wavelengths in µm; angles in degrees.

    Samples take the fields (in y) in turn. A setting that a folder of runs does not know, begun before there was one,
    has its default there.
    """

    model: str = option("gaussian", "PSF model of step 1", "MODEL", choices=MODELS)
    vary: str = option(
        "sensor", "variables: sensor (default), thickness:5,6 curvature:1-4 conic:3, of surfaces", "WHAT", nargs="+"
    )
    bounds: str = option("", "of them: sensor:57.5,58 curvature_3:-0.04,0 (mm, 1/mm)", "NAME:LOW,HIGH", nargs="+")
    glass_thickness: str = option(
        "", "of elements at the axis: least, or least and greatest (default 1/50 of the largest diameter)", "MIN[:MAX]"
    )
    air_thickness: str = option(
        "", "of air between elements (default 1/2000 of the largest diameter); its edges may touch", "MIN[:MAX]"
    )
    edge: float | None = option(
        None, "least of elements at the edge (default 1/100); a lack is a penalty in mm²", "MIN", type=positive_finite
    )
    hold: str = option(
        "",
        "what the last of --vary that changes it is solved for: efl (the file's focal length) or efl=100",
        "NAME=VALUE",
        nargs="+",
    )
    start: str = option(
        "paraxial",
        "where the sensor begins: paraxial (default; the image of --focus-distance), rms (its least RMS spot), "
        "spectral (the optimum of the closed form), gaussian (that of Gaussian DRT), or a sensor distance",
        "PLACE",
    )
    focus_distance: float = option(25e3, "of --start (default 25000); inf allowed", "MM", type=positive)
    f_number: float | None = option(None, "other than the file's", "N", type=positive_finite)
    wavelengths: tuple[float, ...] = option((0.53,), "the first is primary (default 0.53)", "UM", name="wavelength")
    wavelength_weights: tuple[float, ...] = option((1.0,), "of --wavelength (default 1 each)", "W")
    near: float = option(10e3, "nearest object", "MM")
    far: float = option(50e3, "furthest object", "MM")
    spread: str = option(
        "uniform",
        "how object distances z lie between them: evenly in z (uniform, default) or in 1/z (reciprocal)",
        name="distances",
        choices=("uniform", "reciprocal"),
    )
    fields: tuple[float, ...] = option(
        (0.0,), "field points Y, in the file's own kind of field (default 0)", "F", name="field", type=field_point
    )
    pixel: float = option(0.005, "pixel pitch", "MM")
    size: int = option(21, "pixels across the window of the PSF")
    normalise: str = option(
        "window",
        "what is 1: the light through the entrance pupil (energy), or in each window (default)",
        choices=("energy", "window"),
    )
    noise: float = option(0.1, "standard deviation, of pictures from 0 to 1", "S")
    depth: int = option(10, "layers, an even number, instead of the preset's (default 10 or 30)")
    width: int = option(32, "maps of a layer, instead of the preset's (default 32 or 64)")
    epochs: int = option(30, "of each step")
    batch: int = option(32, "patches of a training step")
    patch: int = option(64, "pixels across what is restored")
    crops: int = option(4, "patches of a picture in an epoch")
    rate_network: float = option(1e-3, "Adam's, of weights", "R")
    rate_optics: float = option(1e-3, "Adam's, of variables, in mm", "R")
    precision: str = option(
        "float32",
        "of the network; auto (default) tries which this machine trains faster in, and keeps to it",
        choices=("auto", "float32", "bfloat16"),
    )
    tol: float = option(1e-2, "what a PSF may err by", "T")
    rho: float = option(0.5, "of the paraxial model: σ over the radius of the blur", "R")
    rays: int | None = option(
        None,
        "plain rays of a traced PSF of step 1, the same ones always, instead of as many as --tol needs",
        type=count,
    )
    drt_rays: int | None = option(
        None,
        "plain rays of every DRT PSF, of step 1, step 2 and its tests, instead of as many as --tol needs",
        type=count,
    )
    sampling: str = option(
        "sobol", "where --rays and --drt-rays cross the pupil (default sobol)", choices=("sobol", "hexapolar")
    )
    vignetting: str = option(
        "none",
        "rays beyond the semi-diameters of the file: traced (none, default), or vignetted (semi-diameters)",
        choices=("none", "semi-diameters"),
    )
    decay: str = option(
        "none",
        "Adam's rates in the course of a step: constant (none, default), or falling to 0 along half a cosine",
        choices=("none", "cosine"),
    )
