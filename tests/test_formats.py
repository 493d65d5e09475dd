"""Round trips, damaged files, and the doors of reading and writing."""

import contextlib
import dataclasses
import os
import random
import re
import warnings
from pathlib import Path

import pytest
import torch
from hypothesis import strategies as st
from problems import SHARED, for_examples, number, vector
from problems_files import assert_same, damaged, leaves, read_damaged, readable, sized

import raytrace as rt
from raytrace.files import shipped
from raytrace.io import FORMATS, WRITTEN, LensFileError, LensFileWarning, read_lens, read_lens_with_report, write_lens
from raytrace.io.frames import lens_from_frame, to_frame
from raytrace.io.source import MAX_BYTES, Place, decode
from raytrace.materials.catalogs import UnknownGlass
from raytrace.materials.environment import Environment
from raytrace.materials.glass import constant, model_glass
from raytrace.system.lens import Lens, SystemAperture
from raytrace.system.surface import Aperture, is_freeform, is_posed

ROOT = Path(__file__).parents[1]
OWN = sorted(path for path in (ROOT / "lenses").iterdir() if path.suffix in FORMATS)
CORPUS = sorted(path for folder in ("corpus/zmx", "tier2/dev") for path in (SHARED / folder).glob("*.[zZ][mM][xX]"))
SUFFIXES = WRITTEN


# -- round trips -------------------------------------------------------------------------------------------------------


def test_the_double_gauss_is_that_of_the_publication_in_both_files():
    zmx, csv = read_lens("double_gauss"), read_lens(ROOT / "lenses" / "double_gauss.csv", strict=True)
    assert leaves(zmx) == leaves(csv)
    curvatures = [0.0 if s.curvature is None else float(s.curvature) for s in zmx.surfaces[1:-1]]
    assert curvatures == [
        *(0.0184661976, 0.0065564346, 0.027815929, 0.0, 0.04490361, 0.0),
        *(-0.03893318, 0.0, -0.027041482, 0.0050912, -0.014892576),
    ]
    thicknesses = [8.74664, 0.5, 14.0, 3.77696, 14.253, 12.4281, 3.777, 10.834, 0.5, 6.8581, 58.5, 0.0]
    assert [float(s.thickness) for s in zmx.surfaces] == [float("inf"), *thicknesses]
    names = ["SK2", "", "SK16", "F5", "", "", "F5", "SK16", "", "SK16", ""]
    assert [s.glass.name for s in zmx.surfaces[1:-1]] == names
    assert zmx.surfaces[6].semi_diameter == 10.229
    assert (zmx.stop, float(zmx.aperture.value), zmx.wavelengths.tolist()) == (6, 33.33, [0.53])
    assert zmx.fields.y.tolist() == [0.0, 10.0, 14.0]


@pytest.mark.parametrize("path", OWN, ids=lambda path: path.name)
def test_own_lenses_are_read_without_a_warning(path):
    assert read_lens_with_report(path, strict=True)[1].warnings == ()


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("path", OWN, ids=lambda path: path.name)
def test_every_number_round_trip_bit_identically(path, suffix, tmp_path):
    lens = read_lens(path)
    write_lens(lens, tmp_path / f"lens{suffix}")
    assert leaves(read_lens(tmp_path / f"lens{suffix}", strict=True)) == leaves(sized(lens))


def without_intent(lens):
    """The lens without what it is to become: a curvature or conic of 0 is modelled only because it varies."""
    zero = [
        {
            name: None
            for name in ("curvature", "conic")
            if getattr(surface, name) is not None and not getattr(surface, name)
        }
        for surface in lens.surfaces
    ]
    surfaces = tuple(dataclasses.replace(surface, **none) for surface, none in zip(lens.surfaces, zero, strict=True))
    return dataclasses.replace(lens, surfaces=surfaces, optimization_data=None)


@pytest.mark.needs(SHARED)
@pytest.mark.parametrize("path", CORPUS, ids=lambda path: path.name)
def test_real_files_round_trip_bit_identically(path, tmp_path):
    lens = readable(path)
    if lens is None:  # refused by name
        return
    plain = not any(
        is_posed(surface) or is_freeform(surface) or surface.phase or surface.sag_terms for surface in lens.surfaces
    )
    one = dataclasses.replace(lens, operands=(), current_configuration=1)  # which others do not hold
    for suffix in SUFFIXES if plain else [".zmx", ".seq"]:
        refused = [LensFileError] if suffix == ".seq" else []  # where CODE V has no command for it
        with contextlib.suppress(*refused):
            write_lens(lens, tmp_path / f"lens{suffix}")
            again = read_lens(tmp_path / f"lens{suffix}")
            if suffix == ".zmx":
                assert_same(again, sized(lens))
            else:
                assert leaves(without_intent(again)) == leaves(without_intent(sized(one)))


@pytest.mark.parametrize("path", OWN, ids=lambda path: path.name)
def test_pandas_brings_every_number_back(path):
    lens = read_lens(path)
    assert leaves(lens_from_frame(to_frame(lens), strict=True)) == leaves(lens)


finite = st.floats(allow_nan=False, allow_infinity=False, width=64).map(lambda x: x + 0.0)
positive = st.floats(min_value=5e-324, max_value=1e300)


@pytest.mark.parametrize("examples", [10, *(pytest.param(n, marks=pytest.mark.slow) for n in (30, 100))])
@pytest.mark.parametrize("suffix", [".zmx", ".csv"])
def test_any_64_bit_number_survives(suffix, examples):
    double_gauss = read_lens("double_gauss")

    def round_trip(curvature, conic, thickness, terms, size):
        lens = double_gauss.replace(
            3,
            curvature=number(curvature) if curvature else None,
            conic=number(conic) if conic else None,
            thickness=number(thickness),
            coefficients=number(terms),
            semi_diameter=size,
            apertures=(Aperture("elliptic", (size, size), True, (conic, curvature)),),
        )
        lens = dataclasses.replace(lens, aperture=SystemAperture("object_na", number(size)))
        written = FORMATS[suffix].write(lens, "lens")
        assert leaves(FORMATS[suffix].read(decode(written, Place("lens")), "lens")[0]) == leaves(lens)

    numbers = dict.fromkeys(("curvature", "conic", "thickness"), finite)
    for_examples(examples, round_trip, **numbers, terms=st.lists(finite, min_size=1, max_size=8), size=positive)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_media_of_no_catalog_round_trip(suffix, tmp_path):
    by_figures_alone = suffix == ".seq"  # neither a name of a model glass nor its partial dispersion
    for glass in (
        constant(1.333),
        constant(1.333, "WATER"),
        model_glass(1.6, 40.0, 0.0 if by_figures_alone else 0.01),
        model_glass(1.5, 60, name="" if by_figures_alone else "X1"),
    ):
        lens = read_lens("double_gauss").replace(2, glass=glass)
        write_lens(lens, tmp_path / f"lens{suffix}")
        assert leaves(read_lens(tmp_path / f"lens{suffix}")) == leaves(sized(lens))


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_texts_of_any_language_round_trip(suffix, tmp_path):
    lens = read_lens("double_gauss").replace(2, comment='Fläche, "zwei"; 表面')
    lens = dataclasses.replace(lens, name="Größe #1: λ", notes=("x" * 431, "a, b; c: d,", "# e"))
    write_lens(lens, tmp_path / f"lens{suffix}")
    again = read_lens(tmp_path / f"lens{suffix}")
    assert (again.name, again.surfaces[2].comment) == (lens.name, lens.surfaces[2].comment)
    assert again.notes == lens.notes


# -- what cannot be written --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "suffix", "message"),
    [
        ({"thickness": number(float("nan"))}, ".zmx", "thickness is nan"),
        ({"thickness": number(float("inf"))}, ".csv", "thickness is inf"),
        ({"curvature": number([0.1, 0.2])}, ".zmx", "a file holds one lens"),
        ({"coefficients": number([[0.1, 0.2]])}, ".csv", "a file holds one lens"),
        ({"coefficients": number([1e-9] * 9), "kind": "odd asphere"}, ".zmx", "ODDASPHE has 8"),
        ({"comment": "two\nlines"}, ".zmx", "line break"),
        ({"glass": constant(1.5, "two words")}, ".zmx", "one word"),
        ({"apertures": (Aperture("circular", (0.0, 1.0)),) * 2}, ".zmx", "has one"),
    ],
)
def test_data_that_a_format_cannot_hold_are_refused(changes, suffix, message, tmp_path):
    with pytest.raises(LensFileError, match=message) as caught:
        write_lens(read_lens("double_gauss").replace(3, **changes), tmp_path / f"lens{suffix}")
    assert caught.value.surface == 3
    assert list(tmp_path.iterdir()) == []


def test_a_glass_that_is_not_the_listed_one_is_refused(tmp_path):
    lens = read_lens("double_gauss")
    glass = lens.surfaces[3].glass
    changed = dataclasses.replace(glass, coefficients=glass.coefficients * 1.001)
    with pytest.raises(LensFileError, match="not those of its catalog"):
        write_lens(lens.replace(3, glass=changed), tmp_path / "lens.zmx")


def test_more_terms_and_apertures_fit_into_a_table(tmp_path):
    lens = read_lens("double_gauss").replace(
        3, coefficients=number([1e-9] * 12), apertures=(Aperture("circular", (0.0, 1.0)),) * 2
    )
    write_lens(lens, tmp_path / "lens.csv")
    assert leaves(read_lens(tmp_path / "lens.csv")) == leaves(lens)


def test_float32_lenses_are_written_exactly(tmp_path):
    lens = read_lens("double_gauss").replace(1, thickness=torch.tensor(0.1, dtype=torch.float32))
    write_lens(lens, tmp_path / "lens.zmx")
    assert float(read_lens(tmp_path / "lens.zmx").surfaces[1].thickness) == float(torch.tensor(0.1))


def test_writing_replaces_the_file_as_a_whole_or_not_at_all(tmp_path):
    path = tmp_path / "lens.zmx"
    write_lens(read_lens("double_gauss"), path)
    before = path.read_bytes()
    with pytest.raises(LensFileError):
        write_lens(read_lens("double_gauss").replace(3, thickness=number(float("nan"))), path)
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["lens.zmx"]
    with pytest.raises(LensFileError, match="cannot be written"):
        write_lens(read_lens("double_gauss"), tmp_path / "no such folder" / "lens.zmx")


# -- reading and writing -----------------------------------------------------------------------------------------------


def test_an_unknown_name_lists_the_shipped_lenses():
    for name in ("double_gaus", "double_gaus.zmx"):
        with pytest.raises(LensFileError, match=r"cooke_triplet.*did you mean double_gauss"):
            read_lens(name)
    with pytest.raises(LensFileError, match=r"no such file .*the shipped lenses are"):
        read_lens("biotar")


def test_suffixes_and_paths_that_are_no_lens_files(tmp_path):
    with pytest.raises(LensFileError, match=r"'\.pdf' is that of no format.*\.zmx"):
        read_lens(tmp_path / "lens.pdf")
    with pytest.raises(LensFileError, match="no suffix"):
        write_lens(read_lens("double_gauss"), tmp_path / "lens")
    with pytest.raises(LensFileError, match="cannot be read: No such file"):
        read_lens(tmp_path / "lens.zmx")
    (tmp_path / "folder.zmx").mkdir()
    with pytest.raises(LensFileError, match="not a regular file"):
        read_lens(tmp_path / "folder.zmx")
    with pytest.raises(LensFileError):
        read_lens(tmp_path / "zero\0byte.zmx")


def test_a_fifo_is_refused_and_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "pipe.zmx")
    with pytest.raises(LensFileError, match="not a regular file"):
        read_lens(tmp_path / "pipe.zmx")


def test_a_file_of_200_mb_is_refused_unread(tmp_path):
    path = tmp_path / "large.zmx"
    with open(path, "wb") as file:
        file.truncate(200_000_000)
    with pytest.raises(LensFileError, match="200 MB"):
        read_lens(path)
    assert MAX_BYTES < 200_000_000


@pytest.mark.parametrize("suffix", [".zmx", ".csv"])
def test_10000_surfaces_are_refused_with_the_line(suffix, tmp_path):
    path = tmp_path / f"many{suffix}"
    surfaces = "".join(f"SURF {k}\n  CURV 0\n  DISZ 1\n" for k in range(10_000))
    rows = "radius,thickness\n" + "50,1\n" * 10_000
    path.write_text(surfaces if suffix == ".zmx" else rows)
    with pytest.raises(LensFileError, match="more than 1000 surfaces") as caught:
        read_lens(path)
    assert caught.value.line is not None


def test_lossy_data_are_warned_of_once(tmp_path):
    path = tmp_path / "lens.csv"
    path.write_text("surface,radius,thickness\nstop,,3\nimage,,\n")
    with pytest.warns(LensFileWarning, match="no wavelengths"):
        read_lens(path)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        read_lens_with_report(path)


@pytest.mark.parametrize(
    "line",
    [
        "  DISZ " + "1" * 99_000 + "x",
        "  GLAS " + "N" * 99_000,
        "# fields: angle " + "(1 2) " * 9_000 + "x",
        "# aperture: f" + "/" * 99_000,
        "# note " + "," * 99_000 + "x",
        "# " + "a" * 99_000 + ": 1",
        "1 " * 49_000,
        "x" * 100_001,
        "\n" * 200_001,
    ],
    ids=lambda line: line[:12].strip() or "lines",
)
@pytest.mark.parametrize("name", ["double_gauss.zmx", "double_gauss.csv"])
def test_long_lines_do_not_hang(line, name):
    first, _, rest = (ROOT / "lenses" / name).read_text().partition("\n")
    end = rest.index("\n", rest.index("SURF 1")) if name.endswith("zmx") else 0
    content = "\n".join([first, rest[:end], line, rest[end:]]).encode()
    read_damaged(Path(name), content)


# -- damaged files -----------------------------------------------------------------------------------------------------


_ORIGINALS = [(path, path.read_bytes()) for path in (*OWN, *CORPUS)]


@pytest.mark.parametrize("examples", [30, *(pytest.param(n, marks=pytest.mark.slow) for n in (100, 20_000))])
def test_damaged_files_give_a_lens_or_a_clear_error(examples):
    def read_one(seed, which):
        path, content = _ORIGINALS[which]
        read_damaged(path, damaged(content, random.Random(seed)))

    for_examples(examples, read_one, seed=st.integers(0, 2**63), which=st.integers(0, len(_ORIGINALS) - 1))


@pytest.mark.parametrize("examples", [75, pytest.param(300, marks=pytest.mark.slow)])
def test_any_bytes_give_a_lens_or_a_clear_error(examples):
    def read_one(content, suffix):
        read_damaged(Path(f"lens{suffix}"), content)

    for_examples(examples, read_one, content=st.binary(max_size=400), suffix=st.sampled_from(SUFFIXES))


@pytest.mark.parametrize("path", OWN[:2], ids=lambda path: path.name)
def test_a_file_cut_off_anywhere_is_no_shorter_lens(path):
    content = path.read_bytes()
    lens = read_lens(path)
    for end in range(0, len(content), 7):
        try:
            cut = FORMATS[path.suffix].read(decode(content[:end], Place(path.name)), path.name)[0]
        except (LensFileError, UnknownGlass):
            continue
        assert len(cut.surfaces) == len(lens.surfaces)


# -- the commands ------------------------------------------------------------------------------------------------------


def test_check_reports_the_data_read():
    found = rt.check("double_gauss")
    lens, report = read_lens_with_report("double_gauss")
    assert str(found) == str(report)
    assert found.document()["surfaces"] == len(lens.surfaces)
    assert found.document()["stop_surface"] == lens.stop
    frame = found.to_frame()
    assert frame[frame.keyword == "SURF"]["count"].tolist() == [len(lens.surfaces)]
    assert set(frame.status) <= {"read", "ignored", "unknown"}


def test_check_refuses_untraceable_lenses(tmp_path):
    path = tmp_path / "still.zmx"
    text = (ROOT / "lenses" / "singlet.zmx").read_text()
    path.write_text(text.replace("FTYP 0", "FTYP 1"))  # heights of an object at infinity
    read_lens(path)
    with pytest.raises(LensFileError, match=re.escape(str(path))):
        rt.check(path)


def test_convert_reports_the_file_written(tmp_path):
    found = rt.convert("double_gauss", tmp_path / "copy.csv")
    source, target = shipped("lenses") / "double_gauss.zmx", tmp_path / "copy.csv"
    assert str(found) == f"{target}: 13 surfaces from {source}"
    assert found.document() == {"input": str(source), "output": str(target), "surfaces": 13}
    assert leaves(read_lens(tmp_path / "copy.csv")) == leaves(sized(read_lens("double_gauss")))


# -- the page of formats -----------------------------------------------------------------------------------------------


def featured(**row) -> Lens:
    rows = [{"radius": 50.0, "thickness": 5.0, "glass": 1.5, **row}, {"radius": -60.0, "thickness": 40.0}]
    return rt.lens(rows, stop=1, entrance_pupil_diameter=5, fields=[0, 3])


#: Lenses of a row of the page, and for each what a cell has that stands for a format which does not write it.
FEATURES = {
    "conics, mirrors, glasses": [(featured(conic=-1.0, glass="N-BK7"), "refused")],
    "aspheres": [
        (featured(coefficients=vector(0.0, 1e-6, 1e-20)), "refused"),
        (featured(coefficients=vector(1e-4)), "r⁴ to"),
        (featured(coefficients=vector(*[0.0] * 10, 1e-30)), "r⁴ to"),
        (featured(kind="odd asphere", coefficients=vector(0.0, 0.0, 1e-5)), "r⁴ to"),
    ],
    "toroids, biconics": [
        (featured(kind="toroidal", coefficients=vector(0.01)), "refused"),
        (featured(kind="biconic", coefficients=vector(0.01, 0.0)), "refused"),
    ],
    "tilts and decentres": [(featured(before=rt.system.Pose(tilt_x=number(3.0))), "refused")],
    "gratings, holograms, phases": [
        (featured(phase=rt.system.Grating(number(0.1), number(1.0))), "refused|powers"),
        (featured(phase=rt.system.RadialPhase(vector(3.0, 1.0), number(2.0), number(1.0))), "refused"),
    ],
    "apertures and obscurations": [
        (featured(apertures=(Aperture("rectangular", (4.0, 3.0)),)), "refused"),
        (featured(apertures=(Aperture("circular", (0.0, 1.0), obscures=True),)), "refused"),
        (featured(apertures=(Aperture("polygon", (-4.0, -4.0, 4.0, -4.0, 0.0, 4.0, -4.0, -4.0)),)), "polygons"),
    ],
    "temperature and pressure": [
        (dataclasses.replace(featured(), environment=Environment(number(40.0), number(0.5))), "refused|20 °C"),
    ],
}


@pytest.mark.parametrize("row", FEATURES)
def test_page_of_formats_states_what_is_written(row, tmp_path):
    """The cells of formats that are written: what is not refused there comes back bit by bit."""
    page = (ROOT / "docs" / "reference" / "formats.md").read_text("utf-8")
    heads, *table = (line.strip("| ").split(" | ") for line in page.splitlines() if line.startswith("| "))
    (cells,) = (line[1:] for line in table if line[0] == row)
    for suffix in WRITTEN:
        (cell,) = (cell for head, cell in zip(heads[1:], cells, strict=True) if f"`{suffix}`" in head)
        for lens, refusal in FEATURES[row]:
            path = tmp_path / f"lens{suffix}"
            if re.search(refusal, cell):
                with pytest.raises(LensFileError):
                    write_lens(lens, path)
            else:
                write_lens(lens, path)
                again = read_lens(path)
                assert leaves(again.surfaces) == leaves(sized(lens).surfaces), (suffix, cell)
                assert leaves(again.environment) == leaves(lens.environment), (suffix, cell)


def test_a_tilted_object_is_not_written(tmp_path):
    rows = [dict(radius=50, thickness=5, glass="N-BK7"), dict(thickness=90)]
    lens = rt.lens(rows, stop=1, entrance_pupil_diameter=10, object_distance=200).replace(0, tilt_x=1)
    for suffix in WRITTEN:
        with pytest.raises(LensFileError, match="surface 0: a tilt or decentre of the object"):
            write_lens(lens, tmp_path / f"lens{suffix}")
