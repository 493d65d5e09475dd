"""DXF: the profiles of parts as lines, arcs and splines at 1:1 in mm, one beside the other, on layers.

OUTLINE the section, AXIS the optical axis, CLEAR the ends of the clear apertures, TEXT the table of each part.
"""

import io
import math
from collections.abc import Sequence
from os import PathLike
from typing import Any

import numpy as np

from raytrace.files import write_text
from raytrace.words import missing_extra
from raytrace.workshop.parts import Part, Segment

#: Layers with their colour and line type.
LAYERS = {"OUTLINE": (7, "CONTINUOUS"), "AXIS": (8, "CENTER"), "CLEAR": (5, "CONTINUOUS"), "TEXT": (7, "CONTINUOUS")}


def write(path: str | PathLike, title: str, parts: Sequence[tuple[Part, Sequence[str]]]) -> None:
    """Write parts, each with its lines of text, as DXF R2010. Raises MissingExtra."""
    try:
        import ezdxf
    except ModuleNotFoundError as error:
        raise missing_extra("a DXF file", "cad", error) from error
    before = ezdxf.options.write_fixed_meta_data_for_testing
    ezdxf.options.write_fixed_meta_data_for_testing = True  # the same parts give the same file
    try:
        document = ezdxf.new("R2010", setup=True, units=ezdxf.units.MM)
        for name, (colour, kind) in LAYERS.items():
            document.layers.add(name, color=colour, linetype=kind)
        space, left = document.modelspace(), 0.0
        size = max(part.rim for part, _ in parts) / 12
        space.add_text(title, height=1.5 * size, dxfattribs={"layer": "TEXT"}).set_placement((0, 20 * size))
        for part, lines in parts:
            z, _ = np.concatenate([segment.points() for segment in part.profile()], axis=1)
            shift = left - float(z.min())
            _part(space, part, shift)
            for k, line in enumerate(lines):
                corner = (left, -part.rim - (3 + 1.8 * k) * size)
                space.add_text(line.replace("⌀", "%%c"), height=size, dxfattribs={"layer": "TEXT"}).set_placement(
                    corner
                )
            left = float(z.max()) + shift + max(4.0, 0.7 * size * max(map(len, lines)))
        content = io.StringIO()
        document.write(content)
    finally:
        ezdxf.options.write_fixed_meta_data_for_testing = before
    write_text(path, content.getvalue())


def _part(space: Any, part: Part, shift: float) -> None:
    for segment in part.profile():
        on_axis = segment.start[1] == segment.end[1] == 0
        for mirrored in () if on_axis else (1, -1):
            _segment(space, segment, shift, mirrored)
    z = np.concatenate([segment.points()[0] for segment in part.profile()])
    margin = 0.2 * part.rim
    ends = (float(z.min()) + shift - margin, 0.0), (float(z.max()) + shift + margin, 0.0)
    space.add_line(*ends, dxfattribs={"layer": "AXIS"})
    for face, outward in zip(part.faces, (-1, 1), strict=True):
        height = min(face.clear, part.rim)
        z_end = float(face.z(np.array([height]))[0]) + shift
        for sign in (1, -1):
            ends = (z_end, sign * height), (z_end + outward * margin, sign * height)
            space.add_line(*ends, dxfattribs={"layer": "CLEAR"})


def _segment(space: Any, segment: Segment, shift: float, mirrored: int) -> None:
    look = {"layer": "OUTLINE"}
    (z1, r1), (z2, r2) = segment.start, segment.end
    start, end, face = (z1 + shift, mirrored * r1), (z2 + shift, mirrored * r2), segment.face
    if face is None:
        if start != end:
            space.add_line(start, end, dxfattribs=look)
    elif face.is_sphere:
        radius = 1 / face.curvature
        centre = (face.vertex + radius + shift, 0.0)
        angles = sorted(math.degrees(math.atan2(y, x - centre[0])) % 360 for x, y in (start, end))
        first, last = angles if angles[1] - angles[0] < 180 else angles[::-1]
        space.add_arc(centre, abs(radius), first, last, dxfattribs=look)
    else:
        curve, _ = segment.spline()
        k, knots = curve.k, curve.t
        heights = [float(knots[i + 1 : i + k + 1].mean()) for i in range(len(curve.c))]
        points = [(float(z) + shift, mirrored * r) for z, r in zip(curve.c, heights, strict=True)]
        spline = space.add_spline(degree=k, dxfattribs=look)
        spline.control_points, spline.knots = points, knots.tolist()
