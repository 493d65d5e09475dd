"""The primary wavelength: the first where none is specified, and numbered from 1, wherever a lens comes from."""

import json
import re

import pytest
from layers import MODULES

import raytrace as rt
from raytrace.cli import main
from raytrace.io import FORMATS, LensFileError
from raytrace.io.source import Place, decode

WAVES = [0.5876, 0.4861, 0.6563]
ROWS = [dict(radius=50, thickness=4, glass=1.5), dict(radius=-50, thickness=48)]

ZMX = """VERS 0
MODE SEQ
ENPD 10
{}FTYP 0 0 1 3 0 0 0
WAVM 1 0.5876 1
WAVM 2 0.4861 1
WAVM 3 0.6563 1
{}SURF 0
  DISZ INFINITY
SURF 1
  STOP
  CURV 0.02
  DISZ 50
SURF 2
  DISZ 0
"""
SEQ = "RDM;LEN\nDIM M\nEPD 10\nWL 587.6 486.1 656.3\n{}YAN 0\nSO 0 1e14\nS 50 4 517.642\nSTO\nS -50 48\nSI 0 0\nGO\n"
TABLE = """# aperture: entrance pupil diameter 10
# wavelengths: 0.5876 0.4861 0.6563
# stop: 1
{}surface,radius,thickness,glass
0,inf,inf,
1,50,4,N-BK7
2,-50,48,
3,inf,0,
"""


def read(text: str, suffix: str) -> rt.Lens:
    name = f"lens{suffix}"
    return FORMATS[suffix].read(decode(text.encode(), Place(name)), name)[0]


def made(**how) -> rt.Lens:
    return rt.lens(ROWS, stop=1, f_number=5, **how)


LENSES = {
    "rt.lens": lambda: (made(wavelengths=WAVES), made(wavelengths=WAVES, primary_wavelength=3)),
    "at": lambda: (made().at(wavelengths=WAVES), made().at(wavelengths=WAVES[::-1])),
    "zmx": lambda: (read(ZMX.format("", ""), ".zmx"), read(ZMX.format("", "PWAV 3\n"), ".zmx")),
    "seq": lambda: (read(SEQ.format("REF 1\n"), ".seq"), read(SEQ.format("REF 3\n"), ".seq")),  # never without
    "table": lambda: (read(TABLE.format(""), ".csv"), read(TABLE.format("# primary wavelength: 3\n"), ".csv")),
}


@pytest.mark.parametrize("origin", LENSES)
def test_the_first_wavelength_is_the_primary_one_unless_another_is_specified_by_its_number(origin):
    first, other = LENSES[origin]()
    assert (first.primary_wavelength, float(first.primary)) == (1, pytest.approx(0.5876))
    assert float(other.primary) == pytest.approx(0.6563)
    assert other.primary_wavelength == (1 if origin == "at" else 3)


@pytest.mark.parametrize("suffix", [".zmx", ".seq", ".csv"])
def test_the_number_is_written_printed_and_read_back(suffix, tmp_path, capsys):
    path = tmp_path / f"lens{suffix}"
    rt.write_lens(made(wavelengths=WAVES, primary_wavelength=3), path)
    assert rt.read_lens(path).primary_wavelength == 3
    assert "primary wavelength: number 3 of 3, 0.6563 µm" in str(rt.check(path))
    assert "0.5876, 0.4861, 0.6563* µm  (* primary: number 3)" in str(rt.info(rt.read_lens(path)))
    assert main(["info", str(path), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["primary_wavelength"] == 3
    assert main(["info", str(path), "--json", "--wavelength", "0.6", "0.5"]) == 0
    assert json.loads(capsys.readouterr().out)["primary_wavelength"] == 1


def test_a_number_that_there_is_not_is_refused():
    for number in (0, 4):
        with pytest.raises(rt.BadPrescription, match=f"primary wavelength number {number}; .* 1 to 3"):
            made(wavelengths=WAVES, primary_wavelength=number)
        with pytest.raises(LensFileError, match=f"{number}, expected"):
            read(SEQ.format(f"REF {number}\n"), ".seq")


def test_no_code_takes_the_number_for_a_place():
    """`wavelengths[lens.primary_wavelength]` would be the one behind it: `lens.primary` is the wavelength."""
    for name, path in MODULES.items():
        assert not re.search(r"\[[^\]\n]*\.primary_wavelength\b(?! - 1)[^\]\n]*\]", path.read_text(encoding="utf-8")), (
            name
        )
