"""Rays through the surfaces of a .zmx text by the definitions of its types: numpy, one ray at a time, and no raytrace.

Lengths are in the file's unit. Derivatives come from a complex step, so that each sag and path is written once.
Sources: the vendor's help on every type; the order of fringe terms: University of Arizona.
"""

import math
from collections import defaultdict

import numpy as np

UNIT = {"MM": 1.0, "CM": 10.0, "IN": 25.4, "METER": 1000.0}
_STEP = 1e-40


def surfaces(text: str) -> list[dict]:
    """What the blocks of a file say: numbers by keyword, PARM and XDAT by number, SCBD by where they stand."""
    found = []
    for line in text.split("\n"):
        word, *words = line.split() or [""]
        if word == "SURF":
            found.append({"TYPE": "STANDARD", "PARM": defaultdict(float), "XDAT": defaultdict(float), "SCBD": {}})
        if not found:
            continue
        block = found[-1]
        if word in ("PARM", "XDAT"):
            block[word][int(words[0])] = float(words[1])
        elif word == "SCBD":
            block["SCBD"][int(words[0])] = (int(words[1]), [float(w) for w in words[3:8]])
        elif word in ("CURV", "CONI", "DISZ", "DIAM"):
            block[word] = math.inf if words[0] == "INFINITY" else float(words[0])
        elif word in ("TYPE", "GLAS"):
            block[word] = words[0] if word == "TYPE" else words
    return found


def rotation(x: float, y: float, z: float) -> tuple[np.ndarray, ...]:
    """Right-handed turns about the axes, in degrees."""
    (cx, sx), (cy, sy), (cz, sz) = ((math.cos(math.radians(a)), math.sin(math.radians(a))) for a in (x, y, z))
    return (
        np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]]),
        np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]]),
        np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]]),
    )


def posed(ray, numbers, order: int):
    """A ray (P, D) in the axes of a coordinate break: decentres, then tilts about x, y, z; or the other way round."""
    (P, D), (dx, dy, *tilts) = ray, numbers
    d, (X, Y, Z) = np.array([dx, dy, 0.0]), rotation(*tilts)
    if order == 0:
        R = X @ Y @ Z
        return R.T @ (P - d), R.T @ D
    R = Z @ Y @ X
    return R.T @ P - d, R.T @ D


# -- sags and paths, of numbers or of complex numbers -----------------------------------------------------------------


def conic(c, k, u):
    return c * u / (1 + np.sqrt(1 - (1 + k) * c * c * u))


def monomials(count: int) -> list[tuple[int, int]]:
    return [(n - j, j) for n in range(1, 40) for j in range(n + 1)][:count]


def fringe(count: int) -> list[tuple[int, int]]:
    """(n, m), m < 0 for sines: by n + |m|, then by falling |m|; 37 is the pure 12th order."""
    order = [
        (s - m, side * m) for s in range(0, 12, 2) for m in range(s // 2, -1, -1) for side in ((1, -1) if m else (1,))
    ]
    return [*order[:36], (12, 0)][:count]


def zernike(n: int, m: int, x, y):
    """R_n^|m|(ρ) cos or sin |m|φ, the latter by the binomial theorem."""
    size, u = abs(m), x * x + y * y
    radial = sum(
        (-1) ** k
        * math.factorial(n - k)
        / (math.factorial(k) * math.factorial((n + size) // 2 - k) * math.factorial((n - size) // 2 - k))
        * u ** ((n - size) // 2 - k)
        for k in range((n - size) // 2 + 1)
    )
    first = 1 if m < 0 else 0
    turning = sum(
        (-1) ** ((k - first) // 2) * math.comb(size, k) * x ** (size - k) * y**k for k in range(first, size + 1, 2)
    )
    return radial * turning


def even(block, x, y):
    u = x * x + y * y
    return conic(block["CURV"], block.get("CONI", 0.0), u) + sum(block["PARM"][j] * u**j for j in range(1, 9))


def extra(block) -> tuple[list[float], float]:
    """The terms of XDAT and their radius."""
    return [block["XDAT"][j] for j in range(3, 3 + int(block["XDAT"][1]))], block["XDAT"][2] or 1.0


def sag(block, x, y):
    kind, c, k, P = block["TYPE"], block["CURV"], block.get("CONI", 0.0), block["PARM"]
    u, (terms, R) = x * x + y * y, extra(block)
    if kind in ("STANDARD", "DGRATING"):
        return conic(c, k, u)
    if kind in ("EVENASPH", "BINARY_1", "BINARY_2", "FZERNPHA"):
        return even(block, x, y)
    if kind == "ODDASPHE":
        return conic(c, k, u) + sum(P[j] * np.sqrt(u) ** j for j in range(1, 9))
    if kind == "XASPHERE":
        return conic(c, k, u) + sum(a * (u / R**2) ** i for i, a in enumerate(terms, 1))
    if kind == "TILTSURF":
        return P[1] * x + P[2] * y
    if kind == "TOROIDAL":
        g = conic(c, k, y * y) + sum(P[j] * y ** (2 * j - 2) for j in range(2, 9))
        return g if not P[1] else P[1] - math.copysign(1.0, P[1]) * np.sqrt((P[1] - g) ** 2 - x * x)
    if kind == "BICONICX":
        cx, kx = (1 / P[1] if P[1] else 0.0), P[2]
        root = np.sqrt(1 - (1 + kx) * (cx * x) ** 2 - (1 + k) * (c * y) ** 2)
        return (cx * x * x + c * y * y) / (1 + root)
    if kind == "XPOLYNOM":
        powers = monomials(len(terms))
        return conic(c, k, u) + sum(a * (x / R) ** i * (y / R) ** j for a, (i, j) in zip(terms, powers, strict=True))
    if kind == "FZERNSAG":
        x, y, orders = (x - P[9]) / R, (y - P[10]) / R, fringe(len(terms))
        z = sum(a * zernike(n, m, x, y) for a, (n, m) in zip(terms, orders, strict=True))
        return z + even(block, x * R + P[9], y * R + P[10])
    if kind == "IRREGULA":
        rim, turn = block["DIAM"], math.radians(P[8])
        across, r2 = (y * math.cos(turn) - x * math.sin(turn)) / rim, u / rim**2
        return conic(c, k, u) + P[5] * r2 * r2 + P[6] * across**2 + P[7] * r2 * across
    return 0.0 * u


def path(block, x, y, wavelength: float, waves: float):
    """The path that a phase adds; wavelength in µm, and in the file's unit."""
    kind, P, (terms, R) = block["TYPE"], block["PARM"], extra(block)
    if kind == "DGRATING":
        return P[1] * P[2] * wavelength * y
    if kind == "BINARY_2":
        rho2 = (x * x + y * y) / R**2
        return P[0] * waves / (2 * math.pi) * sum(a * rho2**i for i, a in enumerate(terms, 1))
    if kind == "BINARY_1":
        powers = zip(terms, monomials(len(terms)), strict=True)
        return P[0] * waves / (2 * math.pi) * sum(a * (x / R) ** i * (y / R) ** j for a, (i, j) in powers)
    if kind == "FZERNPHA":
        orders = zip(terms, fringe(len(terms)), strict=True)
        return P[0] * waves * sum(a * zernike(n, m, x / R, y / R) for a, (n, m) in orders)
    if kind == "HOLOGRM2":
        points = ([P[j], P[j + 1], P[j + 2]] for j in (1, 4))
        ways = sum(np.sqrt((x - a) ** 2 + (y - b) ** 2 + c * c) for a, b, c in points)
        return -P[8] * wavelength / P[7] * ways
    return 0.0 * x


def slopes(function, x: float, y: float) -> tuple[float, float]:
    if x == y == 0:  # the mean of both sides: a cone has no slope at its vertex
        sides = slopes(function, 1e-20, 1e-20), slopes(function, -1e-20, -1e-20)
        return tuple((a + b) / 2 for a, b in zip(*sides, strict=True))
    step = 1j * _STEP
    return (function(x + step, y + 0j).imag / _STEP, function(x + 0j, y + step).imag / _STEP)


# -- one surface -------------------------------------------------------------------------------------------------------


def met(block, P, D):
    """Where the ray meets the surface, by Newton's method from the vertex plane; and the normal."""
    flat = block["TYPE"] == "FRESNELS"
    P = P - P[2] / D[2] * D
    for _ in range(0 if flat else 60):
        x, y, z = P
        zx, zy = slopes(lambda a, b: sag(block, a, b), x, y)
        height = float(np.real(sag(block, x, y)))
        P = P - (z - height) / (D[2] - zx * D[0] - zy * D[1]) * D
    zx, zy = slopes(lambda a, b: even(block, a, b) if flat else sag(block, a, b), P[0], P[1])
    n = np.array([-zx, -zy, 1.0])
    return P, n / np.linalg.norm(n)


def bent(block, P, D, n, n1: float, n2: float, wavelength: float, waves: float):
    """[n2 D2] = [n1 D1] + [∇p] tangentially; an ideal lens by its slopes."""
    mirror = block.get("GLAS", [""])[0] == "MIRROR"
    if block["TYPE"] in ("PARAXIAL", "PARAX_XY"):
        Q = block["PARM"]
        power = (1 / Q[1], 1 / Q[1]) if block["TYPE"] == "PARAXIAL" else (Q[1], Q[2])
        side = math.copysign(1.0, D[2])
        u, v = (n1 * D[i] / D[2] - side * power[i] * P[i] for i in (0, 1))
        D = side * np.array([u / n2, v / n2, 1.0])
        return D / np.linalg.norm(D)
    gx, gy = slopes(lambda a, b: path(block, a, b, wavelength, waves), P[0], P[1])
    q = n1 * D + np.array([gx, gy, 0.0])
    along = q - (q @ n) * n
    side = math.copysign(1.0, D @ n) * (-1 if mirror else 1)
    return (along + side * math.sqrt(n2 * n2 - along @ along) * n) / n2


def trace(text: str, P, D, wavelength: float) -> list[np.ndarray | None]:
    """x, y, z, L, M, N at every surface from 1 on in its own axes, None at a break; wavelength in µm."""
    unit = UNIT[next(line.split()[1] for line in text.split("\n") if line.startswith("UNIT"))]
    ray, n1, found, gap = (np.array(P, float), np.array(D, float)), 1.0, [], 0.0
    for block in surfaces(text)[1:]:
        ray = ray[0] - [0, 0, gap], ray[1]
        gap, Q = block["DISZ"], block["PARM"]
        if block["TYPE"] == "COORDBRK":
            ray = posed(ray, [Q[j] for j in range(1, 6)], int(Q[6]))
            found.append(None)
            continue
        if 1 in block["SCBD"]:
            ray = posed(ray, block["SCBD"][1][1], block["SCBD"][1][0])
        own = [Q[1], Q[2], Q[3], Q[4], 0.0] if block["TYPE"] == "IRREGULA" else [0.0] * 5
        ray = posed(ray, own, 0)
        glass = block.get("GLAS", ["AIR"])
        n2 = n1 if glass[0] == "MIRROR" else float(glass[3]) if glass[0] == "___BLANK" else 1.0
        hit, n = met(block, *ray)
        ray = hit, bent(block, hit, ray[1], n, n1, n2, wavelength, wavelength * 1e-3 / unit)
        found.append(np.concatenate(ray))
        ray, n1 = posed(ray, [-number for number in own], 1), n2
        if 2 in block["SCBD"]:
            ray = posed(ray, block["SCBD"][2][1], block["SCBD"][2][0])
    return found
