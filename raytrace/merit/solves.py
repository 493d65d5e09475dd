"""Solves: numbers of a lens that follow from others, a row for every kind.

Each is found from the numbers of the surfaces before, at the primary wavelength; n is signed, ω = n u.
"""

from raytrace.system.intent import Solve


def _ray_before(moment, surface: int):
    """(y, ω) of the paraxial marginal ray in front of a surface."""
    y, omega = moment.marginal_height, moment.marginal_height * moment.vergence
    if surface == 1:
        return y, omega
    A, B, C, D = moment.matrix(1, surface - 1, moment.primary, to_next=True)
    return A * y + B * omega, C * y + D * omega


def _pickup(moment, solve: Solve):
    return solve.scale * moment.number(solve.source, solve.quantity_of_source or solve.quantity) + solve.offset


def _bent_to(moment, solve: Solve, omega_behind):
    """The curvature behind which the marginal ray has ω′: c = (ω - ω′ - K y)/(y (n′ - n)), K the power beside it."""
    k, n = solve.surface, moment.index(moment.primary)
    y, omega = _ray_before(moment, k)
    return ((omega - omega_behind) / y - moment.further_power(k, moment.primary)) / (n[k] - n[k - 1])


def _marginal_angle(moment, solve: Solve):
    return _bent_to(moment, solve, moment.index(moment.primary)[solve.surface] * solve.numbers[0])


def _f_number(moment, solve: Solve):
    return _bent_to(moment, solve, -abs(moment.index(moment.primary)[solve.surface]) / (2 * solve.numbers[0]))


def _marginal_height(moment, solve: Solve):
    """t = n′ (h - y)/ω′ behind the surface."""
    k, primary = solve.surface, moment.primary
    y, omega = _ray_before(moment, k)
    return moment.index(primary)[k] * (solve.numbers[0] - y) / (omega - moment.power(k, primary) * y)


def _power(moment, solve: Solve):
    """c = P/(n′ - n) of the power that a surface has by its curvature."""
    k, n = solve.surface, moment.index(moment.primary)
    return solve.numbers[0] / (n[k] - n[k - 1])


def _position(moment, solve: Solve):
    """The thickness with which those from surface `source` to this one, or from this one on to `source`, have a sum."""
    k, source = solve.surface, solve.source
    others = range(source, k) if source <= k else range(k + 1, source)
    return solve.numbers[0] - sum(moment.thickness[j] for j in others)


#: How a number is found, by the kind of its solve: of a moment and the solve.
SOLVES = {
    "pickup": _pickup,
    "marginal_angle": _marginal_angle,
    "f_number": _f_number,
    "marginal_height": _marginal_height,
    "power": _power,
    "position": _position,
}
