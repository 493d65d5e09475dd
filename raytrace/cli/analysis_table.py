"""The commands that analyse a lens: name, summary, description, examples, arguments, and what runs it. No torch."""

from raytrace.cli.options import conditions, count, fields, lens, plot, points, positive_finite, size


def _analysis(parser, figure: str) -> None:
    lens(parser)
    conditions(parser)
    fields(parser)
    plot(parser, figure)


def _fans(parser) -> None:
    _analysis(parser, "the fans")
    points(parser, "rays across the pupil (default 41)", default=41)


def _opd(parser) -> None:
    _fans(parser)
    parser.add_argument(
        "--reference",
        choices=("primary", "own"),
        default="primary",
        help="the sphere: about the point of the primary wavelength's chief ray (default), or of each wavelength's own",
    )


def _maps(parser) -> None:
    _analysis(parser, "the maps")
    size(parser, "a map (default 127)", default=127)
    parser.add_argument(
        "--zernike", choices=("noll", "fringe"), help="print the coefficients, by Noll's numbers or fringe numbers"
    )
    parser.add_argument("--terms", metavar="N", type=count, help="number of Zernike terms (default 37)")


def _curves(parser) -> None:
    _analysis(parser, "the curves")
    parser.add_argument(
        "--samples",
        metavar="N",
        type=count,
        default=11,
        help="fields from the axis to the largest, without --field (default 11)",
    )


def _seidel(parser) -> None:
    _analysis(parser, "a bar for each surface")
    parser.add_argument(
        "--as",
        dest="told",
        choices=("coefficients", "waves", "transverse", "longitudinal"),
        default="coefficients",
        help="S1 to C2 in mm (default), wavefront coefficients in waves, or ray aberrations in mm",
    )


def _longitudinal(parser) -> None:
    lens(parser)
    conditions(parser)
    plot(parser, "the curves")
    points(parser, "rays from the axis to the rim of the pupil (default 41)", default=41)


def _grid(parser) -> None:
    lens(parser)
    conditions(parser)
    plot(parser, "the ideal and the real grid")
    points(parser, "points across the grid (default 11)", default=11)
    parser.add_argument(
        "--exaggerate", metavar="N", type=positive_finite, default=1.0, help="draw the distortion N times as large"
    )


def _incidence(parser) -> None:
    _curves(parser)
    parser.add_argument("--surfaces", action="store_true", help="list every surface, not the sensor alone")


def _rms(parser) -> None:
    _curves(parser)
    parser.add_argument("--spot", action="store_true", help="RMS spot radius about the centroid instead")
    parser.add_argument(
        "--reference",
        choices=("primary", "own"),
        default="primary",
        help="spheres of the wavelengths together: about the primary one's chief ray (default: lateral colour counts), "
        "or each about its own",
    )


def _light(parser) -> None:
    _analysis(parser, "the curves")
    parser.add_argument("--geometric", action="store_true", help="of rays alone, without diffraction")


def _mtf(parser) -> None:
    _light(parser)
    parser.add_argument(
        "--frequency",
        metavar="F",
        type=positive_finite,
        nargs="+",
        help="spatial frequencies, cycles/mm (default: 41 from 0 to what the sharpest field resolves, at most half of "
        "the cutoff of diffraction)",
    )
    parser.add_argument(
        "--through-focus",
        metavar="MM",
        type=positive_finite,
        help="move the sensor by ±MM, at the one frequency of --frequency",
    )


def _encircled(parser) -> None:
    _light(parser)
    parser.add_argument(
        "--radius",
        metavar="MM",
        type=positive_finite,
        nargs="+",
        help="radii from the centroid, mm (default: from 0 to where almost all light lies)",
    )


ANALYSES = (
    (
        "mtf",
        "modulation transfer function",
        "Tangential (of patterns that vary along y) and sagittal (along x) MTF of each field, all wavelengths by their "
        "weights, through frequency or focus.",
        """examples:
  raytrace mtf double_gauss --object-distance 25000 --plot mtf.png
  raytrace mtf tessar --frequency 10 20 40 --geometric --json
  raytrace mtf tessar --frequency 20 --through-focus 0.3 --plot focus.png""",
        _mtf,
        "cli.analysis_commands.mtf",
    ),
    (
        "fan",
        "ray fans",
        "Transverse ray aberration over the pupil, from the chief ray of the primary wavelength.",
        """examples:
  raytrace fan tessar --plot fan.png
  raytrace fan double_gauss --field 0 14 -10,5 --points 21 --json""",
        _fans,
        "cli.analysis_commands.fan",
    ),
    (
        "opd",
        "OPD fans",
        "Optical path difference in waves over the pupil against each wavelength's chief ray, on the reference sphere "
        "of the primary wavelength.",
        """examples:
  raytrace opd tessar --plot opd.png
  raytrace opd double_gauss --object-distance 25000 --reference own --json""",
        _opd,
        "cli.analysis_commands.opd",
    ),
    (
        "wavefront",
        "wavefront maps, Zernike coefficients, Strehl ratio",
        "RMS and peak-to-valley OPD in waves (peak to valley over 127 points across the pupil) and the Strehl ratio; "
        "with --zernike or --json also the Zernike coefficients, Noll's in waves RMS or fringe in waves at the rim.",
        """examples:
  raytrace wavefront tessar --plot wavefront.png
  raytrace wavefront double_gauss --field 0 14 --zernike fringe --terms 16
  raytrace wavefront double_gauss --field 0 --json""",
        _maps,
        "cli.analysis_commands.wavefront",
    ),
    (
        "distortion",
        "distortion over the field",
        "Height of the chief ray on the sensor against f tan θ and f θ (1 = 100 % in JSON, % in text).",
        """examples:
  raytrace distortion phone --plot distortion.png
  raytrace distortion double_gauss --field 5 10 14 --json""",
        _curves,
        "cli.analysis_commands.distortion",
    ),
    (
        "curvature",
        "field curvature",
        "Tangential and sagittal foci of close rays about the chief ray, mm from the sensor.",
        """examples:
  raytrace curvature tessar --plot curvature.png
  raytrace curvature double_gauss --field 0 10 14 --json""",
        _curves,
        "cli.analysis_commands.curvature",
    ),
    (
        "lateral",
        "lateral colour",
        "Height of each wavelength's chief ray on the sensor less the primary wavelength's.",
        """examples:
  raytrace lateral tessar --plot lateral.png
  raytrace lateral double_gauss --wavelength 0.5876 0.4861 0.6563 --json""",
        _curves,
        "cli.analysis_commands.lateral",
    ),
    (
        "illumination",
        "relative illumination",
        "Light on the sensor against the axis, from the solid angle that the rays of a uniform object fill.",
        """examples:
  raytrace illumination phone --plot illumination.png
  raytrace illumination double_gauss --field 0 10 14 --json""",
        _curves,
        "cli.analysis_commands.illumination",
    ),
    (
        "seidel",
        "Seidel aberrations by surface",
        "Third-order aberrations S1 to S5 (spherical, coma, astigmatism, Petzval, distortion), C1, C2 (axial, "
        "lateral colour) of every surface and their sums, with y n i of the "
        "marginal and chief ray, at the largest field or those of --field.",
        """examples:
  raytrace seidel tessar --plot seidel.png
  raytrace seidel double_gauss --as waves --field 10 14 --json""",
        _seidel,
        "cli.aberration_commands.seidel",
    ),
    (
        "longitudinal",
        "longitudinal aberration",
        "Where rays of the axial object point cross the axis, mm from the sensor, over their height in the pupil.",
        """examples:
  raytrace longitudinal tessar --plot longitudinal.png
  raytrace longitudinal cooke_triplet --wavelength 0.55 --json""",
        _longitudinal,
        "cli.aberration_commands.longitudinal",
    ),
    (
        "grid",
        "grid distortion",
        "Where a square grid of object points up to the largest field lands on the sensor, against its ideal image.",
        """examples:
  raytrace grid phone --plot grid.png --exaggerate 10
  raytrace grid retrofocus --points 5 --json""",
        _grid,
        "cli.aberration_commands.grid",
    ),
    (
        "incidence",
        "angles of incidence",
        "Angles at which the chief ray and the rim of each field's beam meet the sensor, or every surface, in degrees.",
        """examples:
  raytrace incidence phone --plot incidence.png
  raytrace incidence double_gauss --field 0 14 --surfaces --json""",
        _incidence,
        "cli.aberration_commands.incidence",
    ),
    (
        "rms",
        "RMS wavefront or spot over the field",
        "RMS wavefront error in waves over the field, of each wavelength and of all together by their weights, with "
        "the Strehl ratio exp(-(2π σ)²); or the RMS spot radius.",
        """examples:
  raytrace rms tessar --plot rms.png
  raytrace rms double_gauss --spot --field 0 10 14 --json""",
        _rms,
        "cli.aberration_commands.rms",
    ),
    (
        "encircled",
        "encircled energy",
        "Share of the light within a radius of the centroid of the rays, by diffraction or of rays alone.",
        """examples:
  raytrace encircled tessar --plot encircled.png
  raytrace encircled double_gauss --geometric --radius 0.005 0.01 0.02 --json""",
        _encircled,
        "cli.analysis_commands.encircled",
    ),
)
