"""Arguments of merit functions, of what varies and of what holds, which commands share. No torch."""

import argparse

from raytrace.cli.options import Names, count, positive_finite


def merit(parser: argparse.ArgumentParser) -> None:
    """--merit and what goes with it: `optimization.merit.merit_for`."""
    parser.add_argument(
        "--merit",
        metavar="KIND",
        choices=Names("optimization.default_merit", "KINDS"),
        help="a default merit function instead of the file's: spot (where rays land), wavefront (path differences), "
        "angular (directions behind an afocal lens) or mtf",
    )
    parser.add_argument(
        "--skip-unknown", action="store_true", default=None, help="leave rows of operands that are not known out"
    )
    parser.add_argument(
        "--reading",
        dest="conventions",
        metavar="NAME=CHOICE",
        nargs="+",
        help="where the meaning of an operand is open, another convention than the default: opd_tilt=common, "
        "opd_chief=primary, opd_sign=shorter, boundary=largest, behind_mirrors=signed, focal_length=in-air, "
        "total_track=sum, colour=second, seidel=wavefront, f_theta=axis-included",
    )
    own = parser.add_argument_group("of a default merit function")
    own.add_argument("--rings", metavar="N", type=count, help="rings of rays in the pupil (default 3)")
    own.add_argument("--arms", metavar="N", type=count, help="arms of rays in the pupil, even (default 6)")
    own.add_argument("--reference", choices=("centroid", "chief"), help="what rays are told from (default centroid)")
    own.add_argument(
        "--frequency", dest="frequencies", metavar="F", type=positive_finite, nargs="+", help="of mtf, cycles/mm"
    )
    for name in ("field", "wavelength"):
        option = f"--{name}-weights"
        own.add_argument(option, metavar="W", type=positive_finite, nargs="+", help=f"one a {name}, not the lens's own")
    bounds = parser.add_argument_group("boundaries, beside any merit function")
    for name in ("glass", "air"):
        option = f"--{name}-thickness"
        bounds.add_argument(option, metavar="MIN[:MAX]", help=f"of {name} on the axis, mm, as 2:15, or 2")
    bounds.add_argument("--edge", metavar="MIN", type=positive_finite, help="least thickness of glass at its edge, mm")


def freedom(parser: argparse.ArgumentParser) -> None:
    """--vary, --bounds and --hold: `optimization.variables.freedom`, `optimization.variables.bounds_of`,
    `optimization.constraints.conditions_of`."""
    group = parser.add_argument_group(
        "what varies, where it is not the file's, and what holds",
        "Words in quotes: 'curvature thickness' (all surfaces that bend light, all gaps), curvature:1-4,7 conic:3 a4:3 "
        "tilt:5 decentre:5 sensor index glass:2, thickness:6@2 (in configuration 2); what follows: "
        "'curvature:4=-curvature:3' 'thickness:8=2*thickness:2+1' 'curvature:7=f_number(4)' "
        "'thickness:8=marginal_height(0)' 'curvature:7=marginal_angle(-0.1)'.",
    )
    group.add_argument("--vary", metavar="WHAT", nargs="+", help="what varies, and what follows")
    group.add_argument(
        "--bounds",
        metavar="NAME:LOW,HIGH",
        nargs="+",
        help="of variables: of a kind (thickness:2..15), of one (curvature_3:-0.1,0), open on one side (sensor:30..)",
    )
    group.add_argument(
        "--hold",
        metavar="NAME=VALUE",
        nargs="+",
        help="what is kept to exactly: efl=50 f_number=4 'total_track<=80' 'distortion<=2%%' 'bfd>=30' "
        "image_height=21.6 magnification=-0.5 'thickness:3-5>=20' efl@2=100, or an operand as REAY(8,0,0,1,0,0)=2",
    )
