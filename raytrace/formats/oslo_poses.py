"""How a surface of an OSLO lens file stands: tilts and decentres, mirrors that bend the axis, and returns from them.

The axes of a surface are decentred by DCX, DCY, DCZ, then tilted by TLA, TLB, TLC about x, y and z in turn (DT 1), or
tilted about z, y and x and then decentred (DT -1). TLA and TLB count against the right hand, TLC with it. What follows
stands in these axes; behind a mirror with BEN, in axes that are tilted once more by as much, so that the axis of the
light goes on along z; behind RCO, in the axes that were there before.

Sources: Lambda Research, how tilts of OSLO are told to another program (the sequence and the signs); Sinclair Optics,
the pentaprism of the user guide; the tests of Optiland, which were written beside the program's reference.
"""

from raytrace.formats.oslo_keywords import POSE_NUMBERS, Surface
from raytrace.formats.source import LensFileError, UnsupportedSurface
from raytrace.formats.spelling import double
from raytrace.formats.zemax_keywords import Record
from raytrace.system.pose import Pose, undone

#: The field of a pose by its command, and the sign that it takes there.
_FIELDS = {
    **{"DCX": ("x", 1), "DCY": ("y", 1), "DCZ": ("z", 1)},
    **{"TLA": ("tilt_x", -1), "TLB": ("tilt_y", -1), "TLC": ("tilt_z", 1)},
}


def poses(commands: Surface, unit: float) -> dict[str, Pose]:
    """The poses `before` and `after` of a surface, none where it stands as the one before it.

    Raises LensFileError and UnsupportedSurface.
    """
    told = {word: commands.last(word) for word in POSE_NUMBERS}
    numbers = {word: record.number(0, "tilt or decentre") for word, record in told.items() if record}
    moved = {word: number for word, number in numbers.items() if number}
    bend, back = commands.last("BEN"), commands.last("RCO")
    for record in filter(None, (bend, back)):
        if record.words:
            raise UnsupportedSurface(f"{record.keyword} {record.words[0]} is not modelled, but alone", record.place)
    if not moved:
        return {}
    if commands.place.surface == 0:
        word = next(iter(moved))
        raise UnsupportedSurface(f"{word} (a tilted or decentred object) is not modelled", told[word].place)
    before = _pose(moved, _order(commands), unit)
    if bend:
        return {"before": before, "after": _bent(commands, moved, bend, before)}
    return {"before": before, "after": undone(before)} if back else {"before": before}


def _pose(moved: dict[str, float], order: int, unit: float) -> Pose:
    fields = {}
    for word, number in moved.items():
        name, sign = _FIELDS[word]
        fields[name] = double(sign * number * (1.0 if name.startswith("tilt") else unit))
    return Pose(**fields, tilts_first=order == -1)


def _order(commands: Surface) -> int:
    record = commands.last("DT")
    order = record.integer(0, "order of tilts and decentres") if record else 1
    if order not in (1, -1):
        raise LensFileError(f"DT is {record.words[0]}, expected 1 (decentre, then tilt) or -1", record.place)
    return order


def _bent(commands: Surface, moved: dict[str, float], bend: Record, before: Pose) -> Pose:
    """The tilt of a mirror once more."""
    mirror = commands.last("RFL", "RFH")
    if commands.last("RCO") or mirror is None or len(moved) != 1 or next(iter(moved)) not in ("TLA", "TLB"):
        message = "BEN is modelled on a mirror that is tilted by TLA or by TLB alone, and without RCO"
        raise UnsupportedSurface(message, bend.place)
    return Pose(tilt_x=before.tilt_x, tilt_y=before.tilt_y)
