"""Catalogs: the shipped figures against their listings, the AGF reader and writer, finding a glass by its name."""

import math
import os
import random
import re
import subprocess
import sys
import warnings

import pytest
import torch
from hypothesis import strategies as st
from problems import for_examples
from problems_zemax import SMALL

import raytrace as rt
from raytrace.materials import agf, catalogs
from raytrace.materials.agf import format_agf, parse_agf
from raytrace.materials.catalogs import (
    SHIPPED,
    AmbiguousGlass,
    Catalog,
    CatalogError,
    CatalogWarning,
    UnknownGlass,
    aliases,
    find_glass,
    missing_catalogs,
    nearest_glasses,
    read_agf,
    shipped_catalog,
    shipped_folder,
    write_agf,
)
from raytrace.materials.glass import (
    BY_NUMBER,
    MIRROR,
    abbe_number,
    constant,
    index,
    internal_transmittance,
    nd,
    refractive_index,
)

#: Glasses of which their catalog lists no nd and Vd (infrared materials, and crystals that are opaque at the d line,
#: were entered as nd = 1, Vd = 0), so that there is nothing to compare with. No listing that exists is inconsistent.
UNLISTED = {
    "INFRARED": "AGCL AMTIR1 AMTIR3 CDSE CDTE GAAS GERMANIUM GE_LONG GE_OLD IRG100 KRS5 NACL SILICON TI_1173 ZBLA "
    "ZBLAN ZNSE ZNS_IR IG3",
    "MISC": "CDS CR39 5MG448 MG452* MG463& MG523",
    "CDGM": "HWS1 HWS2 HWS27 HWS3 HWS4 HWS5 HWS6 HWS7 HWS9",
    "CORNING": "CAF2_P CAF2_P2 FS_P FS_P2",
    "NHG": "D-LAF774 H-BIF207 H-BIF210",
    "BIREFRINGENT": "AGASS3-E AGASS3 AGGAS2-E AGGAS2 AGGASE2-E AGGASE2 CDGEAS2-E CDGEAS2 CDS CDS-E CDSE CDSE-E CUGAS2 "
    "CUGAS2-E LIO3-E LIO3 TAS TAS-E TE TE-E YVO4 YVO4-E ZNGEP2-E ZNGEP2",
    "LIGHTPATH": "BD1 BD2 BD2_L",
    "RPO": "IG2 IG4 IG5 IG6",
    "UMICORE": "GASIR2 GASIR1",
    "ISUZU": "IIR-SF1",
}
#: Glasses whose listed range is wider than their polynomial holds: n rises with wavelength, or falls below 1, near an
#: end of it. The figures are the source's own; the comment of each in its catalog warns where.
RANGE_TOO_WIDE = {
    "MISC": "COC",
    "TOPAS": "5013LS-01 5013X16 6015S-04",
    "ARTON": "DX4900 F5023 F4520 D4532 D4531F D4540",
    "RPO": "EKPC IG2 IG4 IG6",
    "PLASTIC": "EP9000",
    "NHG": "H-ZLAF54 H-ZLAF72 H-ZLAF80",
}
COUNTS = {
    "SCHOTT": 366, "OHARA": 432, "HOYA": 432, "CDGM": 371, "HIKARI": 383, "SUMITA": 317, "LZOS": 54, "CORNING": 103,
    "INFRARED": 51, "MISC": 33, "HERAEUS": 5, "TOPAS": 3, "NHG": 52, "PLASTIC": 33, "ZEON": 23, "ARTON": 6,
    "LIGHTPATH": 13, "RPO": 43, "UMICORE": 2, "ISUZU": 1, "ARCHER": 15, "RAD_HARD": 7, "PILKINGTON": 33,
    "BIREFRINGENT": 62,
}  # fmt: skip
#: Glasses of no listed range.
UNRANGED = "D-LAF774", "H-BIF207", "H-BIF210"
#: Glasses whose listing is rounded by more.
COARSE = (
    "330R 480R CAFK95 EDMUND_REPLICA_POLYMER_152V52 K-CAFK95 K-CAFK95(M) K-CSK120 K-FIR100UV K-FIR100UV(M) K-LAKN5 "
    "K-LASFN21 K-PFK80 K-PFK80(M) K-PSFN1 K-PSFN1(M) K-PSFN214(M) K-VC89 K-VC91 PFK80 ZEONEX_K22R&K26R_2017 ZEONEX_K26R"
)


@pytest.fixture(autouse=True)
def no_catalogs_from_the_environment(monkeypatch):
    monkeypatch.delenv(catalogs.ENVIRONMENT, raising=False)


@pytest.fixture
def small(tmp_path):
    path = tmp_path / "small.agf"
    path.write_text(SMALL, encoding="utf-8")
    return path


# -- the shipped catalogs ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", SHIPPED)
def test_every_shipped_glass_has_its_listed_figures(name):
    """n_d within 2e-5 and V_d within 0.1 of the listing, which makers round to 5 or 6 and to 1 or 2 decimals."""
    catalog = shipped_catalog(name)
    assert len(catalog.glasses) == COUNTS[name]
    unlisted = UNLISTED.get(name, "").split()
    for listed, glass in catalog.glasses.items():
        if listed in unlisted:
            assert glass.nd_listed is None, f"{listed} has a listing now: take it off UNLISTED"
            continue
        error = float(nd(glass)) - glass.nd_listed, float(abbe_number(glass)) - glass.abbe_listed
        if glass.abbe_listed == 0.0:  # N15 of MISC: one index at every wavelength
            assert glass.coefficients.tolist()[1:] == [0.0, 0.0]
            assert error == (0.0, 0.0)
        else:
            coarse = listed in COARSE.split()  # by their makers, of fewer digits
            assert abs(error[0]) <= (4e-5 if coarse else 2e-5), (listed, error)
            assert abs(error[1]) <= (0.25 if coarse else 0.1), (listed, error)


@pytest.mark.parametrize("name", SHIPPED)
def test_every_shipped_glass_disperses_normally_in_all_of_its_range(name):
    """A transparent medium has n ≥ 1 that falls with wavelength, from one end of its range to the other."""
    for listed, glass in shipped_catalog(name).glasses.items():
        if glass.wavelength_range is None:
            assert listed in UNRANGED
            continue
        wavelengths = torch.linspace(*glass.wavelength_range, 400, dtype=torch.float64)
        n = refractive_index(glass, wavelengths)
        assert (n > 0.5).all()
        assert (n < 7.0).all()  # tellurium, the highest, reaches 6.4
        assert glass.catalog == name
        assert re.search(r"sources agree|1 source alone", glass.comment)
        if listed == "VACUUM":  # relative to air: just below 1, and rising to it
            assert ((n > 0.9997) & (n < 0.99974)).all()
            continue
        normal = bool((n >= 1.0).all() and (n[1:] <= n[:-1]).all())
        assert normal == (listed not in RANGE_TOO_WIDE.get(name, "").split()), listed
        assert normal == ("caution: n rises" not in glass.comment), listed


def test_the_files_shipped_are_those_searched():
    assert {path.stem for path in shipped_folder().glob("*.AGF")} == set(SHIPPED) == set(COUNTS)


@pytest.mark.parametrize(("name", "n"), [("SK2", 1.6110909192), ("SK16", 1.6239670970), ("F5", 1.6089032455)])
def test_the_glasses_of_the_double_gauss_at_530_nm(name, n):
    glass = find_glass(name, catalogs=["SCHOTT"])
    assert glass.catalog == "SCHOTT"
    assert index(glass, 0.530).item() == pytest.approx(n, abs=1e-9)  # an independent calculation, ten decimals


def test_obsolete_glasses_are_shipped_and_name_present_day_ones():
    for name in ("SK2", "SK16", "BK7", "F15"):
        assert find_glass(name, catalogs=["SCHOTT"]).status == "obsolete"
    assert find_glass("SK16", catalogs=["SCHOTT"]).alternatives == ("N-SK16",)


def test_no_catalog_has_names_that_differ_in_case_alone():
    for name in SHIPPED:
        listed = list(shipped_catalog(name).glasses)
        assert len({entry.upper() for entry in listed}) == len(listed)


# -- finding a glass --------------------------------------------------------------------------------------------------


def test_catalogs_are_searched_in_the_order_of_the_lens_file():
    assert find_glass("SK16", catalogs=["HIKARI", "SCHOTT"]).catalog == "HIKARI"
    assert find_glass("SK16", catalogs=["NO_SUCH", "SCHOTT", "HIKARI"]).catalog == "SCHOTT"
    assert find_glass("N-BK7", catalogs=["HIKARI"]).catalog == "SCHOTT"  # not in its own: the others, and it says so
    assert find_glass("SK16", catalogs=["nikon"]).catalog == "HIKARI"


def test_a_name_of_two_glasses_is_reported_unless_the_lens_file_decides():
    with pytest.warns(AmbiguousGlass, match=r"lens\.csv:3: SK2 .*SCHOTT.*HIKARI by 3\.\de-05"):
        assert find_glass("SK2", where="lens.csv:3").catalog == "SCHOTT"
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        find_glass("SK2", catalogs=["SCHOTT"])
        find_glass("CAF2")  # the same figures in INFRARED and MISC
        find_glass("N-BK7")


def test_capitals_and_small_letters_are_not_distinguished_and_the_name_stays_as_written():
    glass = find_glass("n-bk7hti", catalogs=["SCHOTT"])
    assert (glass.name, glass.listed_name) == ("n-bk7hti", "N-BK7HTi")


def test_nothing_else_is_taken_for_the_name():
    for name in ("NBK-7", "BK", "SK161", "N-SK", "N-BK7_", "", "AIR?", "[A-Z]+"):
        with pytest.raises(UnknownGlass):
            find_glass(name, catalogs=["SCHOTT"])


def test_unknown_glass_is_reported_with_place_and_similar_names():
    with pytest.raises(UnknownGlass) as caught:
        find_glass("N-SK161", catalogs=["SCHOTT"], where="a.zmx:31, surface 2")
    assert str(caught.value).startswith("a.zmx:31, surface 2: unknown glass 'N-SK161'")
    assert "N-SK16 (SCHOTT)" in str(caught.value)
    assert caught.value.suggestions[0] == ("N-SK16", "SCHOTT")
    assert "--catalog" in str(caught.value)


def test_suggestions_ignore_hyphens():
    for name, suggestions in (("SBSL7", (("S-BSL7", "OHARA"),)), ("§§§§§§§§", ())):
        with pytest.raises(UnknownGlass) as caught:
            find_glass(name)
        assert caught.value.suggestions[:1] == suggestions


def test_aliases_are_the_same_glass_and_hide_no_name():
    for name, alias in aliases().items():
        assert len(alias.reason) > 10
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            glass = find_glass(name)
        assert (glass.name, glass.listed_name, glass.catalog) == (name, alias.glass, alias.catalog)
        assert all(shipped_catalog(shipped).find(name) is None for shipped in SHIPPED)


def test_a_glass_comes_before_its_alias(tmp_path, small):
    own = tmp_path / "own.agf"
    own.write_text(SMALL.replace("NM ONE", "NM NBK7"))
    assert find_glass("NBK7", user=[own]).catalog == "OWN"
    assert find_glass("NBK7", user=[small]).catalog == "SCHOTT"


def test_user_catalogs_go_first_in_their_order(tmp_path, small, monkeypatch):
    other = tmp_path / "other.agf"
    other.write_text(SMALL.replace("NM ONE", "NM N-BK7").replace("NM Two", "NM ONE"))
    assert find_glass("ONE", user=[small]).catalog == "SMALL"
    assert find_glass("ONE", user=[other, small]).catalog == "OTHER"
    assert find_glass("N-BK7", catalogs=["SCHOTT"], user=[small, other]).catalog == "OTHER"
    monkeypatch.setenv(catalogs.ENVIRONMENT, os.pathsep.join([str(other), "", str(small)]))
    assert find_glass("one").catalog == "OTHER"
    assert find_glass("ONE", user=[small]).catalog == "SMALL"
    with pytest.raises(UnknownGlass, match=r"N-BK7 \(OTHER\)"):
        find_glass("N-BK77")
    assert missing_catalogs(["SCHOTT", "Small", "LACROIX"]) == ("LACROIX",)


def test_a_user_catalog_that_cannot_be_read_is_an_error(tmp_path, monkeypatch):
    with pytest.raises(CatalogError, match=r"none\.agf: cannot be read"):
        find_glass("N-BK7", user=[tmp_path / "none.agf"])
    monkeypatch.setenv(catalogs.ENVIRONMENT, str(tmp_path))
    with pytest.raises(CatalogError, match="cannot be read"):
        find_glass("N-BK7")


def test_a_user_catalog_may_be_a_shipped_one(monkeypatch, tmp_path):
    """In Python, in the environment and in the command; a folder of its name does not hide it."""
    (tmp_path / "hoya").mkdir()
    monkeypatch.chdir(tmp_path)
    assert find_glass("BSC7", user=["hoya"]).catalog == "HOYA"
    for name, expected in (("SCHOTT", {"SCHOTT"}), ("HIKARI", {"HIKARI"})):
        lens = rt.read_lens("double_gauss", catalogs=[name])
        assert {s.glass.catalog for s in lens.surfaces if s.glass.catalog} == expected
    assert rt.glass("N-BK7", catalogs=["SCHOTT"]).glass.catalog == "SCHOTT"
    with pytest.raises(CatalogError, match=r"SCHOT: no such glass catalog; .*OHARA.*did you mean SCHOTT\?"):
        rt.read_lens("tessar", catalogs=["SCHOT"])
    monkeypatch.setenv(catalogs.ENVIRONMENT, "ohara")
    assert find_glass("S-BSL7").catalog == "OHARA"


def test_a_changed_user_catalog_is_read_again(small):
    assert find_glass("ONE", user=[small]).nd_listed == 1.5168
    small.write_text(SMALL.replace("1.516800", "1.5168001"))
    assert find_glass("ONE", user=[small]).nd_listed == 1.5168001


@pytest.mark.slow
def test_one_catalog_is_parsed_for_a_glass_it_holds():
    """`raytrace info` on a lens of one maker must not wait for twenty catalogs."""
    script = (
        "from raytrace.materials import catalogs as catalog, agf\n"
        "found = []; read = catalog.read_text\n"
        "catalog.read_text = lambda path: found.append(path.stem) or read(path)\n"
        "catalog.find_glass('SK16', catalogs=['SCHOTT', 'OHARA']); print(found)"
    )
    run = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "['SCHOTT']"


# -- reading and writing AGF ------------------------------------------------------------------------------------------


def test_every_record_is_read(small):
    catalog = read_agf(small)
    one, two = catalog.glasses.values()
    assert (catalog.name, catalog.comments) == ("SMALL", ("A catalog for tests: Prüfgläser",))
    assert (one.name, one.formula, one.catalog, one.status) == ("ONE", "sellmeier_1", "SMALL", "preferred")
    assert one.coefficients.tolist() == [1.03961212, 6.00069867e-3, 0.231792344, 2.00179144e-2, 1.01046945, 103.560653]
    assert one.coefficients.dtype == torch.float64
    assert (one.nd_listed, one.abbe_listed, one.wavelength_range) == (1.5168, 64.17, (0.3, 2.5))
    assert one.alternatives == ("TWO", "THREE")
    assert one.comment.startswith("the first")
    assert dict(one.records[:3]) == {
        "ED": (7.1, 8.3, 2.51, -0.0009, 0.0),
        "TD": (1.86e-6, 1.31e-8, -1.37e-11, 4.34e-7, 6.27e-10, 0.17, 20.0),
        "OD": (1.0, 2.0, -1.0, 1.0, 2.3, -1.0),
    }
    assert one.records[3:] == (("IT", (0.3, 0.05, 25.0)), ("IT", (0.5, 0.998, 25.0)))
    assert (two.name, two.formula, two.status, two.records) == ("Two", "schott", "obsolete", ())


ENCODINGS = {
    "utf-8": "utf-8",
    "utf-8 with mark": "utf-8-sig",
    "utf-16 with mark": "utf-16",
    "utf-16-le without mark": "utf-16-le",
    "utf-16-be without mark": "utf-16-be",
    "latin-1": "latin-1",
}


@pytest.mark.parametrize("encoding", ENCODINGS.values(), ids=ENCODINGS)
@pytest.mark.parametrize("line_end", ["\n", "\r\n", "\r"], ids=["lf", "crlf", "cr"])
def test_encodings_and_line_ends(tmp_path, encoding, line_end):
    path = tmp_path / "small.agf"
    path.write_bytes(SMALL.replace("\n", line_end).encode(encoding))
    catalog = read_agf(path)
    assert catalog.comments == ("A catalog for tests: Prüfgläser",)
    assert catalog.glasses["ONE"].coefficients[-1] == 103.560653
    assert len(catalog.glasses) == 2


def same(one, other):
    return (
        all(getattr(one, field) == getattr(other, field) for field in ("name", "formula", "catalog", "status"))
        and (one.nd_listed, one.abbe_listed, one.wavelength_range, one.alternatives, one.comment, sorted(one.records))
        == (
            other.nd_listed,
            other.abbe_listed,
            other.wavelength_range,
            other.alternatives,
            other.comment,
            sorted(other.records),
        )
        and torch.equal(one.coefficients, other.coefficients)
    )


@pytest.mark.parametrize("name", ["SCHOTT", "HIKARI", "BIREFRINGENT", "MISC"])
def test_written_glasses_round_trip_bit_identically(tmp_path, name):
    original = shipped_catalog(name)
    write_agf(original, tmp_path / f"{name}.AGF")
    again = read_agf(tmp_path / f"{name}.AGF")
    assert list(again.glasses) == list(original.glasses)
    assert all(same(again.glasses[listed], glass) for listed, glass in original.glasses.items())
    assert [path.name for path in tmp_path.iterdir()] == [f"{name}.AGF"]


def test_shipped_files_are_plain_agf():
    """Another program finds a header, known keywords, ten coefficients, and a listing for every name."""
    for path in shipped_folder().glob("*.AGF"):
        lines = path.read_bytes().decode("ascii").split("\n")
        assert lines[0].startswith("CC ")
        assert {line.split(" ")[0] for line in lines[:-1]} <= {"CC", "NM", "GC", "ED", "CD", "TD", "OD", "LD", "IT"}
        for line in lines:
            if line.startswith("NM"):
                assert re.fullmatch(r"NM \S+ \d+ \d{6} \S+ \S+ 0 (-1|[0-4]) -1", line)
                assert int(line.split()[2]) in BY_NUMBER
            if line.startswith("CD"):
                assert len(line.split()) == 11


def test_glasses_that_agf_cannot_hold_are_not_written(tmp_path):
    with pytest.raises(ValueError, match="cannot be written"):
        write_agf(Catalog("X", {"A": constant(1.5, "A")}), tmp_path / "x.agf")
    with pytest.raises(ValueError, match="cannot be written"):
        write_agf(Catalog("X", {"A B": shipped_catalog("SCHOTT").glasses["BK7"]}), tmp_path / "x.agf")
    assert list(tmp_path.iterdir()) == []


BAD = {
    "empty": ("", r"bad\.agf:1: found no glass"),
    "another file": ("<!DOCTYPE html>\n<html>\n", r"bad\.agf:1: found no glass, expected an AGF catalog"),
    "cut off in the numbers": (SMALL[: SMALL.index("E-002 1.0104")], r"bad\.agf:6: found 4 coefficients for ONE, .*6"),
    "cut off before the range": (SMALL[: SMALL.index("TD")], r"bad\.agf:6: found ONE without a LD record.*cut off"),
    "cut off in a name": (SMALL[: SMALL.index(" 620603")], r"bad\.agf:14: found NM Two 1, expected NM name formula"),
    "no coefficients": (SMALL.replace("CD 2.59", "XX 2.59"), r"bad\.agf:16: found Two without a CD record"),
    "a lost name": (SMALL.replace("NM Two", "NN Two"), r"bad\.agf:15: found a second CD record for ONE.*NM line"),
    "a word for a number": (SMALL.replace("-0.01540969", "about0"), r"bad\.agf:15: found 'about0', expected a finite"),
    "not a number": (SMALL.replace("-0.01540969", "nan"), r"bad\.agf:15: found 'nan'"),
    "infinite": (SMALL.replace("-0.01540969", "1e999"), r"bad\.agf:15: found '1e999'"),
    "a decimal comma": (SMALL.replace("1.620409", "1,620409"), r"bad\.agf:14: found '1,620409'.*with a point"),
    "a formula of no manual": (SMALL.replace("NM Two 1 ", "NM Two 14 "), r"bad\.agf:14: found dispersion formula 14"),
    "half a formula": (SMALL.replace("NM Two 1 ", "NM Two 1.5 "), r"bad\.agf:14: found dispersion formula 1\.5"),
    "a range upside down": (SMALL.replace("LD 0.4 0.7", "LD 0.7 0.4"), r"bad\.agf:16: found LD 0\.7 0\.4 for Two"),
    "a range of one end": (SMALL.replace("LD 0.4 0.7", "LD 0.4"), r"bad\.agf:16: found LD 0\.4"),
    "a record of no glass": ("CC x\nCD 1 2 3\n" + SMALL, r"bad\.agf:2: found a CD record before any glass"),
}


@pytest.mark.filterwarnings("ignore::raytrace.materials.catalogs.CatalogWarning")
@pytest.mark.parametrize(("text", "message"), BAD.values(), ids=BAD)
def test_a_bad_file_gives_one_clear_error(tmp_path, text, message):
    path = tmp_path / "bad.agf"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(CatalogError, match=message):
        read_agf(path)


def test_binary_and_damaged_files(tmp_path):
    path = tmp_path / "bad.agf"
    path.write_bytes(b"NM A\nPK\x03\x04" + bytes(range(256)) * 9)
    with pytest.raises(CatalogError, match=r"bad\.agf:2: .*byte 0x03"):
        read_agf(path)
    path.write_bytes(SMALL.encode("utf-16")[:501])
    with pytest.raises(CatalogError, match=r"damaged UTF-16 text.*cut off"):
        read_agf(path)


def test_a_file_too_large_is_refused_before_it_is_read(tmp_path):
    path = tmp_path / "huge.agf"
    with path.open("wb") as file:
        file.truncate(200 * 2**20)  # a sparse file: no disk is used
    with pytest.raises(CatalogError, match="larger than 16 MB"):
        read_agf(path)


def test_ignored_data_are_reported(tmp_path):
    path = tmp_path / "odd.agf"
    path.write_text(SMALL + "QX 1 2 3\n")
    with pytest.warns(CatalogWarning, match=r"odd\.agf: .*'QX' \(line 17\)"):
        assert len(read_agf(path).glasses) == 2
    path.write_text(SMALL.replace("NM Two", "NM ONE"))
    with pytest.warns(CatalogWarning, match=r"odd\.agf:14: ONE .*again; the first"):
        assert read_agf(path).glasses["ONE"].nd_listed == 1.5168


def test_the_edition_of_a_glass_is_reported(tmp_path):
    """By the sources of a shipped glass, by the comment of a user's one; and where a newer edition is in use."""
    assert re.match(r"date not stated; \d+ sources agree: .*SCHOTT", catalogs.edition(find_glass("N-BK7"))[0])
    for (catalog, name), (newer, _) in catalogs.OLDER_EDITIONS.items():
        edition = catalogs.edition(find_glass(name, catalogs=[catalog]))
        assert newer in edition[-1]
    assert len(catalogs.edition(find_glass("H-K9L"))) == 1
    own = tmp_path / "OWN.AGF"
    own.write_text("NM MINE 1 517642 1.5 60 0 1\nGC melt of March\nCD 2.25 0 0 0 0 0 0 0 0 0\nLD 0.4 0.7\n")
    assert catalogs.edition(find_glass("MINE", user=[own])) == ("OWN: melt of March",)
    assert catalogs.edition(catalogs.Glass("", "constant", torch.ones(1))) == ()


def test_a_range_of_zeros_is_no_range():
    assert parse_agf(SMALL.replace("LD 0.4 0.7", "LD 0 0"), "x.agf").glasses["Two"].wavelength_range is None


def mutate(content: bytes, seed: int) -> bytes:
    """A few edits of the kind that damage files: bytes changed, cut out, doubled, lines swapped, the end lost."""
    draw = random.Random(seed)
    changed = bytearray(content)
    for _ in range(draw.randint(1, 6)):
        at, length = draw.randrange(len(changed) + 1), draw.randint(1, 40)
        kind = draw.randrange(6)
        if kind == 0:
            changed[at : at + 1] = bytes([draw.randrange(256)])
        elif kind == 1:
            del changed[at : at + length]
        elif kind == 2:
            changed[at:at] = changed[at : at + length]
        elif kind == 3:
            changed[at:at] = draw.choice([b"\n", b"\0", b" nan ", b"1e400", b"\xff\xfe", b"NM ", b"CD ", b"-", b"\t"])
        elif kind == 4:
            lines = changed.split(b"\n")
            draw.shuffle(lines)
            changed = bytearray(b"\n".join(lines[: draw.randint(1, len(lines))]))
        else:
            del changed[at:]
    return bytes(changed)


@pytest.mark.parametrize("examples", [75, *(pytest.param(n, marks=pytest.mark.slow) for n in (300, 1500))])
def test_a_damaged_file_is_a_catalog_or_a_catalog_error(examples, tmp_path):
    path = tmp_path / "damaged.agf"

    def read_one(seed, encoding):
        path.write_bytes(mutate(SMALL.encode(encoding), seed))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", CatalogWarning)
            try:
                catalog = read_agf(path)
            except CatalogError:
                return
        assert catalog.glasses
        for glass in catalog.glasses.values():
            assert torch.isfinite(glass.coefficients).all()
            assert glass.wavelength_range is None or 0 < glass.wavelength_range[0] < glass.wavelength_range[1]
        again = parse_agf(format_agf(catalog), path)
        assert all(same(again.glasses[name], glass) for name, glass in catalog.glasses.items())

    for_examples(
        examples, read_one, seed=st.integers(0, 2**32), encoding=st.sampled_from(["utf-8", "utf-16", "latin-1"])
    )


def test_the_figures_of_a_glass_are_text_document_and_table():
    found = rt.glass("SK16", wavelengths=[0.53, 0.6])
    indices = refractive_index(find_glass("SK16"), torch.tensor([0.53, 0.6], dtype=torch.float64))
    assert found.document()["indices"] == indices.tolist()
    assert found.to_frame()["index"].tolist() == indices.tolist()
    assert re.search(rf"^ +0.53 +{float(indices[0]):.10f} +0.9956$", str(found), re.M)
    assert rt.glass("517642").document()["catalog"] is None
    assert str(rt.glass("517642")).startswith("517642  (MIL code)")
    with pytest.raises(ValueError, match=r"did you mean 0\.53"):
        rt.glass("SK16", wavelengths=530)


def test_the_nearest_glasses_of_a_vendor_come_in_order_of_their_distance_in_nd_and_vd():
    found = nearest_glasses("N-SK16", catalogs=["OHARA"], count=400)
    assert {glass.catalog for glass in found} == {"OHARA"}
    assert found[0].name == "S-BSM16"  # OHARA's own equivalent
    sk16 = find_glass("N-SK16")
    distances = [
        math.hypot(glass.nd_listed - sk16.nd_listed, (glass.abbe_listed - sk16.abbe_listed) / 100) for glass in found
    ]
    assert distances == sorted(distances)
    assert [glass.name for glass in nearest_glasses((1.6204, 60.32), catalogs=["ohara"], count=1)] == ["S-BSM16"]
    assert "N-SK16" not in [glass.name for glass in nearest_glasses(sk16, catalogs=["SCHOTT"])]
    assert len(nearest_glasses("N-BK7")) == 5


def test_what_has_no_nd_and_vd_has_no_nearest_glass():
    with pytest.raises(ValueError, match="has no nd and Vd; give a pair"):
        nearest_glasses(constant(1.5))
    with pytest.raises(ValueError, match="a mirror has no refractive index"):
        nearest_glasses(MIRROR)
    with pytest.raises(CatalogError, match=r"'OHARRA' .*SCHOTT, OHARA"):
        nearest_glasses("N-BK7", catalogs=["OHARRA"])


# -- figures beside the dispersion ------------------------------------------------------------------------------------

#: Of public sources, by catalog and glass: expansion from -30 to 70 °C and from 20 to 300 °C, 1e-6/K (that of FL6 is
#: stated in 1e-7/K), density, relative price, and two rows of wavelength and internal transmittance of 10 mm.
FIGURES = {
    ("SCHOTT", "N-BK7"): (7.1, 8.3, 2.51, 1.0, [(0.37, 0.99074), (2.5, 0.66454)]),
    ("SCHOTT", "SF6"): (8.1, 9.0, 5.18, 2.5, [(0.405, 0.93264), (2.5, 0.88653)]),
    ("SCHOTT", "N-FK56"): (None, 16.2, 3.54, 25.42, [(0.35, 0.967), (1.97, 0.992)]),
    ("OHARA", "S-BAH54"): (6.6, 8.1, 3.3, None, [(0.37, 0.87), (0.7, 0.998)]),
    ("OHARA", "S-NPH5"): (7.6, None, 3.71, 3.3, [(0.44, 0.949), (2.4, 0.915)]),
    ("HOYA", "E-FD2"): (8.8, 10.9, 2.77, None, [(0.46, 0.986), (1.55, 0.995)]),
    ("HOYA", "FL6"): (7.9, 9.0, 3.12, None, [(0.36, 0.975), (0.7, 0.999)]),
    ("CDGM", "D-LAF50"): (7.3, 8.9, 4.93, 15.6, [(0.38, 0.955), (2.4, 0.792)]),
    ("CDGM", "F6"): (9.8, 11.6, 3.6, 2.5, [(0.39, 0.977), (2.4, 0.76)]),
    ("HIKARI", "E-SK4"): (7.2, None, 3.54, None, [(0.36, 0.94), (2.4, 0.848)]),
    ("HIKARI", "SK18"): (8.1, None, 3.69, None, [(0.37, 0.8), (0.7, 1.0)]),
    ("SUMITA", "K-VC179(M)"): (6.1, 8.0, 4.65, None, [(0.37, 0.60487), (2.0, 0.91593)]),
    ("LZOS", "LZ_LK3"): (9.2, None, 2.46, None, [(0.44, 0.993), (1.5, 0.994)]),
    ("CORNING", "C79-80"): (0.52, 0.57, 2.201, None, []),
    ("INFRARED", "CSBR"): (47.2, None, 4.488, None, []),
    ("LIGHTPATH", "PBH71"): (8.9, 10.1, 6.05, 2.0, [(0.44, 0.962), (2.4, 0.918)]),
    ("RPO", "N-LAK22_MOLD"): (6.6, 7.4, 3.768, 3.5, [(0.38, 0.9672), (2.5, 0.67186)]),
    ("ARTON", "DX4900"): (75.0, None, 1.08, None, []),
    ("ZEON", "E48R"): (60.0, None, 1.01, None, [(0.5, 1.0), (1.6, 0.83694)]),
    ("MISC", "PMMA"): (None, None, 1.16, None, []),
}
#: Fields that are None where the catalog lists nothing.
NOT_LISTED = "expansion", "expansion_20_300", "density", "relative_price"


@pytest.mark.parametrize(("catalog", "name"), FIGURES)
def test_figures_are_those_of_the_sources(catalog, name):
    *figures, rows = FIGURES[catalog, name]
    glass = find_glass(name, catalogs=[catalog])
    assert [glass.expansion, glass.expansion_20_300, glass.density, glass.relative_price] == figures
    assert {(wavelength, τ, 10.0) for wavelength, τ in rows} <= {*glass.transmittance}
    assert bool(glass.transmittance) == bool(rows)
    for wavelength, τ in rows:
        assert float(internal_transmittance(glass, wavelength)) == pytest.approx(τ, rel=1e-12)
        assert float(internal_transmittance(glass, wavelength, 25.0)) == pytest.approx(τ**2.5, rel=1e-12)


@pytest.mark.parametrize("name", SHIPPED)
def test_figures_are_possible(name):
    """Expansion in 1e-6/K, not 1e-7; no figure that states nothing: a density of 1, a transmittance of 1 everywhere."""
    for listed, glass in shipped_catalog(name).glasses.items():
        assert 0.3 < (glass.expansion or 1) < 100, listed
        assert 0.3 < (glass.expansion_20_300 or 1) <= max(25, 3 * (glass.expansion or 0)), listed
        assert 0.9 < (glass.density or 2) < 8, listed
        assert glass.density != 1
        assert 0 < (glass.relative_price or 1) <= 100, listed
        wavelengths, *others = zip(*glass.transmittance, strict=True) if glass.transmittance else ((), (), ())
        assert list(wavelengths) == sorted({*wavelengths}), listed
        assert all(0 <= τ <= 1 for τ in others[0]), listed
        assert {*others[0]} != {1.0}, listed
        assert {*others[1]} <= {10.0}


@pytest.mark.parametrize(
    ("name", "index_d", "abbe", "source"),
    [
        ("EP5000", 1.636164, 23.916758, "1 source alone"),
        ("OKP4", 1.607283, 26.645105, "1 source alone"),
        ("APL5014CL", 1.544489, 56.344933, "1 source alone"),
        ("D-ZLAF814", 1.814741, 37.027807, "1 source alone"),
        ("K-CD35", 1.58050, 34.8, "1 source alone"),
        ("H-LAK67", 1.670000, 51.70, "2 sources agree"),
        ("NIFS-S", 1.458477, 67.826411, "3 sources agree"),
        ("N-LASF55", 1.9538, 30.56, "2 sources agree"),
        ("BSC517642B", 1.516803, 64.133327, "1 source alone"),
        ("HPFS_7980", 1.458461, 67.80, "1 source alone"),
    ],
)
def test_glasses_of_phones_and_of_new_catalogs_are_shipped(name, index_d, abbe, source):
    """With the number of their sources; one alone is stated."""
    glass = find_glass(name)
    assert abs(float(abbe_number(glass)) - glass.abbe_listed) < 0.06
    assert float(refractive_index(glass, 0.5875618)) == pytest.approx(index_d, abs=2e-5)
    assert glass.abbe_listed == pytest.approx(abbe, abs=0.1)
    assert source in " ".join(catalogs.edition(glass))


def test_a_figure_that_is_not_listed_is_none_and_said(small):
    """AGF writes 0 and -1 for it."""
    one, two = (find_glass(name, user=[small]) for name in ("ONE", "Two"))
    assert (one.expansion, one.expansion_20_300, one.density, one.relative_price) == (7.1, 8.3, 2.51, 1.0)
    assert one.transmittance == ((0.3, 0.05, 25.0), (0.5, 0.998, 25.0))
    assert float(internal_transmittance(one, 0.5)) == pytest.approx(0.998**0.4, rel=1e-12)
    assert all(getattr(two, name) is None for name in NOT_LISTED)
    assert two.transmittance == ()
    assert math.isnan(float(internal_transmittance(two, 0.5)))
    shown = rt.glass("OKP4")
    for title in ("expansion", "density", "price", "transmittance"):
        assert re.search(rf"^  {title} +not listed$", str(shown), re.M)
    document = shown.document()
    assert [document[name] for name in (*NOT_LISTED, "transmittance")] == [None] * 4 + [[None] * 3]
    listed = rt.glass("N-BK7", wavelengths=[0.334, 0.5876])
    assert "expansion      7.1·10⁻⁶/K from −30 to 70 °C, 8.3·10⁻⁶/K from 20 to 300 °C" in str(listed)
    assert listed.document()["transmittance"][0] == pytest.approx(0.90539, rel=1e-12)


def test_internal_transmittance_between_listed_wavelengths_is_differentiable():
    """The absorption is linear there: at the mean wavelength τ is the geometric mean; nan beyond the table."""
    bk7 = find_glass("N-BK7")
    (first, τ_first, _), (second, τ_second, _) = bk7.transmittance[:2]
    middle = internal_transmittance(bk7, 0.5 * (first + second))
    assert float(middle) == pytest.approx(math.sqrt(τ_first * τ_second), rel=1e-12)
    assert torch.isnan(internal_transmittance(bk7, torch.tensor([0.29, 2.6], dtype=torch.float64))).all()
    at = [torch.tensor(numbers, dtype=torch.float64, requires_grad=True) for numbers in ([0.352, 0.61], [3.0, 7.0])]
    assert torch.autograd.gradcheck(lambda w, t: internal_transmittance(bk7, w, t), at)
    assert torch.autograd.gradgradcheck(lambda w, t: internal_transmittance(bk7, w, t), at)


def test_a_text_without_a_glass_is_refused():
    """A damaged catalog of an archive, too, whose glasses are read when they are asked for."""
    for read in (agf.listed, parse_agf):
        with pytest.raises(CatalogError, match=r"no glass.*NM record"):
            read("CC figures of a vendor\nNI BK7 2 517642\n", "vendor.agf")
