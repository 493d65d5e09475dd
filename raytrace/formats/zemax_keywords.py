"""The keywords of a .zmx file: which are read, and which are known and left out, with the reason."""

from raytrace.system.aperture import SHAPES
from raytrace.system.shapes import KINDS


def _words(text: str) -> frozenset[str]:
    return frozenset(text.split())


#: Keywords of the system that are read.
SYSTEM_READ = _words(
    "VERS MODE NAME NOTE UNIT GCAT ENVD GFAC RAIM FTYP PWAV MNUM"
    " ENPD FNUM OBNA FLOA"
    " XFLN YFLN FWGN XFLD YFLD FWGT"
    " VDXN VDYN VCXN VCYN VANN ZVDX ZVDY ZVCX ZVCY ZVAN VDX VDY VCX VCY VAN"
    " WAVM WAVL WAVN WWGT WWGN"
)

#: Keywords of a surface that are read, beside those of its aperture.
_SURFACE_READ = _words("SURF TYPE CURV CONI DISZ GLAS DIAM STOP PARM COMM FLAP OBDC USAP USOB UDAD SCBD IGNR")

#: Keywords that may stand more than once in the system or in one surface.
REPEATED = _words("NOTE WAVM PARM UDAD XDAT PPAR VPAR SCBD")

_SETTING = "setting of the program, says nothing about the lens"
_DISPLAY = "how the program draws it"
_SOLVE = "solve or variable: the file stores the solved value, which is read"
_TOLERANCE = "tolerance"
_COATING = "coatings do not bend rays"
_WAVES = "sampling of wave propagation"

#: Keywords of the system that are known and left out.
SYSTEM_IGNORED = {
    "PFIL": _SETTING,
    "LANG": _SETTING,
    "HYPR": _SETTING,
    "ROPD": _SETTING,
    "PICB": _SETTING,
    "SDMA": "how semi-diameters are recomputed; the stored ones are read",
    "OMMA": "how mechanical semi-diameters are recomputed",
    "PUSH": "shift of the pupil for the program's own ray aiming",
    "GLRS": "global coordinate reference: changes no ray",
    "GSTD": "default tolerances and glass substitution",
    "NSCD": "settings of non-sequential mode",
    "COFN": "names of coating and scatter files",
    "POLS": "polarisation",
    "EERA": _SETTING,
    "LUID": _SETTING,
    "IWDP": _SETTING,
    "AUTH": "author; not carried",
    "STUD": _SETTING,
    "FSVY": _SETTING,
    "FCOM": "comment on a field point; not carried",
    "DBDT": "entry of the vendor's catalog",
    "CSUM": "checksum of the program",
}

#: Keywords of a surface that are known and left out.
SURFACE_IGNORED = {
    "FIMP": _SETTING,
    "HIDE": _DISPLAY,
    "SCOL": _DISPLAY,
    "MIRR": "substrate of a mirror, for drawing",
    "SLAB": "label for the program's macros",
    "SSID": "label for the program's macros",
    "POPS": _WAVES,
    "MEMA": "mechanical semi-diameter: for drawing and mounting, never clips a ray",
    "OEMA": "edge of the mechanical part",
    "EDGE": "edge of the part, for drawing",
    "COAT": _COATING,
    "TCED": "coefficient of thermal expansion",
    "TOLE": _TOLERANCE,
    "XDAT": "extra data, which this type of surface does not use",
    "VCON": _SOLVE,
    "VDSZ": _SOLVE,
    "VPAR": _SOLVE,
    "PZUP": _SOLVE,
    "PPAR": _SOLVE,
    "MAZH": _SOLVE,
}

#: What follows the last surface belongs to these, and not to the lens.
TAIL_REASON = "merit function, tolerances or configurations: not part of the lens"

#: Types of surface by what OpticStudio calls them; modelled are STANDARD and those of the rows of `shapes.KINDS`.
TYPE_NAMES = {
    "COORDBRK": "coordinate break",
    "PARAXIAL": "paraxial lens",
    "PARAX_XY": "paraxial XY",
    "TOROIDAL": "toroidal",
    "DGRATING": "diffraction grating",
    "EGRATING": "elliptical grating",
    "TILTSURF": "tilted",
    "ODDASPHE": "odd asphere",
    "XASPHERE": "extended asphere",
    "XOSPHERE": "extended odd asphere",
    "BICONICX": "biconic",
    "IRREGULA": "irregular",
    "ZERNSAG": "Zernike sag",
    "SZERNSAG": "Zernike standard sag",
    "FZERNSAG": "Zernike fringe sag",
    "SZERNPHA": "Zernike standard phase",
    "FZERNPHA": "Zernike fringe phase",
    "XPOLYNOM": "extended polynomial",
    "POLYNOMI": "polynomial",
    "BINARY_1": "binary 1",
    "BINARY_2": "binary 2",
    "BINARY_3": "binary 3",
    "FRESNELS": "Fresnel",
    "CFRESNEL": "cylindrical Fresnel",
    "GRINSUR1": "gradient index 1",
    "GRINSUR5": "gradient index 5",
    "GRADIUM": "gradient index",
    "HOLOGRM1": "hologram 1",
    "HOLOGRM2": "hologram 2",
    "CONJUGAT": "conjugate",
    "RETROREF": "retro-reflector",
    "JONES_MA": "Jones matrix",
    "ATMOSPHR": "atmospheric",
    "GRIDSAG": "grid sag",
    "GRID_SAG": "grid sag",
    "ALTERNAT": "alternate",
    "QTYPE": "Q-type asphere",
    "NONSEQCO": "non-sequential component",
    "USERSURF": "user-defined (DLL)",
    "BIREFR_I": "birefringent in",
    "BIREFR_O": "birefringent out",
    "BICONIC": "biconic",
    "CUBICSPL": "cubic spline",
    "DATASURF": "data",
    "BLACKBOX": "black box",
}

#: Millimetres in the unit of length named by UNIT.
MILLIMETRES = {"MM": 1.0, "CM": 10.0, "IN": 25.4, "INCH": 25.4, "M": 1e3, "METER": 1e3}

#: Kind of field by the number of FTYP, and back.
FIELD_KINDS = ("angle", "object_height", "paraxial_image_height", "real_image_height")
FIELD_NAMES = {4: "theodolite angle"}


def modelled_types() -> dict[str, str]:
    """Kind of sag by the TYPE that has its terms in PARM; STANDARD has none."""
    return {"STANDARD": "", **{kind.zemax: name for name, kind in KINDS.items() if kind.zemax}}


def aperture_keywords() -> dict[str, tuple[str, bool]]:
    """Shape of an aperture, and whether it obscures, by keyword; FLAP floats by the semi-diameter."""
    rows = {keyword: (name, bool(k)) for name, shape in SHAPES.items() for k, keyword in enumerate(shape.zemax)}
    return {"FLAP": ("circular", False), **rows}


def surface_read() -> frozenset[str]:
    """Keywords of a surface that are read."""
    return _SURFACE_READ | aperture_keywords().keys()
