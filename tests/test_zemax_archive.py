"""Archives of OpticStudio (.zar), and glass catalogs of a lens: in its archive, or in its folder."""

import json
from pathlib import Path

import pytest
import torch
from problems_zemax import SMALL, archive, bits, header, lzw
from problems_zemax import file as singlet

from raytrace import check
from raytrace.cli import main
from raytrace.io import LensFileError, convert, read_lens, read_lens_with_report
from raytrace.io.source import MAX_BYTES, Place
from raytrace.io.zemax import archive as zemax_archive
from raytrace.io.zemax.archive import Member, members, unpacked
from raytrace.materials.agf import MOST_GLASSES, CatalogError, format_agf, listed, parse_agf
from raytrace.materials.catalogs import ENVIRONMENT, UnknownGlass, find_glass, shipped_catalog
from raytrace.materials.glass import index

PLACE = Place("lens.zar")
#: A catalog of one glass, N-BK7 by name, with other figures: those of SF6.
OWN = next(part for part in format_agf(shipped_catalog("SCHOTT")).split("\nNM ") if part.startswith("N-SF6 "))
OWN = f"CC other figures\nNM {OWN.replace('N-SF6', 'N-BK7', 1)}\n"


@pytest.fixture(autouse=True)
def no_catalogs_from_the_environment(monkeypatch):
    monkeypatch.delenv(ENVIRONMENT, raising=False)


# -- a packer of our own ----------------------------------------------------------------------------------------------


def written(folder: Path, files: dict, name: str = "lens.zar", **kind) -> Path:
    path = folder / name
    path.write_bytes(archive(files, **kind))
    return path


# -- members ----------------------------------------------------------------------------------------------------------


def test_the_codes_of_the_literature_are_unpacked():
    """The example of LZW that every text book of it has, of 16 codes (Rosetta Code, LZW compression)."""
    codes = [84, 79, 66, 69, 79, 82, 78, 79, 84, 256, 258, 260, 265, 259, 261, 263]
    member = Member("text", True, memoryview(bits(codes)))
    assert unpacked(member, 100, PLACE) == b"TOBEORNOTTOBEORTOBEORNOT"


@pytest.mark.parametrize("size", [0, 1, 2, 255, 3_000, 200_000])
def test_bytes_round_trip(size):
    """Beyond 512, 1024, … words, where codes grow by a bit."""
    for content in (
        bytes(torch.randint(0, 256, (size,), generator=torch.Generator().manual_seed(1)).tolist()),
        bytes(size),
        (b"abcab" * size)[:size],
    ):
        assert unpacked(Member("text", True, memoryview(lzw(content))), size, PLACE) == content


@pytest.mark.parametrize("version", [0xEA, 0xEC])
@pytest.mark.parametrize("packed", [True, False])
def test_members_are_in_order_with_their_names(version, packed):
    files = {"LENS.ZMX": b"one", "Prüf glas.agf": b"two two two", "empty.cfg": b""}
    found = members(archive(files, version, packed), PLACE)
    assert [member.name for member in found] == list(files)
    assert [unpacked(member, 99, PLACE) for member in found] == list(files.values())


@pytest.mark.parametrize("name", ["../../etc/LENS.ZMX", "C:\\Zemax\\LENS.ZMX", "/LENS.ZMX"])
def test_a_name_is_no_path(name, tmp_path):
    lens, report = read_lens_with_report(written(tmp_path, {name: singlet()}))
    assert lens.name == "A singlet"
    assert report.keywords[0].name == "member LENS.ZMX"
    assert [path.name for path in tmp_path.iterdir()] == ["lens.zar"]


def test_a_name_that_cannot_be_printed_is_shown_marked(tmp_path):
    _, report = read_lens_with_report(written(tmp_path, {"LENS.ZMX": singlet(), "a\n\x1b[31m.cfg": b""}))
    assert report.keywords[1].name == "member a??[31m.cfg"


# -- the lens ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("version", [0xEA, 0xEC])
@pytest.mark.parametrize("packed", [True, False])
def test_the_lens_of_an_archive_is_the_lens_of_its_file(version, packed, tmp_path):
    path = written(tmp_path, {"A.CFG": b"1", "LENS.ZMX": singlet(), "A.STP": b"2"}, version=version, packed=packed)
    (tmp_path / "lens.zmx").write_text(singlet())
    assert str(read_lens(path)) == str(read_lens(tmp_path / "lens.zmx"))


def test_every_member_is_listed(tmp_path, capsys):
    files = {
        "LENS.ZMX": singlet(GCAT="GCAT ACME SCHOTT"),
        "OTHER.ZMX": singlet(),
        "ACME.AGF": SMALL,
        "EXTRA.AGF": SMALL,
    }
    files |= {"LENS.CFG": b"", "NOTES.XYZ": b""}
    path = written(tmp_path, files)
    report = check(path)
    statuses = {one.name.removeprefix("member "): one.status for one in report.keywords if one.name.startswith("mem")}
    ignored = dict.fromkeys(("OTHER.ZMX", "EXTRA.AGF", "LENS.CFG"), "ignored")
    assert statuses == {"LENS.ZMX": "read", "ACME.AGF": "read", **ignored, "NOTES.XYZ": "unknown"}
    assert all(one.reason for one in report.keywords if one.status == "ignored")
    assert report.format == "zar"
    assert [warning for warning in report.warnings if "member" in warning] == [
        f"{path}: unknown member NOTES.XYZ: left out"
    ]
    assert main(["check", str(path)]) == 0
    printed = capsys.readouterr().out
    assert "member LENS.CFG: settings of the program" in printed
    with pytest.raises(LensFileError, match="unknown member NOTES"):
        check(path, strict=True)


def test_info_of_an_archive_is_that_of_its_lens(tmp_path, capsys):
    path, beside = written(tmp_path, {"LENS.ZMX": singlet()}), tmp_path / "lens.zmx"
    beside.write_text(singlet())
    found = []
    for one in (path, beside):
        assert main(["info", str(one), "--json"]) == 0
        found.append({**json.loads(capsys.readouterr().out), "lens": ""})
    assert found[0] == found[1]


def test_an_archive_is_not_written(tmp_path):
    with pytest.raises(LensFileError, match=r"\.zar .*not written; expected .*\.zmx"):
        convert("double_gauss", tmp_path / "lens.zar")


def test_errors_of_the_lens_name_archive_member_and_line(tmp_path):
    path = written(tmp_path, {"A.ZMX": singlet(surface="CONI x")})
    with pytest.raises(LensFileError, match=r"lens\.zar \(A\.ZMX\):23, surface 1: .*'x'"):
        read_lens(path)


# -- damaged and hostile ----------------------------------------------------------------------------------------------


def test_an_archive_without_a_lens_lists_its_members(tmp_path):
    with pytest.raises(LensFileError, match=r"no lens .* 2 members \(A\.CFG, B\.AGF\)"):
        read_lens(written(tmp_path, {"A.CFG": b"", "B.AGF": SMALL}))
    with pytest.raises(LensFileError, match=r"2 lenses \(A\.ZMX, B\.ZMX\)"):
        read_lens(written(tmp_path, {"A.ZMX": singlet(), "B.ZMX": singlet()}))


def test_a_bomb_is_refused_before_it_is_large(tmp_path):
    """A word longer than all before it with every code: 8 kB would unpack to a gigabyte."""
    bomb = bits([0, *range(256, 256 + 46_000)])
    assert len(bomb) < 100_000
    path = tmp_path / "lens.zar"
    path.write_bytes(header("LENS.ZMX.LZW", len(bomb), 0xEC) + bomb)
    with pytest.raises(LensFileError, match=f"'LENS.ZMX' holds more than {MAX_BYTES / 1e6:.0f} MB"):
        read_lens(path)
    stored = bytes(MAX_BYTES + 1)
    path.write_bytes(header("LENS.ZMX", len(stored), 0xEC) + stored)
    with pytest.raises(LensFileError, match="holds more than"):
        read_lens(path)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "no lens"),
        (b"PK\x03\x04 a zip", "member 0 begins with 50 4b at byte 0, expected ea or ec"),
        (header("LENS.ZMX", 10, 0xEC)[:200], "cut off"),
        (header("LENS.ZMX", 10, 0xEC) + b"123", "has 10 bytes, but 3 follow"),
        (header("LENS.ZMX", 2**63, 0xEC) + b"123", "has 9223372036854775808 bytes, but 3 follow"),
        (header("LENS.ZMX.LZW", 4, 0xEC) + b"\xff\xff\xff\xff", "code 511 of a dictionary of 256 words"),
        (header("A", 0, 0xEA) * 1001, "more than 1000 members"),
    ],
)
def test_a_damaged_archive_is_refused(content, message, tmp_path):
    path = tmp_path / "lens.zar"
    path.write_bytes(content)
    with pytest.raises(LensFileError, match=message):
        read_lens(path)


# -- catalogs that come with the lens ---------------------------------------------------------------------------------

ACME = SMALL.replace("NM ONE ", "NM ACME-1 ")


def lens_file(folder: Path, suffix: str, glass: str = "ACME-1", catalogs: str = "ACME") -> Path:
    """The singlet as a lens file of a format that names its catalogs."""
    if suffix == ".zar":
        return written(folder, {"LENS.ZMX": singlet(GCAT=f"GCAT {catalogs}").replace("N-BK7", glass)})
    path = folder / f"lens{suffix}"
    if suffix == ".csv":
        path.write_text(f"# catalogs: {catalogs}\n# stop: 1\nradius,thickness,glass\n50,4,{glass}\n-50,47.5,\n")
    else:
        path.write_text(singlet(GCAT=f"GCAT {catalogs}").replace("N-BK7", glass))
    return path


def first(lens) -> object:
    return next(surface.glass for surface in lens.surfaces if surface.glass.name)


@pytest.mark.parametrize("name", ["ACME.AGF", "acme.agf", "Acme.Agf"])
@pytest.mark.parametrize("suffix", [".zmx", ".csv"])
def test_a_catalog_in_the_folder_of_the_lens_is_found(suffix, name, tmp_path):
    path = lens_file(tmp_path, suffix)
    with pytest.raises(UnknownGlass, match="ACME-1"):
        read_lens(path)
    (tmp_path / name).write_text(ACME)
    lens, report = read_lens_with_report(path)
    assert first(lens).catalog == "ACME"
    assert f"catalog ACME: {name} in the folder of the lens" in report.notes
    assert not any("not shipped" in note for note in report.notes)


def test_a_catalog_of_the_archive_is_found_by_itself(tmp_path):
    text = singlet(GCAT="GCAT ACME").replace("N-BK7", "ACME-1")
    lens, report = read_lens_with_report(written(tmp_path, {"ACME.AGF": ACME, "LENS.ZMX": text}))
    assert first(lens).catalog == "ACME"
    assert "catalog ACME: ACME.AGF of the archive" in report.notes
    (tmp_path / "ACME.AGF").write_text(ACME)  # a catalog in the folder of an archive is not that of the archive
    with pytest.raises(UnknownGlass):
        read_lens(written(tmp_path, {"LENS.ZMX": text}))


@pytest.mark.parametrize("suffix", [".zmx", ".csv"])
def test_a_catalog_that_the_lens_does_not_name_is_not_used(suffix, tmp_path):
    (tmp_path / "ACME.AGF").write_text(ACME)
    with pytest.raises(UnknownGlass):
        read_lens(lens_file(tmp_path, suffix, catalogs="SCHOTT"))


def test_the_catalog_of_the_lens_overrides_the_shipped_one_and_is_reported(tmp_path):
    path = lens_file(tmp_path, ".zmx", "N-BK7", "SCHOTT")
    (tmp_path / "schott.agf").write_text(OWN)
    lens, report = read_lens_with_report(path)
    assert float(index(first(lens), 0.5875618)) == float(index(find_glass("N-SF6"), 0.5875618))
    assert "catalog SCHOTT: schott.agf in the folder of the lens, which precedes the shipped one" in report.notes
    (warning,) = report.warnings
    assert "surface 1: N-BK7 is that of the SCHOTT that came with the lens; its index differs" in warning
    with pytest.raises(LensFileError, match="its index differs"):
        read_lens(path, strict=True)
    (tmp_path / "schott.agf").write_text(format_agf(shipped_catalog("SCHOTT")))
    assert read_lens_with_report(path)[1].warnings == ()  # the same figures: nothing to warn of


def test_the_order_of_the_lens_file_holds_for_catalogs_that_came_with_it(tmp_path):
    (tmp_path / "ACME.AGF").write_text(OWN)
    assert first(read_lens(lens_file(tmp_path, ".zmx", "N-BK7", "SCHOTT ACME"))).catalog == "SCHOTT"
    assert first(read_lens(lens_file(tmp_path, ".zmx", "N-BK7", "ACME SCHOTT"))).catalog == "ACME"


def test_a_given_catalog_overrides_that_in_the_folder_of_the_lens(tmp_path, monkeypatch):
    given = tmp_path / "given"
    given.mkdir()
    (given / "ACME.AGF").write_text(ACME.replace("CD 1.03961212", "CD 1.05961212"))
    (tmp_path / "ACME.AGF").write_text(OWN.replace("N-BK7", "ACME-1"))
    path = lens_file(tmp_path, ".zmx")
    beside = float(index(first(read_lens(path)), 0.55))
    stated = float(index(first(read_lens(path, catalogs=[given / "ACME.AGF"])), 0.55))
    assert beside != stated
    assert not any("beside" in note for note in read_lens_with_report(path, catalogs=[given / "ACME.AGF"])[1].notes)
    monkeypatch.setenv(ENVIRONMENT, str(given / "ACME.AGF"))
    assert float(index(first(read_lens(path)), 0.55)) == stated


def test_a_damaged_catalog_in_the_folder_of_the_lens_is_reported(tmp_path):
    (tmp_path / "SCHOTT.AGF").write_text("NM N-BK7 2\n")
    path = lens_file(tmp_path, ".zmx", "N-BK7", "SCHOTT")
    lens, report = read_lens_with_report(path)
    assert first(lens).catalog == "SCHOTT"
    assert "the catalog SCHOTT that came with the lens is left out" in report.warnings[0]
    with pytest.raises(LensFileError, match="is left out"):
        read_lens(path, strict=True)


@pytest.mark.parametrize("name", ["..", "../ACME", "/ACME", ".", "a\\..\\ACME"])
def test_the_name_of_a_catalog_is_no_path(name, tmp_path):
    folder = tmp_path / "folder"
    folder.mkdir()
    (tmp_path / "ACME.AGF").write_text(ACME)
    with pytest.raises(UnknownGlass):
        read_lens(lens_file(folder, ".zmx", catalogs=name))


def test_a_lens_is_written_with_its_catalog_and_read_again(tmp_path):
    (tmp_path / "SCHOTT.AGF").write_text(OWN)
    path = lens_file(tmp_path, ".zmx", "N-BK7", "SCHOTT")
    with pytest.warns(UserWarning, match="its index differs"):
        convert(path, tmp_path / "again.csv")
    with pytest.warns(UserWarning, match="its index differs"):
        again = read_lens(tmp_path / "again.csv")
    assert torch.equal(first(again).coefficients, first(read_lens_with_report(path)[0]).coefficients)
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    with (
        pytest.warns(UserWarning, match="its index differs"),
        pytest.raises(LensFileError, match="catalog into the folder of the file"),
    ):
        convert(path, elsewhere / "again.zmx")
    assert not any(elsewhere.iterdir())


def test_many_large_catalogs_are_bounded_together_and_parsed_where_glasses_are_asked_for(tmp_path, monkeypatch):
    """22 catalogs of an archive, each with a damaged glass that the lens does not name, and more than their bound."""
    monkeypatch.setattr(zemax_archive, "MAX_CATALOGS", 20_000)
    filler = "NM BROKEN 2\n" + "GC a comment\n" * 100
    files = {f"C{k}.AGF": f"{ACME.replace('ACME-1', f'ACME-{k}')}{filler}".encode() for k in range(22)}
    files["LENS.ZMX"] = singlet(GCAT=f"GCAT {' '.join(f'C{k}' for k in range(22))}").replace("N-BK7", "ACME-3").encode()
    lens, report = read_lens_with_report(written(tmp_path, files))
    assert first(lens).catalog == "C3"
    size = len(files["C0.AGF"])
    beyond = [warning for warning in report.warnings if "the catalogs of the archive hold more than 0 MB" in warning]
    assert len(beyond) == len(report.warnings) == 22 - 20_000 // size


def test_a_catalog_of_too_many_glasses_is_refused():
    text = "".join(f"NM G{k} 2 0 1.5 60\n" for k in range(MOST_GLASSES + 1))
    for read in (parse_agf, listed):
        with pytest.raises(CatalogError, match=f"{MOST_GLASSES + 1} glasses"):
            read(text, "many.agf")


def test_a_glass_is_parsed_when_it_is_asked_for_as_with_all_others():
    text = format_agf(shipped_catalog("SCHOTT"))
    eager, found = parse_agf(text, "SCHOTT.AGF"), listed(text.replace("\n", "\r\n"), "SCHOTT.AGF")
    assert list(found.glasses) == list(eager.glasses)
    for name in ("N-BK7", "n-sf5", "SF6"):
        one, other = found.find(name), eager.find(name)
        assert one.coefficients.equal(other.coefficients)
        assert (one.name, one.records, one.wavelength_range) == (other.name, other.records, other.wavelength_range)
    with pytest.raises(CatalogError, match=r"CAT.AGF:3: found NM TWO 2"):
        listed("NM ONE 2\nCD 1\nNM TWO 2\n", "CAT.AGF").find("TWO")
