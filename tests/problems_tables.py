"""Prescription tables as patents and programs print them."""

#: US 3,552,829 (Mandler, 1971), example 1, f = 50: radius, thickness, nd, νd, diameter.
SUMMILUX = """\
1 56.6550 5.2400 1.81500 45.2 38.50
2 600.0000 0.5650 - - 38.50
3 25.6800 6.5600 1.69400 54.6 33.50
4 51.8750 0.8000 - - 28.716
5 84.6000 2.2550 1.63003 35.4 34.00
6 17.2950 5.865 - - 24.50
stop inf 5.565 - - 24.100
7 -19.4750 2.8550 1.79180 25.9 24.00
8 246.0200 6.1850 1.80040 42.7 31.00
9 -35.9650 0.0950 - - 31.00
10 -125.8950 4.0500 1.80040 42.7 31.50
11 -37.6250 0.0950 - - 31.50
12 198.1300 4.0500 1.71615 53.7 31.50
13 -63.0250 36.5 - - 31.50
"""

#: US 3,459,468 (Mandler and Wagner, 1969), example 1, scaled to f = 52; Bf = 27.68.
NOCTILUX = """\
面番号\t曲率半径\t面間隔\t屈折率\tアッベ数\t有効径
1\t59.852\t6.760\t1.821\t45.2\t53.20
2\t237.692\t0.208\t\t\t53.20
3\t29.900\t11.752\t1.900\t40.5\t46.90
4\t126.568\t2.184\t1.792\t25.9\t50.91
5\t18.148\t8.112\t\t\t29.02
6(絞り)\t∞\t5.928\t\t\t24.96
7\t−23.400\t1.612\t1.844\t30.0\t27.77
8\t72.020\t9.412\t1.900\t40.5\t37.54
9\t－34.580\t0.052\t\t\t36.92
10\t６１．３６０\t6.084\t1.694\t54.6\t32.34
11\t−55.796\t27.68\t\t\t32.34
"""

#: US 2,601,805 (Lowenthal, 1952) as recomputed in W. J. Smith, Modern Lens Design (1992), p. 305: EFL 100.4, BFL 55.07.
LOWENTHAL = """\
radius    thickness  index  V-no   sa
85.500    11.600     1.744  44.7   38.0
408.330    1.500     1      0      38.0
40.350    17.000     1.620  60.1   33.0
156.050    3.500     1.621  36.2   33.0
25.050    13.700     1      0      22.0
stop       8.300     1      0      21.3
-36.800    3.500     1.689  31.2   22.0
55.00     23.000     1.744  44.7   26.0
-51.500    1.000     1      0      26.0
123.500   17.000     1.744  44.7   26.0
-204.960  55.066     1      0      26.0
"""


def summilux(headings: str, order: str = "No R d n V") -> str:
    """The table of the Summilux with its columns in an order, under these headings."""
    place = {"No": 0, "R": 1, "d": 2, "n": 3, "V": 4, "D": 5}
    rows = [line.split() for line in SUMMILUX.splitlines()]
    return "\n".join(
        [headings, *(",".join(row[place[name]].replace("inf", "∞") for name in order.split()) for row in rows)]
    )
