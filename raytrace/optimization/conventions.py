"""Conventions of operands whose meaning the field's own program leaves open."""

import dataclasses
from collections.abc import Sequence

from raytrace.system.parameter_paths import joined
from raytrace.words import did_you_mean


@dataclasses.dataclass(frozen=True)
class Conventions:
    """Conventions of operands. The first choice of each is the default. Raises ValueError for others.

    opd_tilt: of OPDX, a tilt is fitted for every wavelength of a field, or one that all have in common.
    opd_chief: the reference sphere is about the chief ray of the row's own wavelength or of the primary one.
    opd_sign: a longer or a shorter path than the chief ray's is a positive OPD.
    boundary: a row over several surfaces is off by the sum of their violations or by the largest.
    behind_mirrors: thicknesses behind an odd number of mirrors are compared reversed, along the light, or signed, as
        the lens has them.
    focal_length: of EFFL, in image space, n'/power, or in air, 1/power.
    total_track: of TOTR, from the leftmost vertex to the rightmost, or the sum of the thicknesses.
    colour: of AXCL and LACL, which of the two wavelengths counts positive.
    seidel: of SPHA to DIST, waves of Seidel's coefficients, or of the wavefront: S1/8, S2/2, S3/2, S4/4, S5/2.
    f_theta: of DISC, 30 fields at steps from the axis, which is left out, or 29 and the axis.
    """

    opd_tilt: str = "per wavelength"
    opd_chief: str = "own"
    opd_sign: str = "longer"
    boundary: str = "sum"
    behind_mirrors: str = "reversed"
    focal_length: str = "in image space"
    total_track: str = "extent"
    colour: str = "first"
    seidel: str = "coefficients"
    f_theta: str = "axis left out"

    def __post_init__(self):
        for name, known in CHOICES.items():
            if getattr(self, name) not in known:
                raise ValueError(f"convention `{name}` {getattr(self, name)!r}: expected one of {', '.join(known)}")


#: The choices of each convention, the default first.
CHOICES = {
    "opd_tilt": ("per wavelength", "common"),
    "opd_chief": ("own", "primary"),
    "opd_sign": ("longer", "shorter"),
    "boundary": ("sum", "largest"),
    "behind_mirrors": ("reversed", "signed"),
    "focal_length": ("in image space", "in air"),
    "total_track": ("extent", "sum"),
    "colour": ("first", "second"),
    "seidel": ("coefficients", "wavefront"),
    "f_theta": ("axis left out", "axis included"),
}


def conventions_of(words: "Conventions | str | Sequence[str] | None") -> Conventions:
    """Conventions from text, "opd_tilt=common focal_length=in-air"; None gives the defaults."""
    if isinstance(words, Conventions):
        return words
    choices = {}
    for word in joined(words or "").split():
        name, sign, choice = word.partition("=")
        if name not in CHOICES or not sign:
            known = ", ".join(CHOICES)
            raise ValueError(
                f"`conventions`: {word!r}: expected one of {known}, = and a choice{did_you_mean(name, CHOICES)}"
            )
        choices[name] = choice.replace("-", " ")
    return Conventions(**choices)
