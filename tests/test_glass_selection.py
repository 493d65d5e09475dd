"""Selections of glasses: statuses, limits and left-out glasses, compared with the lines of the catalogs' files."""

import json
import re

import pytest
import torch

import raytrace as rt
from raytrace.cli import main
from raytrace.materials.agf import parse_agf
from raytrace.materials.catalogs import shipped_catalog, shipped_file
from raytrace.materials.selection import BadSelection, Selection, is_radiation_hard

GLASS = """NM {name} 2 517642 1.5168 64.17 0 {status} -1
CD 1.03961212 0.00600069867 0.231792344 0.0200179144 1.01046945 103.560653
OD {figures}
LD 0.3 2.5
"""
#: Price and classes, those of BK first; unknown ones as catalogs write them, -1 and 0.
FIGURES = {
    "BK": "1.0 1 0 1 2.3 2.3",
    "WEAK": "3.5 3 4 52.2 2.3 3.3",
    "BARE": "-1 -1 -1 -1 -1 -1",
    "NULL": "2 0 0 0 0 0",
}


@pytest.fixture(scope="module")
def resistant():
    """A catalog that lists classes of resistance."""
    blocks = [GLASS.format(name=name, status=k, figures=FIGURES[name]) for k, name in enumerate(FIGURES)]
    return parse_agf("".join(blocks), "own.agf")


def names(listing):
    return {glass.name for glass in listing.glasses}


def lines_of(catalog):
    """Name -> (status number, relative price, IT lines) by the text of the file."""
    text, blocks = shipped_file(catalog).read_text("utf-8"), {}
    for block in re.split(r"^NM ", text, flags=re.MULTILINE)[1:]:
        words = block.split("\n", 1)[0].split()
        price = re.search(r"^OD (\S+)", block, re.MULTILINE)
        passed = re.findall(r"^IT (\S+) (\S+) (\S+)", block, re.MULTILINE)
        blocks[words[0]] = words[6], float(price[1]) if price else -1.0, passed
    return blocks


@pytest.mark.parametrize("catalog", ["SCHOTT", "OHARA"])
def test_statuses_and_prices_are_those_of_the_file(catalog):
    lines = lines_of(catalog)
    hard = {name for name in lines if re.search(r"\dG\d\d$", name)}
    current = {name for name, (status, *_) in lines.items() if status not in "234"} - hard
    assert names(rt.glasses(catalogs=[catalog])) == current
    cheap = {name for name, (status, price, _) in lines.items() if status == "1" and 0 < price <= 2} - hard
    assert names(rt.glasses("preferred price<=2", catalogs=[catalog])) == cheap
    assert names(rt.glasses("any", catalogs=[catalog])) == {*lines}
    assert (
        names(rt.glasses("obsolete", catalogs=[catalog])) == {n for n, line in lines.items() if line[0] == "2"} - hard
    )


def test_transmittance_is_that_of_the_file_at_a_listed_wavelength():
    passing = names(rt.glasses("any transmittance:0.46>=0.99", catalogs=["SCHOTT"]))
    listed = {
        name: [float(τ) for wavelength, τ, depth in rows if (float(wavelength), float(depth)) == (0.46, 10)]
        for name, (*_, rows) in lines_of("SCHOTT").items()
    }
    assert {name for name, τ in listed.items() if τ and τ[0] >= 0.99} == {name for name in passing if listed[name]}
    assert "SF6" in passing  # 0.99114
    assert "SF6G05" not in passing  # 0.36411


def test_glasses_cover_the_wavelengths():
    listing = rt.glasses("any", catalogs=["SCHOTT"], wavelengths=torch.tensor([0.4, 2.0]))
    ranges = {name: glass.wavelength_range for name, glass in shipped_catalog("SCHOTT").glasses.items()}
    assert names(listing) == {name for name, (shortest, longest) in ranges.items() if shortest <= 0.4 and longest >= 2}
    assert dict(listing.left_out) == {"outside the wavelengths": 366 - len(listing.glasses)}


def test_radiation_hard_glasses_are_selected_by_a_word():
    """SCHOTT's of a status; all of RAD_HARD, which holds no others."""
    schott = shipped_catalog("SCHOTT").glasses
    hard = {"BK7G18", "F2G12", "K5G20", "LAK9G15", "LF5G19", "SF6G05", "LF5G15"}
    assert {name for name, glass in schott.items() if is_radiation_hard(glass)} == hard
    without, including = (
        names(rt.glasses(words, catalogs=["SCHOTT"])) for words in ("preferred", "preferred radiation_hard")
    )
    assert including - without == hard - {"LF5G15"}  # obsolete
    assert len(rt.glasses(catalogs=["RAD_HARD"]).glasses) == 7
    others = [glass for name in ("OHARA", "HOYA", "CDGM") for glass in shipped_catalog(name).glasses.values()]
    assert not any(map(is_radiation_hard, others))


def test_classes_of_resistance(resistant):
    """Stain 0 is the best class where the others are listed, and no class where none is."""
    assert resistant.glasses["BK"].resistance == {"climate": 1, "stain": 0, "acid": 1, "alkali": 2.3, "phosphate": 2.3}
    assert resistant.glasses["BARE"].resistance == resistant.glasses["NULL"].resistance == {}
    assert names(rt.glasses("any acid<=2 stain<=0", catalogs=[resistant])) == {"BK"}
    assert names(rt.glasses("any climate>=2", catalogs=[resistant])) == {"WEAK"}
    listing = rt.glasses("climate>=2", catalogs=[resistant])
    assert dict(listing.left_out) == {"obsolete": 1, "special": 1, "not climate>=2": 1}
    assert dict(rt.glasses("any climate<=1", catalogs=[resistant]).left_out)["climate not listed"] == 2


def test_a_list_states_what_it_leaves_out():
    listing = rt.glasses(catalogs=["SCHOTT"])
    summary = "125 of 366 glasses of SCHOTT; left out: 232 obsolete, 6 radiation_hard, 3 special (the word any adds"
    assert listing.summary.startswith(summary)
    text = str(rt.glasses("radiation_hard density>=5.19 density<=5.22", catalogs=["SCHOTT"]))
    assert re.search(r"SF6G05 +SCHOTT +preferred, radiation-hard +1.80906 +25.27 +2.9 +5.2 +7.8", text)
    infrared = rt.glasses("any", catalogs=["INFRARED"])
    assert None in {row["nd"] for row in infrared.document()["results"]}  # ranges begin beyond the d line


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("prefered", "did you mean preferred"),
        ("price<3 preferred", "expected preferred, standard"),
        ("prices<=3", "did you mean price"),
        ("transmittance>=0.9", "wavelength in µm"),
        ("transmittance:0.4.1>=0.9", "wavelength in µm"),
        ("price:0.4<=2", "price<=3"),
    ],
)
def test_other_words_are_refused(words, message):
    with pytest.raises(BadSelection, match=re.escape(message)):
        Selection.of(words)


def test_the_command_lists_glasses(capsys, tmp_path):
    assert (
        main(["glasses", "preferred", "price<=1.6", "transmittance:0.4>=0.998", "--catalog", "SCHOTT", "--json"]) == 0
    )
    document = json.loads(capsys.readouterr().out)
    (glass,) = document["results"]
    assert (glass["glass"], glass["status"], glass["price"]) == ("N-BK7HT", "preferred", 1.6)
    assert glass["transmittance:0.4"] == pytest.approx(0.9984, abs=1e-6)
    assert document["left_out"]["obsolete"] == 232
    assert main(["glasses", "preferred", "price<=1.2", "--catalog", "SCHOTT", "-o", str(tmp_path / "glasses.csv")]) == 0
    header, first, *_ = (tmp_path / "glasses.csv").read_text("utf-8").splitlines()
    assert (header, first[:18]) == ("glass,catalog,status,nd,vd,price,density,expansion", "N-BAK1,SCHOTT,pref")
    assert main(["glasses", "dear"]) == 1
    assert "expected preferred, standard" in capsys.readouterr().err
