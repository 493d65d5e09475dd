"""STEP: the parts of a lens as solids of revolution in mm, each at its place in the axes of surface 1.

Planes, spheres, cones and cylinders are exact; other sags are B-splines within `parts.DEVIATION`. The file has a
product for each part, in an assembly with the name of the lens. A decentred or rectangular aperture cuts its mirror.
"""

import itertools
import math
import re
import tempfile
from collections.abc import Sequence
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from raytrace.files import write_atomically
from raytrace.materials.glass import label
from raytrace.plotting.style import array
from raytrace.system.lens import Lens
from raytrace.tracing.geometry import Frame, frames
from raytrace.words import missing_extra
from raytrace.workshop.parts import Part, Segment

_DATE = "1970-01-01"


def write(path: str | PathLike, lens: Lens, parts: Sequence[Part], date: str = "") -> None:
    """Write parts as STEP (AP214); the same parts give the same file. Raises MissingExtra."""
    try:
        from OCP.Message import Message
        from OCP.STEPCAFControl import STEPCAFControl_Writer
        from OCP.TCollection import TCollection_ExtendedString
        from OCP.TDataStd import TDataStd_Name
        from OCP.TDocStd import TDocStd_Document
        from OCP.XCAFDoc import XCAFDoc_DocumentTool
    except ModuleNotFoundError as error:
        raise missing_extra("a STEP file", "cad", error) from error
    document = TDocStd_Document(TCollection_ExtendedString("XmlOcaf"))
    shapes = XCAFDoc_DocumentTool.ShapeTool_s(document.Main())

    def named(entry: Any, name: str) -> None:
        TDataStd_Name.Set_s(entry, TCollection_ExtendedString(name))

    whole = shapes.NewShape()
    named(whole, lens.name or "Lens")
    for part in parts:
        entry = shapes.AddShape(solid(part), False)
        name = f"{'mirror' if part.is_mirror else 'element'} {part.name}"
        named(entry, f"{name} {label(part.glass)}".strip())
        named(shapes.AddComponent(whole, entry, _location(part, lens)), name)
    shapes.UpdateAssemblies()
    with tempfile.TemporaryDirectory() as folder:
        file, writer = Path(folder) / "lens.step", STEPCAFControl_Writer()
        messenger = Message.DefaultMessenger_s()
        printers = list(messenger.Printers())
        for printer in printers:
            messenger.RemovePrinter(printer)  # of a report of the transfer on standard output
        writer.Transfer(document)
        writer.Write(str(file))
        for printer in printers:
            messenger.AddPrinter(printer)
        text = file.read_bytes()
    day = date if re.fullmatch(r"\d{4}-\d\d-\d\d", date) else _DATE
    stamp = f"'{day}T00:00:00'".encode()
    text = re.sub(rb"'\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d[^']*'", stamp, text, count=1)
    occurrences = itertools.count(1)  # the library counts on from file to file
    text = re.sub(
        rb"NEXT_ASSEMBLY_USAGE_OCCURRENCE\('\d+'",
        lambda _: b"NEXT_ASSEMBLY_USAGE_OCCURRENCE('%d'" % next(occurrences),
        text,
    )
    text = re.sub(rb"FILE_NAME\('[^']*'", b"FILE_NAME('lens.step'", text, count=1)
    write_atomically(path, lambda target: target.write(text))


def solid(part: Part) -> Any:
    """The solid of a part about its z axis, along the light, with the vertex of its first surface in the origin."""
    from OCP.BRepAlgoAPI import BRepAlgoAPI_Common
    from OCP.BRepBuilderAPI import BRepBuilderAPI_MakeFace, BRepBuilderAPI_MakeWire
    from OCP.BRepPrimAPI import BRepPrimAPI_MakeRevol
    from OCP.gp import gp_Ax1, gp_Dir, gp_Pnt

    wire = BRepBuilderAPI_MakeWire()
    for segment in part.profile():
        if segment.start != segment.end:
            wire.Add(_edge(segment))
    section = BRepBuilderAPI_MakeFace(wire.Wire(), True).Face()
    shape = BRepPrimAPI_MakeRevol(section, gp_Ax1(gp_Pnt(0, 0, 0), gp_Dir(0, 0, 1))).Shape()
    for tool in _cuts(part):
        shape = BRepAlgoAPI_Common(shape, tool).Shape()
    return shape


def _edge(segment: Segment) -> Any:
    """An edge in the half plane y = 0, x ≥ 0 about the z axis."""
    from OCP.BRepBuilderAPI import BRepBuilderAPI_MakeEdge
    from OCP.collections import Array1_double, Array1_gp_Pnt, Array1_int
    from OCP.Geom import Geom_BSplineCurve
    from OCP.gp import gp_Ax2, gp_Circ, gp_Dir, gp_Pnt

    def point(place: tuple[float, float]) -> Any:
        return gp_Pnt(place[1], 0.0, place[0])

    face, ends = segment.face, (point(segment.start), point(segment.end))
    if face is None:
        return BRepBuilderAPI_MakeEdge(*ends).Edge()
    if face.is_sphere:
        radius = 1 / face.curvature
        towards = -1 if radius > 0 else 1  # along z, from the centre to the vertex: there the angle is 0
        axes = gp_Ax2(gp_Pnt(0, 0, face.vertex + radius), gp_Dir(0, towards, 0), gp_Dir(0, 0, towards))
        angles = sorted(math.asin(r / abs(radius)) for _, r in (segment.start, segment.end))
        return BRepBuilderAPI_MakeEdge(gp_Circ(axes, abs(radius)), *angles).Edge()
    curve, _ = segment.spline()
    degree, count = curve.k, len(curve.c)
    heights = [float(curve.t[i + 1 : i + degree + 1].mean()) for i in range(count)]
    knots, multiplicities = np.unique(curve.t, return_counts=True)
    poles, places, times = Array1_gp_Pnt(1, count), Array1_double(1, len(knots)), Array1_int(1, len(knots))
    for i, (z, r) in enumerate(zip(curve.c.tolist(), heights, strict=True), 1):
        poles.SetValue(i, gp_Pnt(r, 0.0, z))
    for i, (knot, multiplicity) in enumerate(zip(knots.tolist(), multiplicities.tolist(), strict=True), 1):
        places.SetValue(i, knot)
        times.SetValue(i, multiplicity)
    spline = Geom_BSplineCurve(poles, places, times, degree)
    return BRepBuilderAPI_MakeEdge(spline).Edge()


def _cuts(part: Part) -> list[Any]:
    """Cylinders and boxes along z by which a mirror is cut: its decentred or rectangular apertures."""
    from OCP.BRepPrimAPI import BRepPrimAPI_MakeBox, BRepPrimAPI_MakeCylinder
    from OCP.gp import gp_Ax2, gp_Dir, gp_Pnt

    side, tools = part.faces[0].side, []
    far = 10 * (part.rim + part.thickness)
    for aperture in part.cuts:
        x, y = (float(shift) for shift in aperture.centre)
        x *= side  # the solid is turned about y where the light runs along -z
        if aperture.shape == "circular":
            radius = float(aperture.extent[1])
            tools.append(BRepPrimAPI_MakeCylinder(gp_Ax2(gp_Pnt(x, y, -far), gp_Dir(0, 0, 1)), radius, 2 * far).Shape())
        else:
            a, b = (float(size) for size in aperture.extent)
            tools.append(BRepPrimAPI_MakeBox(gp_Pnt(x - a, y - b, -far), gp_Pnt(x + a, y + b, far)).Shape())
    return tools


def _location(part: Part, lens: Lens) -> Any:
    """The place of a part: its z along the light, its y that of its first surface."""
    from OCP.gp import gp_Ax3, gp_Dir, gp_Pnt, gp_Trsf
    from OCP.TopLoc import TopLoc_Location

    frame: Frame = frames(lens)[part.surfaces[0]]
    origin, axes, side = array(frame.origin), array(frame.axes), part.faces[0].side
    moved = gp_Trsf()
    moved.SetTransformation(
        gp_Ax3(gp_Pnt(*origin.tolist()), gp_Dir(*(side * axes[:, 2]).tolist()), gp_Dir(*(side * axes[:, 0]).tolist())),
        gp_Ax3(gp_Pnt(0, 0, 0), gp_Dir(0, 0, 1), gp_Dir(1, 0, 0)),
    )
    return TopLoc_Location(moved)
