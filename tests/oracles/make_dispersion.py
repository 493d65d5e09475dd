"""Print the table of tests/oracles/dispersion.json: n and dn/dλ of every formula, to 30 digits, by mpmath.

    python tests/oracles/make_dispersion.py > tests/oracles/dispersion.json

Written from the definitions of the AGF manual, term by term, and independent of raytrace. Inputs are IEEE doubles.
"""

import json

import mpmath

mpmath.mp.dps = 60


def square(n_squared):
    return lambda c, w: mpmath.sqrt(n_squared(c, w))


def sellmeier(terms):
    return square(lambda c, w: 1 + sum(c[2 * i] * w**2 / (w**2 - c[2 * i + 1]) for i in range(terms)))


def herzberger(c, w):
    resonance = 1 / (w**2 - mpmath.mpf(0.028))
    return c[0] + c[1] * resonance + c[2] * resonance**2 + c[3] * w**2 + c[4] * w**4 + c[5] * w**6


def model(c, w):
    """Solve the three conditions of the model glass for A, B, C as a linear system."""
    d, f, red, g = (mpmath.mpf(line) for line in (0.5876, 0.4861, 0.6563, 0.4358))
    power = mpmath.mpf(7) / 2
    dispersion = (c[0] - 1) / c[1]
    partial = mpmath.mpf(0.6438) - mpmath.mpf(0.001682) * c[1] + c[2]
    rows = mpmath.matrix(
        [
            [1, 1 / d, d**-power],
            [0, 1 / f - 1 / red, f**-power - red**-power],
            [0, 1 / g - 1 / f, g**-power - f**-power],
        ]
    )
    a = mpmath.lu_solve(rows, mpmath.matrix([c[0], dispersion, partial * dispersion]))
    return a[0] + a[1] / w + a[2] * w**-power


FORMULAS = {
    "schott": square(lambda c, w: sum(c[i] * w**p for i, p in enumerate([0, 2, -2, -4, -6, -8]))),
    "sellmeier_1": sellmeier(3),
    "herzberger": herzberger,
    "sellmeier_2": square(lambda c, w: 1 + c[0] + c[1] * w**2 / (w**2 - c[2] ** 2) + c[3] / (w**2 - c[4] ** 2)),
    "conrady": lambda c, w: c[0] + c[1] / w + c[2] / w ** (mpmath.mpf(7) / 2),
    "sellmeier_3": sellmeier(4),
    "handbook_1": square(lambda c, w: c[0] + c[1] / (w**2 - c[2]) - c[3] * w**2),
    "handbook_2": square(lambda c, w: c[0] + c[1] * w**2 / (w**2 - c[2]) - c[3] * w**2),
    "sellmeier_4": square(lambda c, w: c[0] + c[1] * w**2 / (w**2 - c[2]) + c[3] * w**2 / (w**2 - c[4])),
    "extended": square(lambda c, w: sum(c[i] * w**p for i, p in enumerate([0, 2, -2, -4, -6, -8, -10, -12]))),
    "sellmeier_5": sellmeier(5),
    "extended_2": square(lambda c, w: sum(c[i] * w**p for i, p in enumerate([0, 2, -2, -4, -6, -8, 4, 6]))),
    "extended_3": square(lambda c, w: sum(c[i] * w**p for i, p in enumerate([0, 2, 4, -2, -4, -6, -8, -10, -12]))),
    "constant": lambda c, w: c[0] + 0 * w,
    "model": model,
}

#: Real glasses where one uses the formula; each coefficient of the series is different from 0.
CASES = {
    "schott": [2.592001, -0.01540969, 0.0102268, 0.001581559, -0.0001877149, 1.012515e-05],
    "sellmeier_1": [1.03961212, 0.00600069867, 0.231792344, 0.0200179144, 1.01046945, 103.560653],
    "herzberger": [2.51253618, 0.0686942636, 0.0211563734, -0.000155048679, -4.35296121e-08, 1.99858193e-10],
    "sellmeier_2": [0.42, 0.9, 0.11, 0.012, 0.15],
    "conrady": [1.57410327, 0.0139786149, 0.00083004511],
    "sellmeier_3": [0.8559, 0.00345744, 0.8391, 0.019881, 0.0009, 0.038809, 0.6845, 49.070025],
    "handbook_1": [6.364, 0.342, 0.09, 0.0011],
    "handbook_2": [2.81418, 0.87968, 0.09253764, 0.00711],
    "sellmeier_4": [3.1399, 1.3786, 0.02941, 3.861, 225.9009],
    "extended": [2.2865, -0.00873, 0.01174, 0.00029, -1.25e-05, 9.26e-07, -2.1e-08, 3.7e-10],
    "sellmeier_5": [
        1.8293958, 0.0225, 1.6675593, 0.0625, 1.1210424, 0.1225, 0.04513366, 0.2025, 12.380234, 27089.8681
    ],
    "extended_2": [
        2.54662904, -0.0122972332, 0.0187464623, 0.000460296583, 7.85351066e-07, 1.72720972e-06, -0.000133476806, 1e-6
    ],
    "extended_3": [
        2.45448839, -0.00867148963, -0.00010471524, 0.0176039752, 0.000154610243, 5.59918259e-05, -5.01297284e-06,
        3.1755799e-07, 1.3e-08
    ],
    "constant": [1.5],
    "model": [1.517, 64.2, 0.0012],
}  # fmt: skip

WAVELENGTHS = {"herzberger": [1.5, 10.6], "sellmeier_5": [0.6328, 10.6], "handbook_1": [0.6328, 4.0]}


def main() -> None:
    cases = []
    for formula, coefficients in CASES.items():
        exact = [mpmath.mpf(number) for number in coefficients]
        for wavelength in WAVELENGTHS.get(formula, [0.4358343, 0.5875618, 0.85]):
            n = FORMULAS[formula](exact, mpmath.mpf(wavelength))
            slope = mpmath.diff(lambda w, f=FORMULAS[formula], c=exact: f(c, w), mpmath.mpf(wavelength))
            case = {"formula": formula, "coefficients": coefficients, "wavelength": wavelength}
            cases.append(case | {"n": mpmath.nstr(n, 30), "slope": mpmath.nstr(slope, 25)})
    lines = ",\n".join(json.dumps(case) for case in cases)
    print(f'{{"how": "tests/oracles/make_dispersion.py, mpmath at 60 digits", "cases": [\n{lines}\n]}}')


if __name__ == "__main__":
    main()
