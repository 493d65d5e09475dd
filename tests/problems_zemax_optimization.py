"""Texts of .zmx files with optimisation data."""

RULES = """TYPE EVENASPH
CURV 0.02 1 0 0 0 ""
VDSZ 0 0
VCON
PARM 2 1e-5
VPAR 2
PARM 3 0
VPAR 3"""

STOP_RULES = "MAZH 0.125 0.7\nPZUP 1 -1 0.5 0\nDIAM 5.5 0 0 0 1\nTOLE 1 5\nEDGE 0.5 3\nCURV -0.02 4 1 -1 0"

MERIT_LINES = """DMFS 0 0 0 0 0 0 0 0 0 0
BLNK A text,  with blanks.
TRAC 0 1 0 0.7 3.35E-1 0 0 7.27E-2 0 0
EFFL 0 2 0 0 0 0 2.5 1 0 0
MXCV 1 2 0 0 0 0 0.05 1 0 0
CONS 0 0 0 0 0 0 1.5 0 0 0
DIFF 4 6 0 0 0 0 1 1 0 0
DIVI 4 6 0 0 0 0 1 1 0 0
RECI 4 0 0 0 0 0 0.4 1 0 0
SSAG 1 2 0.5 0.25 0 0 0.125 1 0 0
PMVA 1 2 0 0 0 0 1e-5 1 0 0
QQQQ 1 2 3 4 5 6 7 8 9 10 AUTO
TOL TOFF   0   0              0              0   0 0 0
TOL TTHI   1   2 -0.25 0.5   0 0 0
TCMM A comment.
MNUM 1 1"""

CONFIGURED = """MNUM 2 1
MOFF   0   1 "" 0 0 0 1 1 0 0.0 ""
MOFF   0   2 "" 0 0 0 1 1 0 0.0 ""
THIC   1   1 4 1 0 0 1 1 1.0 0.0 0
THIC   1   2 5 1 0 0 1 1 1.0 0.0 0
CRVT   2   1 -0.02 0 0 0 1 1 1.0 0.0 0
CRVT   2   2 -0.04 2 0 0 1 3 2.0 0.0 0
PRAM   1   1 1E-5 1 2 0 1 1 1.0 0.0 0
PRAM   1   2 2E-5 0 2 0 1 1 1.0 0.0 0"""
