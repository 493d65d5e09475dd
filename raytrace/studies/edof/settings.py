"""Settings of learning an element of extended depth of field. No torch."""

import dataclasses

from raytrace.cli.options import positive_finite
from raytrace.studies import options
from raytrace.studies.options import option

NANOMETRE = 1e-6  # mm


def nanometres(text: str) -> float:
    return NANOMETRE * positive_finite(text)


@dataclasses.dataclass(frozen=True)
class Settings(options.Settings):
    """All that decides the result of a run; lengths in mm.

    kind: "smooth" (even powers of r), "rings" (free heights, from the smooth optimum), "zernike" (Noll's, no symmetry);
    terms: of the smooth start (Zernike terms without angle), or how far Noll's go; pitch: of rings; rate: in µm, or a
    share of it; spread: of random starts, µm; start_steps: of each; size: of the periodic pictures; noise: least and
    largest deviation drawn for "images" (the code of Sitzmann et al. draws 0.001 to 0.01 for heights, to 0.02 in its
    `aedof_zernike`); tolerance: of rings, drawn by the seed and the number of the step.
    """

    kind: str = option("rings", "what is learned", name="element", choices=("rings", "smooth", "zernike"))
    glass: str = option("F_SILICA", "default F_SILICA for rings, else PMMA", "NAME")
    terms: int = option(7, "polynomials of the smooth element (default 7), or Noll's last (36)")
    pitch: float = 2e-3
    levels: int = option(0, "learned as if etched in N equal steps of the height of one wave (default any height)")
    loss: str = option("spectral", "what is made least", choices=("spectral", "images"))
    restoration: str = option(
        "blind",
        "of --loss images. blind: the best depth-invariant one (default); towards: least squares with a penalty on the "
        "distance to the measured picture (Sitzmann et al. 2018); network: the first and a RED-Net behind it",
        name="filter",
        choices=("blind", "towards", "network"),
    )
    optimizer: str = option("adam", "default adam", choices=("adam", "sgd", "adadelta"))
    schedule: str = option("cosine", "default cosine", choices=("cosine", "linear", "constant"))
    rate: float = option(0.02, "learning rate, µm a step", "R")
    steps: int = option(120, "of learning")
    starts: int = option(4, "random starts, of which the best is kept")
    spread: float = 0.5
    start_steps: int = 60
    size: int = 256
    batch: int = 4
    noise: tuple[float, float] = (0.01, 0.01)
    tolerance: float = option(
        0.0,
        "heights of rings err by up to NM nm, drawn anew at every step (default 0)",
        "NM",
        type=nanometres,
        unit=NANOMETRE,
    )
