"""Texts of OSLO files."""

FAR = "TH 1e20"


def text(surfaces, *system, title="x", stated="", tail="", waves="WV 0.58756; WW 1", end=None) -> str:
    """A lens file: commands of each surface from the object to the one before the image, then those of the image."""
    lines = [f'LEN NEW "{title}" {stated}', *system, *(f"{surface}; NXT" for surface in surfaces), waves]
    return "\n".join([*lines, f"END {len(surfaces) if end is None else end}", tail]) + "\n"


SINGLET = ("TH 1e20", "RD 50; GLA N-BK7; TH 4; AP 6", "RD -50; TH 47.5; AST")

#: What OSLO printed: SA3, CMA3, AST3, PTZ3, DIS3 of every surface with power.
CONIC = ("RD 50; GLA N-BK7; CC -0.6; AD -6e-7; AE 2.5e-10; AF -8e-14; AP CHK 10.1; TH 6", "RD -200; AP CHK 10.1; TH 76")


def double_gauss(waves: str) -> str:
    """That of Kingslake."""
    return text(
        (
            *(FAR, "RD 25.907; GLA SK4; TH 5.083", "RD 147.341; TH 2.355", "RD 34.804; GLA F4; TH 1.694"),
            *("RD 17.34; TH 2.542", "AST; TH 2.542", "RD -17.34; GLA F4; TH 1.694", "RD -34.8; TH 2.355"),
            *("RD -138.87; GLA SK4; TH 5.083", "RD -24.53; TH 89.832"),
        ),
        "UNI 1.0; EBR 6.25; ANG 14",
        waves=waves,
    )
