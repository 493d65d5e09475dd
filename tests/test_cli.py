"""The command line: its fixed machine-readable forms, its numbers against independent ones, and how it refuses."""

import csv
import errno
import json
import math
import os
import re
import runpy
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from raytrace.cli import commands

ROOT = Path(__file__).parents[1]
DOUBLE_GAUSS = ROOT / "lenses" / "double_gauss.zmx"
TEXT = DOUBLE_GAUSS.read_text(encoding="utf-8")
COMMANDS = [command.name for command in commands.COMMANDS]
NANOMETRE = 1e-6
PICOMETRE = 1e-9

#: Indices at 0.530 µm and first-order data of the double Gauss, from an independent calculation (ten decimals).
SK2, SK16, F5 = 1.6110909192, 1.6239670970, 1.6089032455
EFL, BFL, IMAGE_OF_25_M, IMAGE_OF_10_M = 99.5145515666, 57.4851290372, 57.8817685209, 58.4786601704
#: Curvature, thickness, index behind: the prescription of the double Gauss as published.
PRESCRIPTION = (
    (0.0184661976, 8.74664, SK2),
    (0.0065564346, 0.5, 1.0),
    (0.027815929, 14.0, SK16),
    (0.0, 3.77696, F5),
    (0.04490361, 14.253, 1.0),
    (0.0, 12.4281, 1.0),
    (-0.03893318, 3.777, F5),
    (0.0, 10.834, SK16),
    (-0.027041482, 0.5, 1.0),
    (0.0050912, 6.8581, SK16),
    (-0.014892576, 58.5, 1.0),
    (0.0, 0.0, 1.0),
)
MILLIMETRES = {"MM": 1.0, "CM": 10.0, "IN": 25.4, "METER": 1000.0}


def python(*arguments: str, **keywords) -> subprocess.CompletedProcess:
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    return subprocess.run(
        [sys.executable, *arguments], capture_output=True, text=True, timeout=120, env=environment, **keywords
    )


def zmx(surfaces: list[str], *, head: str = "", unit: str = "MM", wavelengths: str = "WAVM 1 0.55 1") -> str:
    """A small .zmx file: the object at infinity, the surfaces given as their own lines, the image."""
    lines = ["MODE SEQ", f"UNIT {unit} X W X CM MR CPMM", "ENPD 10", "FTYP 0 0 1 1 0 0 0", "XFLN 0", "YFLN 0"]
    lines += [head] if head else []
    lines += [wavelengths, "PWAV 1", "SURF 0", "  TYPE STANDARD", "  CURV 0", "  DISZ INFINITY"]
    for number, text in enumerate(surfaces, 1):
        lines += [f"SURF {number}", *(f"  {line}" for line in text.split("; "))]
    return "\n".join([*lines, f"SURF {len(surfaces) + 1}", "  TYPE STANDARD", "  CURV 0", "  DISZ 0", ""])


# ---------------------------------------------------------------- an independent tracer, one ray at a time


def sag(r2, c, k, terms):
    root = 1 - (1 + k) * c * c * r2
    if root < 0:
        return math.nan
    return c * r2 / (1 + math.sqrt(root)) + sum(a * r2 ** (j + 1) for j, a in enumerate(terms))


def slope(r2, c, k, terms):
    """dz/d(r²)."""
    root = 1 - (1 + k) * c * c * r2
    return 0.5 * c / math.sqrt(root) + sum((j + 1) * a * r2**j for j, a in enumerate(terms))


def crossing(p, d, c, k, terms):
    """Path to the sheet through the vertex; None if there is none."""
    if not terms:
        return conic_crossing(p, d, c, k)
    t = -p[2] / d[2]  # Newton's method from the vertex plane
    for _ in range(200):
        x, y, z = p + t * d
        height = sag(x * x + y * y, c, k, terms)
        if math.isnan(height):
            return None
        step = (z - height) / (d[2] - 2 * slope(x * x + y * y, c, k, terms) * (x * d[0] + y * d[1]))
        t -= step
        if abs(step) < 1e-14 * max(1.0, abs(t)):
            return t
    return None


def conic_crossing(p, d, c, k):
    """The root of c (x² + y² + (1+k) z²) = 2 z on the vertex sheet that the ray enters in its own direction."""
    if c == 0:
        return -p[2] / d[2]
    shape = np.array([1.0, 1.0, 1 + k])
    coefficients = [c * d @ (shape * d), 2 * c * p @ (shape * d) - 2 * d[2], c * p @ (shape * p) - 2 * p[2]]
    for t in np.roots(coefficients):
        x, y, z = p + t.real * d
        normal = np.array([-c * x, -c * y, 1 - (1 + k) * c * z])
        if t.imag == 0 and normal[2] > 0 and (normal @ d) * d[2] > 0:
            return t.real
    return None


def reference(surfaces, p, d, n=1.0):
    """Rows (surface, position, direction, opl, status) of one ray; surfaces: dicts with c, k, terms, T, n, clear."""
    p, d = np.array(p, float), np.array(d, float)
    opl, status = 0.0, "ok"
    for number, s in enumerate(surfaces, 1):
        t = crossing(p, d, s["c"], s.get("k", 0.0), s.get("terms", ()))
        if t is None:
            yield number, None, None, None, "miss"
            return
        p, opl = p + t * d, opl + n * t
        slant = 2 * slope(p[0] ** 2 + p[1] ** 2, s["c"], s.get("k", 0.0), s.get("terms", ()))
        normal = np.array([-slant * p[0], -slant * p[1], 1.0])
        normal /= np.linalg.norm(normal)
        if normal @ d < 0:
            normal = -normal
        cosine = normal @ d
        if s.get("mirror"):
            d = d - 2 * cosine * normal
        else:
            ratio = n / s["n"]
            root = 1 - ratio**2 * (1 - cosine**2)
            if root < 0:
                yield number, None, None, None, "tir"
                return
            d, n = ratio * d + (math.sqrt(root) - ratio * cosine) * normal, s["n"]
        if "clear" in s and not s["clear"](p[0], p[1]):
            status = "vignetted"
        yield number, p, d, opl, status
        p = p - np.array([0.0, 0.0, s["T"]])


def surfaces_of(document: dict) -> list[dict]:
    """What `reference` takes, out of `raytrace info --json` (for lenses without apertures or mirrors)."""
    rows = document["surfaces"][1:]
    primary = document["primary_wavelength"] - 1
    return [
        {
            "c": s["curvature"],
            "k": s["conic"],
            "terms": s["coefficients"],
            "T": s["thickness"],
            "n": s["indices"][primary],
        }
        for s in rows
    ]


def write_rays(path: Path, rays, header: str = "x,y,z,l,m,n") -> Path:
    path.write_text(header + "\n" + "".join(",".join(repr(float(v)) for v in ray) + "\n" for ray in rays))
    return path


def read_rows(path: Path) -> list[dict]:
    with open(path, newline="", encoding="utf-8") as file:
        reader = csv.DictReader(file)
        rows = list(reader)
    assert reader.fieldnames == ["ray", "surface", "x", "y", "z", "l", "m", "n", "opl", "status"]
    return rows


def assert_rows(rows: list[dict], surfaces: list[dict], rays, tolerance: float) -> None:
    """Every row of the table is the reference's: same rays, same surfaces, same end, same numbers."""
    expected = [(i, *row) for i, ray in enumerate(rays) for row in reference(surfaces, ray[:3], ray[3:6])]
    assert [(int(r["ray"]), int(r["surface"]), r["status"]) for r in rows] == [(e[0], e[1], e[5]) for e in expected]
    for row, (_, _, position, direction, opl, _) in zip(rows, expected, strict=True):
        found = [row[name] for name in ("x", "y", "z", "l", "m", "n", "opl")]
        if position is None:
            assert found == [""] * 7
        else:
            np.testing.assert_allclose([float(v) for v in found], [*position, *direction, opl], rtol=0, atol=tolerance)


def paraxial(surfaces, y=1.0, u=0.0, n=1.0):
    """(y, u) behind the last of (curvature, thickness, index | "mirror"), u = dy/dz; n is signed inside."""
    for number, (c, thickness, behind) in enumerate(surfaces, 1):
        after = -n if behind == "mirror" else math.copysign(behind, n)
        u, n = (n * u - y * c * (after - n)) / after, after
        if number < len(surfaces):
            y += u * thickness
    return y, u


# ---------------------------------------------------------------- the command


def test_help_imports_nothing_heavy():
    code = (
        "import sys; from raytrace.cli import main; code = main(['--help']);"
        "heavy = {'torch', 'numpy', 'scipy', 'pandas', 'matplotlib', 'tqdm'} & set(sys.modules);"
        "sys.exit(f'imported {heavy}' if heavy else code)"
    )
    done = python("-c", code)
    assert done.returncode == 0, done.stderr
    for command in COMMANDS:
        assert re.search(rf"^\s+{command}\s", done.stdout, re.M)


def test_the_version(run):
    assert run("--version").out.startswith("raytrace ")


def test_the_module_is_the_command_with_its_exit_codes(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["raytrace", "info", "no_such.zmx"])
    monkeypatch.setattr("raytrace.cli.keep_freed_memory", lambda: None)  # of this process
    with pytest.raises(SystemExit) as ended:
        runpy.run_module("raytrace", run_name="__main__")
    assert ended.value.code == 1
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("raytrace: error: no_such.zmx: no such lens file")
    assert err.count("\n") == 1


@pytest.mark.skipif(os.name != "posix", reason="needs a POSIX pipe")
@pytest.mark.slow
def test_reader_that_leaves_early_is_no_error(tmp_path):
    rays = write_rays(tmp_path / "rays.csv", [(0.001 * i, 0, -5, 0, 0, 1) for i in range(2000)])
    process = subprocess.Popen(
        [sys.executable, "-m", "raytrace", "trace", "double_gauss", "--rays", str(rays)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        cwd=ROOT,
    )
    assert process.stdout.readline().startswith(b"ray,surface,")
    process.stdout.close()
    complaint = process.stderr.read()
    process.stderr.close()
    assert process.wait(timeout=60) == 0
    assert complaint == b""


def test_interrupt_is_one_line(run, monkeypatch):
    from raytrace.tracing import lens_report as views

    def interrupted(lens):
        raise KeyboardInterrupt

    monkeypatch.setattr(views, "info", interrupted)
    assert run("info", "double_gauss") == (130, "", "raytrace: error: interrupted\n")


@pytest.mark.parametrize("command", COMMANDS)
def test_help_teaches_by_example(run, command):
    done = run(command, "--help")
    assert done.code == 0
    assert done.err == ""
    examples = done.out.split("examples:")[1]
    assert examples.count(f"raytrace {command} ") >= 2
    assert "--json" in done.out


def test_examples_of_the_help_parse():
    from raytrace.cli import build_parser

    parser = build_parser()
    for command in commands.COMMANDS:
        for line in re.findall("^  raytrace .*", command.examples, re.M):
            words = shlex.split(line.split("|")[0])
            assert parser.parse_args(words[1:]).command == command.name


@pytest.mark.parametrize(
    "arguments",
    [
        (),
        ("nonsense",),
        ("info",),
        ("info", "double_gauss", "--object-distance", "0"),
        ("info", "double_gauss", "--object-distance=-5"),
        ("info", "double_gauss", "--object-distance", "nan"),
        ("focus", "double_gauss", "--object-distance", "1000", "0"),
        ("focus", "double_gauss", "--object-distance", "25,000"),
        ("info", "double_gauss", "--sensor-distance", "inf"),
        ("info", "double_gauss", "--f-number", "0"),
        ("info", "double_gauss", "--f-number", "3", "--epd", "30"),
        ("info", "double_gauss", "--epd=-1"),
        ("spot", "double_gauss", "--wavelength", "0"),
        ("spot", "double_gauss", "--wavelength", "0.5", "nan"),
        ("spot", "double_gauss", "--field", "nan"),
        ("spot", "double_gauss", "--rings", "0"),
        ("spot", "double_gauss", "--points", "1.5"),
        ("spot", "double_gauss", "--sampling", "dartboard"),
        ("focus", "double_gauss", "--criterion", "best"),
        ("focus", "double_gauss", "--field-weights", "0"),
        ("trace", "double_gauss", "--no-such-option"),
        ("glass", "N-BK7", "--wavelength", "blue"),
        ("convert", "double_gauss"),
    ],
    ids=" ".join,
)
def test_bad_usage_is_one_line(run, arguments):
    done = run(*arguments)
    assert done.code == 2
    assert "--help" in done.error


def test_a_second_lens_is_unexpected(run):
    done = run("info", "double_gauss", "tessar", "singlet")
    assert done.code == 2
    assert "unexpected tessar and 1 more: the command takes one LENS" in done.error


BAD_LENSES = {
    "empty.zmx": ("", r"empty\.zmx.*empty"),
    "binary.zmx": ("\x00\x01\x17\xff" * 500, r"binary\.zmx.*binary"),
    "truncated.zmx": (TEXT[: len(TEXT) // 2], r"truncated\.zmx:\d+, surface \d+: .*cut off"),
    "unknown_glass.zmx": (
        TEXT.replace("GLAS SK2 ", "GLAS SK22 "),
        r"unknown_glass\.zmx:43, surface 1: unknown glass 'SK22'.*Nearest names: .*--catalog",
    ),
    "unsupported.zmx": (
        TEXT.replace("SURF 4\n  TYPE STANDARD", "SURF 4\n  TYPE NONSEQCO"),
        r"unsupported\.zmx:57, surface 4: type NONSEQCO",
    ),
    "nan.zmx": (TEXT.replace("DISZ 8.74664", "DISZ nan"), r"nan\.zmx:42, surface 1: .*nan"),
    "words.zmx": (TEXT.replace("DISZ 8.74664", "DISZ abc"), r"words\.zmx:42, surface 1: .*'abc'"),
    "aperture.zmx": (TEXT.replace("ENPD 33.33", "ENPD 0"), r"aperture\.zmx:13: .*'0'"),
    "wavelength.zmx": (TEXT.replace("WAVM 1 0.53 1.0", "WAVM 1 0.0 1.0"), r"wavelength\.zmx:31: WAVM: wavelength"),
    "field.zmx": (TEXT.replace("10.0 14.0", "10.0 95.0"), r"field\.zmx: .*90 degrees"),
    "no_suffix": (TEXT, r"no_suffix: .*suffix.*\.zmx"),
    "suffix.foo": (TEXT, r"suffix\.foo: .*'\.foo'.*\.zmx"),
    "empty.csv": ("", r"empty\.csv.*empty"),
    "rows.csv": ("curvature,thickness,glass\n0.01,abc,SK2\n0,1,\n0,0,\n", r"rows\.csv:2.*'abc'"),
}


@pytest.mark.parametrize("name", BAD_LENSES)
def test_bad_lens_files_are_refused_by_name(run, name):
    content, pattern = BAD_LENSES[name]
    Path(name).write_text(content, encoding="utf-8")
    for command in ("info", "spot", "focus", "trace", "layout"):
        done = run(command, name, "--json")
        assert done.code == 1
        assert re.search(pattern, done.error), done.error
    assert run("convert", name, "out.csv").code == (0 if name == "field.zmx" else 1)
    assert sorted(path.name for path in Path().iterdir()) == sorted({name, *(["out.csv"] * (name == "field.zmx"))})


@pytest.mark.parametrize("name", ["missing.zmx", "folder.zmx", ".", "", "ü ñ/日.zmx"])
def test_missing_files_are_refused(run, name):
    Path("folder.zmx").mkdir()
    for command in ("info", "check", "focus"):
        assert name in run(command, name).error
    assert "double_gauss" in run("info", "missing.zmx").error


def test_unicode_paths(run):
    folder = Path("ü ñ 日本")
    folder.mkdir()
    (folder / "lens é.zmx").write_text(TEXT, encoding="utf-8")
    done = run("focus", folder / "lens é.zmx", "-o", folder / "ß.csv", "--json")
    assert done.code == 0
    assert (
        run("info", folder / "ß.csv", "--json").document["surfaces"][11]["thickness"] == done.document["sensor_after"]
    )


def test_lens_after_list_options(run):
    assert run("focus", "--object-distance", 1000, 2000, "--json", "--", "double_gauss").code == 0
    assert "double_gauss" in run("focus", "--object-distance", 1000, "double_gauss").error


def test_warnings_go_to_standard_error(run):
    done = run("info", "double_gauss", "--wavelength", 3, "--json")
    assert done.code == 0
    assert done.document["wavelengths"] == [3]
    lines = [line for line in done.err.splitlines() if "miss the stop" not in line]
    assert [re.search(r"surface \d+: (\w+)", line)[1] for line in lines] == ["SK2", "SK16", "F5"]
    assert all(line.startswith("raytrace: warning: ") and "0.3" in line for line in lines)
    assert "no real refractive index" in run("info", "double_gauss", "--wavelength", 10).error
    assert "expected 3e-05 to 100" in run("info", "double_gauss", "--wavelength", 1e300).error


@pytest.mark.parametrize("field", ["90", "95", "-95", "180", "1e300"])
def test_fields_behind_the_lens_are_refused(run, field):
    for command in ("spot", "focus"):
        assert "90 degrees" in run(command, "double_gauss", f"--field={field}").error


EXTREMES = [
    ("--object-distance", "1e-300"),
    ("--object-distance", "1e300"),
    ("--object-distance", "inf"),
    ("--sensor-distance", "1e300"),
    ("--sensor-distance", "-5"),
    ("--sensor-distance", "1e-320"),
    ("--f-number", "1e300"),
    ("--f-number", "1e-300"),
    ("--f-number", "0.5"),
    ("--epd", "1e300"),
    ("--wavelength", "1e-9"),
]


@pytest.mark.parametrize("arguments", EXTREMES, ids=" ".join)
def test_extreme_conditions_give_strict_json_or_one_line(run, arguments):
    for command in ("info", "spot", "focus", "trace"):
        done = run(command, "double_gauss", "=".join(arguments), "--json")
        if done.code == 0:
            assert done.document
        else:
            assert done.error


# ---------------------------------------------------------------- info


def test_info_of_the_double_gauss(run):
    document = run("info", "double_gauss", "--json").document
    for name, expected in (("effective_focal_length", EFL), ("back_focal_distance", BFL), ("f_number", EFL / 33.33)):
        assert document[name] == pytest.approx(expected, abs=1e-9)
    assert document["entrance_pupil_diameter"] == 33.33
    assert document["wavelengths"] == [0.53]
    assert document["primary_wavelength"] == 1
    assert [(f["x"], f["y"]) for f in document["fields"]] == [(0, 0), (0, 10), (0, 14)]
    assert document["stop_surface"] == 6
    surfaces = document["surfaces"]
    assert len(surfaces) == 13
    assert surfaces[0]["thickness"] is None
    assert [s["glass"] for s in surfaces] == [
        None, "SK2", None, "SK16", "F5", None, None, "F5", "SK16", None, "SK16", None, None
    ]  # fmt: skip
    assert [(s["curvature"], s["thickness"]) for s in surfaces[1:]] == [row[:2] for row in PRESCRIPTION]
    assert all(s["conic"] == 0 for s in surfaces)
    np.testing.assert_allclose([s["indices"] for s in surfaces[1:]], [[row[2]] for row in PRESCRIPTION], atol=6e-11)


def test_pupils_of_the_double_gauss(run):
    """The pupils are the stop's images: a ray from the stop's centre, traced both ways by y-nu."""
    document = run("info", "double_gauss", "--json").document
    indices = [1.0] + [s["indices"][0] for s in document["surfaces"][1:]]
    rows = [(c, T, n) for (c, T, _), n in zip(PRESCRIPTION, indices[1:], strict=True)]
    gap = rows[5][1]
    y, u = paraxial(rows[6:11], y=gap * 0.1, u=0.1)
    assert document["exit_pupil_position"] == pytest.approx(-y / u - 58.5, rel=1e-12)
    backward = [(-rows[k][0], rows[k - 1][1], indices[k]) for k in range(4, -1, -1)]
    y, u = paraxial(backward, y=rows[4][1] * 0.1, u=0.1)
    assert document["entrance_pupil_position"] == pytest.approx(y / u, rel=1e-12)


def test_same_lens_as_table(run):
    assert (
        run("info", DOUBLE_GAUSS.with_suffix(".csv"), "--json").document == run("info", DOUBLE_GAUSS, "--json").document
    )


def test_conditions_other_than_the_files(run):
    document = run("info", "double_gauss", "--json", "--f-number", 4, "--sensor-distance", 60).document
    assert document["entrance_pupil_diameter"] == pytest.approx(EFL / 4, abs=1e-9)
    assert document["surfaces"][11]["thickness"] == 60
    far = run("info", "double_gauss", "--json", "--object-distance", 10000, "--epd", 20).document
    assert far["paraxial_image_distance"] == pytest.approx(IMAGE_OF_10_M, abs=1e-9)
    assert far["surfaces"][0]["thickness"] == 10000
    assert far["entrance_pupil_diameter"] == 20
    several = run("info", "double_gauss", "--json", "--wavelength", 0.6, 0.5).document
    assert several["wavelengths"] == [0.6, 0.5]
    assert several["primary_wavelength"] == 1
    assert all(len(s["indices"]) == 2 for s in several["surfaces"])


@pytest.mark.parametrize("unit", ["IN", "CM", "METER"])
def test_every_number_is_in_mm(run, unit):
    """The same file read as inches is the same lens 25.4 times as large: every length scales, no index or angle."""
    scale = MILLIMETRES[unit]
    Path("scaled.zmx").write_text(TEXT.replace("UNIT MM", f"UNIT {unit}"), encoding="utf-8")
    here, there = run("info", DOUBLE_GAUSS, "--json").document, run("info", "scaled.zmx", "--json").document
    lengths = ("effective_focal_length", "back_focal_distance", "entrance_pupil_position", "entrance_pupil_diameter",
               "exit_pupil_position")  # fmt: skip
    for name in lengths:
        assert there[name] == pytest.approx(scale * here[name], rel=1e-12)
    assert there["f_number"] == pytest.approx(here["f_number"], rel=1e-12)
    assert there["fields"] == here["fields"]
    for a, b in zip(here["surfaces"][1:], there["surfaces"][1:], strict=True):
        assert b["thickness"] == pytest.approx(scale * a["thickness"], rel=1e-15)
        assert b["curvature"] == pytest.approx(a["curvature"] / scale, rel=1e-15)
        assert b["indices"] == a["indices"]
    small = run("focus", DOUBLE_GAUSS, "--object-distance", 25000, "--json").document
    large = run("focus", "scaled.zmx", "--object-distance", 25000 * scale, "--json").document
    assert large.pop("is_real") is small.pop("is_real") is True
    for name in small:
        assert large[name] == pytest.approx(scale * small[name], rel=1e-9), name
    write_rays(Path("a.csv"), [(0, 10, -7, 0, 0.01, math.sqrt(1 - 1e-4))])
    write_rays(Path("b.csv"), [(0, 10 * scale, -7 * scale, 0, 0.01, math.sqrt(1 - 1e-4))])
    a = run("trace", DOUBLE_GAUSS, "--rays", "a.csv", "--json").document["results"][-1]
    b = run("trace", "scaled.zmx", "--rays", "b.csv", "--json").document["results"][-1]
    for name in ("y", "opl"):
        assert b[name] == pytest.approx(scale * a[name], rel=1e-12)
    assert b["m"] == pytest.approx(a["m"], rel=1e-12)


def test_mirrors(run):
    """Two mirrors: every index is positive, the focal length is -y/u' of a paraxial ray with literal signs."""
    document = run("info", "hubble", "--json").document
    surfaces = document["surfaces"]
    assert all(index > 0 for s in surfaces for index in s["indices"])
    rows = [(s["curvature"], s["thickness"], "mirror" if s["glass"] == "MIRROR" else 1.0) for s in surfaces[1:-1]]
    y, u = paraxial(rows)
    assert document["effective_focal_length"] == pytest.approx(-1 / u, rel=1e-12)
    assert document["back_focal_distance"] == pytest.approx(-y / u, rel=1e-12)
    one = zmx(["STOP; TYPE STANDARD; CURV -0.005; DISZ -100; GLAS MIRROR"])
    Path("one.zmx").write_text(one)
    document = run("info", "one.zmx", "--json").document
    assert document["surfaces"][1]["indices"] == [1.0]
    # -y₁/u′ with the slope taken along the light: one concave mirror collects, its focal length is positive.
    assert document["effective_focal_length"] == pytest.approx(1 / paraxial([(-0.005, 0, "mirror")])[1], rel=1e-15)
    assert document["back_focal_distance"] == pytest.approx(-100, rel=1e-15)
    assert document["f_number"] == pytest.approx(10, rel=1e-15)
    assert document["entrance_pupil_diameter"] > 0


def test_mirror_behind_glass_keeps_its_medium(run):
    Path("mangin.zmx").write_text(
        zmx(
            [
                "STOP; TYPE STANDARD; CURV -0.006; DISZ 8; GLAS N-BK7",
                "TYPE STANDARD; CURV -0.004; DISZ -8; GLAS MIRROR",
                "TYPE STANDARD; CURV -0.006; DISZ -90",
            ],
            head="GCAT SCHOTT",
        )
    )
    surfaces = run("info", "mangin.zmx", "--json").document["surfaces"]
    assert surfaces[1]["indices"] == surfaces[2]["indices"]
    assert surfaces[1]["indices"][0] > 1.5
    assert surfaces[3]["indices"] == [1.0]


def test_undefined_values_are_null(run):
    Path("plate.zmx").write_text(
        zmx(["STOP; TYPE STANDARD; CURV 0; DISZ 5; GLAS N-BK7", "TYPE STANDARD; CURV 0; DISZ 10"])
    )
    document = run("info", "plate.zmx", "--json").document
    assert document["effective_focal_length"] is None
    assert document["back_focal_distance"] is None
    assert "afocal" in run("focus", "plate.zmx").error
    assert run("info", "plate.zmx").code == 0


def test_info_for_people(run):
    done = run("info", "double_gauss")
    assert done.code == 0
    assert "field 14 degrees: rays miss the stop" in done.err
    assert len(done.err.splitlines()) == 1
    for text in ("99.5145516", "57.485129", "SK16", "stop", "1.623967"):
        assert text in done.out


# ---------------------------------------------------------------- trace


def random_rays(count: int, radius: float, angle: float, z: float, seed: int = 1) -> list[tuple[float, ...]]:
    """Rays that start on the plane z, aimed within `radius` of the vertex of surface 1, tilted up to `angle` rad."""
    generator = np.random.default_rng(seed)
    aims = generator.uniform(-radius, radius, (count, 2))
    tilts = generator.uniform(-angle, angle, (count, 2))
    directions = np.column_stack([np.sin(tilts), np.sqrt(1 - (np.sin(tilts) ** 2).sum(1))])
    starts = np.column_stack([aims, np.zeros(count)]) + directions * (z / directions[:, 2:])
    return [tuple(row) for row in np.hstack([starts, directions]).tolist()]


def test_trace_of_the_double_gauss(run):
    """Positions, directions, paths and fates of 60 rays, some far outside the lens, against the tracer above."""
    rays = random_rays(60, 32.0, 0.4, -40.0)
    surfaces = surfaces_of(run("info", "double_gauss", "--json").document)
    done = run("trace", "double_gauss", "--rays", write_rays(Path("in.csv"), rays), "-o", "out.csv")
    assert done.code == 0
    assert done.out == ""
    rows = read_rows(Path("out.csv"))
    assert_rows(rows, surfaces, rays, 1e-11)
    assert {row["status"] for row in rows} == {"ok", "miss", "tir"}
    lost = {row["status"] for row in rows if row["x"] == ""}
    assert lost == {"miss", "tir"}
    published = [{"c": c, "T": T, "n": n} for c, T, n in PRESCRIPTION]
    assert_rows(rows, published, rays, 100 * PICOMETRE)  # ten decimals of each index


def test_trace_of_aspheres(run):
    document = run("info", "phone", "--json").document
    assert any(s["coefficients"] for s in document["surfaces"])
    rays = random_rays(12, 0.3, 0.2, -1.0)
    run("trace", "phone", "--rays", write_rays(Path("in.csv"), rays), "-o", "out.csv")
    rows = read_rows(Path("out.csv"))
    assert_rows(rows, surfaces_of(document), rays, 1e-11)
    assert rows[-1]["surface"] == str(len(document["surfaces"]) - 1)


APERTURES = {
    "CLAP 1 4 0": lambda x, y: 1 <= math.hypot(x, y) <= 4,
    "FLAP 0 3 0": lambda x, y: math.hypot(x, y) <= 5,
    "OBSC 0 2 0": lambda x, y: not math.hypot(x, y) < 2,
    "SQAP 3 1 0": lambda x, y: abs(x) <= 3 and abs(y) <= 1,
    "ELAP 3 1 0": lambda x, y: (x / 3) ** 2 + y**2 <= 1,
    "CLAP 0 2 0; OBDC 1 -2": lambda x, y: math.hypot(x - 1, y + 2) <= 2,
    "DIAM 0.5 1 0 0 1": None,
}


@pytest.mark.parametrize("aperture", APERTURES)
def test_vignetted_rays_keep_their_coordinates(run, aperture):
    """Only apertures clip, never a stored semi-diameter (5 mm unless given, which a floating aperture follows)."""
    size = "" if aperture.startswith("DIAM") else "; DIAM 5 1 0 0 1"
    Path("lens.zmx").write_text(
        zmx(
            [
                f"STOP; TYPE STANDARD; CURV 0.01; DISZ 4; GLAS N-BK7{size}; {aperture}",
                "TYPE STANDARD; CURV -0.01; DISZ 90",
            ],
            head="GCAT SCHOTT",
        )
    )
    surfaces = surfaces_of(run("info", "lens.zmx", "--json").document)
    if APERTURES[aperture]:
        surfaces[0]["clear"] = APERTURES[aperture]
    rays = random_rays(60, 6.0, 0.05, -3.0)
    done = run("trace", "lens.zmx", "--rays", write_rays(Path("in.csv"), rays), "-o", "out.csv")
    rows = read_rows(Path("out.csv"))
    assert_rows(rows, surfaces, rays, 1e-11)
    lost = sum(row["status"] == "vignetted" for row in rows) // 3
    assert len(rows) == 180
    if APERTURES[aperture]:
        assert 0 < lost < 60
        assert f"{lost} rays were vignetted at surface 1" in done.err
    else:
        assert lost == 0


def test_trace_of_mirrors_and_edges(run):
    """Parabola: every axis-parallel ray meets the focus, behind the obscuration too; edges belong to the clear side."""
    Path("parabola.zmx").write_text(
        zmx(
            [
                "TYPE STANDARD; CURV 0; DISZ 50; OBSC 0 2 0",
                "STOP; TYPE STANDARD; CURV -0.005; CONI -1; DISZ -100; GLAS MIRROR",
            ]
        )
    )
    rays = [(0, 2, 0, 0, 0, 1), (0, 1.9, 0, 0, 0, 1), (3, -4, 0, 0, 0, 1)]
    run("trace", "parabola.zmx", "--rays", write_rays(Path("in.csv"), rays), "-o", "out.csv")
    rows = read_rows(Path("out.csv"))
    surfaces = [
        {"c": 0.0, "T": 50.0, "n": 1.0, "clear": lambda x, y: math.hypot(x, y) >= 2},
        {"c": -0.005, "k": -1.0, "T": -100.0, "mirror": True},
        {"c": 0.0, "T": 0.0, "n": 1.0},
    ]
    assert_rows(rows, surfaces, rays, 1e-11)
    for row in rows[2::3]:
        assert float(row["y"]) == pytest.approx(0, abs=PICOMETRE)
        assert float(row["opl"]) == pytest.approx(150, abs=PICOMETRE)
    assert [row["status"] for row in rows[2::3]] == ["ok", "vignetted", "ok"]


def test_wavelength_column(run):
    header = "x,y,z,l,m,n,wavelength"
    document = run("info", "double_gauss", "--wavelength", 0.4861, 0.6563, "--json").document
    write_rays(Path("in.csv"), [(0, 9, -5, 0, 0, 1, 0.4861), (0, 9, -5, 0, 0, 1, 0.6563)], header)
    run("trace", "double_gauss", "--rays", "in.csv", "-o", "out.csv")
    rows = read_rows(Path("out.csv"))
    for ray in (0, 1):
        surfaces = surfaces_of({**document, "primary_wavelength": ray + 1})
        own = [{**row, "ray": 0} for row in rows if row["ray"] == str(ray)]
        assert_rows(own, surfaces, [(0, 9, -5, 0, 0, 1)], 1e-11)


def test_trace_json_is_the_same_table(run):
    rays = write_rays(Path("in.csv"), [(0, 5, -5, 0, 0, 1), (0, 500, -5, 0, 0, 1), (1, 2, -5, 0, 0, 1)])
    run("trace", "double_gauss", "--rays", rays, "-o", "out.csv")
    document = run("trace", "double_gauss", "--rays", rays, "--json").document
    assert document["rays"] == 3
    rows = read_rows(Path("out.csv"))
    assert len(document["results"]) == len(rows) == 25
    for entry, row in zip(document["results"], rows, strict=True):
        for name, text in row.items():
            value = entry[name]
            assert value == (text if name == "status" else None if text == "" else float(text))
    assert document["lost"] == [{"surface": 1, "status": "miss", "rays": 1}]
    printed = run("trace", "double_gauss", "--rays", rays)
    assert printed.out == Path("out.csv").read_text()
    assert "1 rays missed surface 1" in printed.err


def test_chief_and_marginal_rays(run):
    document = run("trace", "double_gauss", "--json").document
    assert document["rays"] == 12
    at_stop = [row for row in document["results"] if row["surface"] == 6]
    assert at_stop[0]["y"] == 0
    assert at_stop[1]["y"] == -at_stop[2]["y"] > 9
    assert abs(at_stop[4]["y"]) < 1
    assert (
        abs([row for row in document["results"] if row["surface"] == 12][8]["y"] - EFL * math.tan(math.radians(14))) < 1
    )


RAYS = "x,y,z,l,m,n\n"
BAD_RAYS = {
    "empty": ("", "table of rays"),
    "blank": ("\n\n\n", "bad.csv"),
    "no header": ("0,0,0,0,0,1\n0,1,0,0,0,1\n", "bad.csv:1: column 'x' is missing"),
    "missing column": ("x,y,z,l,m\n0,0,0,0,0\n", "bad.csv:1: column 'n' is missing"),
    "semicolons": ("x;y;z;l;m;n\n0;0;0;0;0;1\n", "bad.csv:1: column 'x' is missing"),
    "nan": (RAYS + "0,0,0,0,0,1\n0,nan,0,0,0,1\n", "bad.csv:3: column y"),
    "inf": (RAYS + "0,0,-inf,0,0,1\n", "bad.csv:2: column z: expected a finite number, found '-inf'"),
    "word": (RAYS + "0,0,abc,0,0,1\n", "bad.csv:2: column z: expected a finite number, found 'abc'"),
    "short row": (RAYS + "0,0,0\n", "bad.csv:2: column l"),
    "long row": (RAYS + "0,0,0,0,0,1\n0,0,0,0,0,1,7\n", "bad.csv"),
    "long rows": (RAYS + "0,0,0,0,0,0,1\n1,0,0,0,0,0,1\n", "bad.csv"),
    "after a blank line": (RAYS + "0,0,0,0,0,1\n\n0,abc,0,0,0,1\n", "bad.csv:4: column y"),
    "no direction": (RAYS + "0,0,0,0,0,0\n", "bad.csv:2: the direction"),
    "wavelength": ("x,y,z,l,m,n,wavelength\n0,0,0,0,0,1,-0.5\n", "bad.csv:2: wavelength"),
    "no unit": ("x,y,z,l,m,n,wavelength\n0,0,0,0,0,1,1e200\n", "wavelengths are in µm"),
    "misspelt": (
        "x,y,z,l,m,n,wavelenght\n0,0,0,0,0,1,0.5\n",
        "bad.csv:1: column 'wavelenght' is not known; did you mean 'wavelength'",
    ),
    "in nm": ("x,y,z,l,m,n,wavelength_nm\n0,0,0,0,0,1,500\n", "bad.csv:1: column 'wavelength_nm' is not known"),
    "twice": ("x,X,y,z,l,m,n\n0,0,0,0,0,0,1\n", "bad.csv:1: column 'x' occurs twice"),
    "no wavelength": ("x,y,z,l,m,n,wavelength\n0,0,0,0,0,1,\n", "bad.csv:2: column wavelength"),
    "binary": ("\x00\xff\x17" * 300, "bad.csv"),
}


@pytest.mark.parametrize("case", BAD_RAYS)
def test_bad_tables_of_rays_are_refused(run, case):
    content, message = BAD_RAYS[case]
    Path("bad.csv").write_bytes(content.encode("latin-1"))
    assert message in run("trace", "double_gauss", "--rays", "bad.csv", "-o", "out.csv").error
    assert [path.name for path in Path().iterdir()] == ["bad.csv"]


@pytest.mark.parametrize(
    "content",
    [
        RAYS + "0,1,-5,0,0,1\n",
        "\ufeff" + RAYS + "0,1,-5,0,0,1\n",
        " X , Y , Z , L , M , N \r\n 0 , 1 , -5 , 0 , 0 , 1 \r\n",
        "n,m,l,z,y,x,note\n1,0,0,-5,1,0,spare\n",
        RAYS + "\n0,1,-5,0,0,1\n\n",
    ],
)
def test_good_tables_of_rays(run, content):
    Path("in.csv").write_bytes(content.encode())
    document = run("trace", "double_gauss", "--rays", "in.csv", "--json").document
    assert document["rays"] == 1
    assert_rows(
        [{k: "" if v is None else str(v) for k, v in row.items()} for row in document["results"]],
        surfaces_of(run("info", "double_gauss", "--json").document),
        [(0, 1, -5, 0, 0, 1)],
        1e-11,
    )


def test_no_rays_at_all(run):
    Path("in.csv").write_text(RAYS)
    assert run("trace", "double_gauss", "--rays", "in.csv", "--json").document["results"] == []
    assert run("trace", "double_gauss", "--rays", "in.csv", "-o", "out.csv").code == 0
    assert read_rows(Path("out.csv")) == []
    for name in ("missing.csv", "."):
        assert name in run("trace", "double_gauss", "--rays", name).error
    assert run("trace", "double_gauss", "--rays", "").error


def test_no_ray_is_counted_twice(run):
    """Rays that miss surface 1 are lost there, and nowhere again."""
    rays = write_rays(Path("in.csv"), [(0, 400 + i, -5, 0, 0, 1) for i in range(7)])
    document = run("trace", "double_gauss", "--rays", rays, "--json").document
    assert document["lost"] == [{"surface": 1, "status": "miss", "rays": 7}]
    assert len(document["results"]) == 7


# ---------------------------------------------------------------- spot


def disc(rings: int = 12) -> tuple[np.ndarray, np.ndarray]:
    """Gaussian quadrature of the unit disc, made here: (P, 2) points and weights."""
    nodes, weights = np.polynomial.legendre.leggauss(rings)
    radius = np.sqrt((nodes + 1) / 2)
    angles = (np.arange(4 * rings) + 0.25) * (2 * math.pi / (4 * rings))
    points = np.array([(r * math.cos(a), r * math.sin(a)) for r in radius for a in angles])
    return points, np.repeat(weights / 2 / len(angles), len(angles))


def reference_spot(document: dict, rays, weights) -> tuple[np.ndarray, float]:
    """Centroid and RMS radius about it of rays traced one by one."""
    surfaces = surfaces_of(document)
    hits = np.array([list(reference(surfaces, ray[:3], ray[3:]))[-1][1][:2] for ray in rays])
    centroid = weights @ hits
    return centroid, math.sqrt(weights @ ((hits - centroid) ** 2).sum(1))


def test_rms_is_the_radius_about_the_centroid(run):
    """At 10 degrees from infinity, traced ray by ray from the paraxial entrance pupil."""
    document = run("info", "double_gauss", "--json").document
    points, weights = disc(8)
    direction = (0.0, math.sin(math.radians(10)), math.cos(math.radians(10)))
    depth = document["entrance_pupil_position"]
    aims = np.column_stack([points * 33.33 / 2, np.full(len(points), depth)])
    starts = aims - np.array(direction) * (aims[:, 2:] / direction[2])
    centroid, rms = reference_spot(document, [(*s, *direction) for s in starts], weights)
    (found,) = run("spot", "double_gauss", "--field", 10, "--rings", 8, "--json").document["results"]
    assert found["field"] == [0, 10]
    np.testing.assert_allclose(found["centroid"], centroid, rtol=0, atol=NANOMETRE)
    assert found["rms_radius_um"] == pytest.approx(1e3 * rms, rel=1e-6)
    assert found["geometric_radius_um"] > found["rms_radius_um"]
    assert found["vignetted"] == 0


def test_spot_counts_vignetted_rays(run):
    Path("clipped.zmx").write_text(TEXT.replace("DIAM 10.229 1 0 0 1", "CLAP 0 6 0\n  DIAM 10.229 1 0 0 1"))
    results = run("spot", "clipped.zmx", "--field", 0, "--json").document["results"]
    assert 0 < results[0]["vignetted"] < results[0]["launched"]
    assert results[0]["rays"] + results[0]["vignetted"] == results[0]["launched"]
    free = run("spot", "double_gauss", "--field", 0, "--json").document["results"]
    assert results[0]["rms_radius_um"] < free[0]["rms_radius_um"]
    Path("closed.zmx").write_text(TEXT.replace("DIAM 10.229 1 0 0 1", "OBSC 0 60 0\n  DIAM 10.229 1 0 0 1"))
    (closed,) = run("spot", "closed.zmx", "--field", 0, "--json").document["results"]
    assert closed["rays"] == 0
    assert closed["rms_radius_um"] is None
    assert closed["geometric_radius_um"] is None
    assert closed["centroid"] == [None, None]
    assert "no ray reaches the image" in run("focus", "closed.zmx").error


@pytest.mark.parametrize("rays", [(), ("--rays", 648)])
def test_a_spot_without_rays_is_a_dash_and_a_warning_says_where_they_end(run, rays):
    found = run("spot", "cooke_triplet", "--field", 0, 80, *rays)
    lines = found.out.splitlines()
    assert lines[-1].split() == ["all", "-", "-", "-", "-"]
    assert lines[-2].split() == ["80", "0.656273", "-", "-", "-", "-", "648"]
    assert "nan" not in found.out
    assert found.err.count("warning") == 1
    assert "field 80 degrees, 0.486133, 0.587562, 0.656273 µm: all 648 rays lost: missed surface 2" in found.err
    *_, lost = run("spot", "cooke_triplet", "--field", 0, 80, *rays, "--json").document["results"]
    assert [lost["rays"], lost["rms_radius_um"], lost["geometric_radius_um"]] == [0, None, None]


def test_focus_reports_a_vignetted_field(run):
    both = run("focus", "cooke_triplet", "--field", 0, 80, "--json")
    assert "field 80 degrees, 0.587562 µm: all 576 rays lost: missed surface 2" in both.err
    # The field on the axis has the points of its pupil in another order.
    alone = run("focus", "cooke_triplet", "--json").document["sensor_after"]
    assert both.document["sensor_after"] == pytest.approx(alone, rel=1e-14)
    assert run("focus", "cooke_triplet", "--field", 80).error.count("no ray reaches the image") == 1


def test_spot_of_every_field_and_wavelength(run):
    results = run("spot", "double_gauss", "--wavelength", 0.486, 0.588, 0.656, "--json").document["results"]
    assert [(r["field"], r["wavelength"]) for r in results] == [
        ([0, y], w) for y in (0, 10, 14) for w in (0.486, 0.588, 0.656)
    ]
    printed = run("spot", "double_gauss", "--wavelength", 0.486, 0.588, 0.656).out.splitlines()
    assert len(printed) == 2 + 3 * (3 + 1)


@pytest.mark.parametrize("sampling", ["gauss", "hexapolar", "square", "sobol", "random"])
def test_samplings_agree(run, sampling):
    """Every rule of the pupil measures the same spot; the seed makes the random ones repeat."""
    arguments = ("spot", "double_gauss", "--field", 10, "--sensor-distance", 57.3, "--sampling", sampling, "--json")
    result = run(*arguments).document["results"]
    exact = run(*arguments[:-3], "--json").document["results"]
    assert result[0]["rms_radius_um"] == pytest.approx(exact[0]["rms_radius_um"], rel=0.1)
    assert run(*arguments).document["results"] == result


# ---------------------------------------------------------------- focus


def test_focus_at_25_m(run):
    document = run("focus", DOUBLE_GAUSS, "--object-distance", 25000, "--json").document
    assert list(document) == ["object_distance", "sensor_before", "sensor_paraxial", "sensor_rms", "sensor_after",
                              "rms_before_um", "rms_after_um", "is_real"]  # fmt: skip
    assert document["object_distance"] == 25000
    assert document["sensor_before"] == 58.5
    assert document["sensor_paraxial"] == pytest.approx(IMAGE_OF_25_M, abs=1e-9)
    assert document["sensor_rms"] == document["sensor_after"] == pytest.approx(57.66201, abs=5e-6)
    assert document["rms_after_um"] == pytest.approx(7.075, abs=5e-4)
    at_paraxial = run("focus", DOUBLE_GAUSS, "--object-distance", 25000, "--criterion", "paraxial", "--json").document
    assert at_paraxial["sensor_after"] == document["sensor_paraxial"]
    assert at_paraxial["sensor_rms"] == document["sensor_rms"]
    assert at_paraxial["rms_after_um"] == pytest.approx(27.16, abs=5e-3)


def test_focus_at_25_m_ray_by_ray(run):
    """The RMS radius before and after, with the rays of an on-axis object traced one by one."""
    document = run("focus", "double_gauss", "--object-distance", 25000, "--json").document
    lens = run("info", "double_gauss", "--json", "--object-distance", 25000).document
    nodes, weights = np.polynomial.legendre.leggauss(12)
    height = 33.33 / 2 * np.sqrt((nodes + 1) / 2)
    depth = lens["entrance_pupil_position"]
    for sensor, expected in (("sensor_before", "rms_before_um"), ("sensor_after", "rms_after_um")):
        surfaces = surfaces_of(lens)
        surfaces[10]["T"] = document[sensor]
        hits = []
        for y in height:
            chord = np.array([0.0, y, depth + 25000.0])
            direction = chord / np.linalg.norm(chord)
            at_vertex = (0.0, y - depth * direction[1] / direction[2], 0.0)
            hits.append(list(reference(surfaces, at_vertex, direction))[-1][1][1])
        rms = math.sqrt((weights / 2) @ np.square(hits))
        assert document[expected] == pytest.approx(1e3 * rms, rel=1e-7)


@pytest.mark.slow
def test_focus_with_weights_equals_brute_force(run):
    """Σ weights · rms² of `raytrace spot` is a parabola in the sensor distance; its vertex is the focus."""
    distances, fields, wavelengths = (10000, 25000, "inf"), (0, 10), (0.486, 0.656)
    weights = {"distance": (1, 2, 0.5), "field": (1, 3), "wavelength": (2, 1)}
    common = ("--field", *fields, "--wavelength", *wavelengths, "--json")

    def merit(sensor):
        total = share = 0.0
        for distance, dw in zip(distances, weights["distance"], strict=True):
            condition = ("--object-distance", distance, "--sensor-distance", repr(sensor))
            for entry in run("spot", "double_gauss", *condition, *common).document["results"]:
                weight = dw * weights["field"][fields.index(entry["field"][1])]
                weight *= weights["wavelength"][wavelengths.index(entry["wavelength"])]
                total, share = total + weight * (1e-3 * entry["rms_radius_um"]) ** 2, share + weight
        return total / share

    low, middle, high = merit(57.0), merit(58.0), merit(59.0)
    vertex = 58.0 - (high - low) / (2 * (high - 2 * middle + low))
    options_of_weights = [word for name, values in weights.items() for word in (f"--{name}-weights", *values)]
    found = run("focus", "double_gauss", "--object-distance", *distances, *options_of_weights, *common).document
    assert found["sensor_rms"] == pytest.approx(vertex, abs=NANOMETRE)
    assert found["rms_after_um"] == pytest.approx(1e3 * math.sqrt(merit(found["sensor_after"])), rel=1e-9)
    assert found["rms_before_um"] == pytest.approx(1e3 * math.sqrt(merit(58.5)), rel=1e-9)
    assert found["object_distance"] == [10000, 25000, None]
    np.testing.assert_allclose(found["sensor_paraxial"][:1], run(
        "info", "double_gauss", "--wavelength", 0.486, "--object-distance", 10000, "--json"
    ).document["paraxial_image_distance"], rtol=1e-13)  # fmt: skip
    plain = run("focus", "double_gauss", "--object-distance", *distances, *common).document
    assert abs(plain["sensor_rms"] - found["sensor_rms"]) > 1e-3


def test_paraxial_criterion_heeds_the_weights(run):
    base = ("focus", "double_gauss", "--object-distance", 10000, 25000, "--criterion", "paraxial", "--json")
    assert run(*base, "--distance-weights", 3, 1).document["sensor_after"] == pytest.approx(
        (3 * IMAGE_OF_10_M + IMAGE_OF_25_M) / 4, abs=1e-9
    )


def test_mean_criterion_is_least_in_its_own_measure(run):
    """Less mean distance from the centroid means more RMS: the two best foci differ, slightly."""
    document = run("focus", "double_gauss", "--object-distance", 25000, "--criterion", "mean", "--json").document
    assert 1e-3 < abs(document["sensor_after"] - document["sensor_rms"]) < 0.1
    assert document["rms_after_um"] > 7.075


@pytest.mark.parametrize(
    ("weights", "count"), [("--field-weights", 1), ("--wavelength-weights", 1), ("--distance-weights", 1)]
)
def test_wrong_number_of_weights(run, weights, count):
    message = run("focus", "double_gauss", weights, 1, 2, 3).error
    assert weights in message
    assert f"expected {count}" in message


@pytest.mark.parametrize("output", ["focused.zmx", "focused.csv"])
def test_focus_writes_the_lens_with_its_new_sensor(run, output):
    """The sensor distance is `sensor_after` bit for bit, every other number the file's own; so is the object's."""
    document = run("focus", DOUBLE_GAUSS, "--object-distance", 25000, "-o", output, "--json").document
    before, after = (run("info", lens, "--json").document for lens in (DOUBLE_GAUSS, output))
    assert after["surfaces"][11]["thickness"] == document["sensor_after"]
    after["surfaces"][11]["thickness"] = 58.5
    for size in ("semi_diameter", "mechanical_semi_diameter"):
        after["surfaces"][12][size] = before["surfaces"][12][size]  # where rays reach
    assert after["surfaces"] == before["surfaces"]
    for name in ("name", "wavelengths", "wavelength_weights", "primary_wavelength", "fields", "aperture",
                 "stop_surface", "effective_focal_length", "back_focal_distance"):  # fmt: skip
        assert after[name] == before[name]
    again = run("focus", output, "--object-distance", 25000, "--json").document
    assert again["sensor_before"] == document["sensor_after"]
    assert again["sensor_after"] == pytest.approx(document["sensor_after"], abs=PICOMETRE)
    assert [path.name for path in Path().iterdir()] == [output]


def test_focus_of_finite_objects_and_object_heights(run):
    """A 1:1 relay: fields are object heights in mm, the image is inverted."""
    Path("relay.zmx").write_text(
        zmx(
            ["STOP; TYPE STANDARD; CURV 0.01; DISZ 1; GLAS N-BK7; DIAM 5", "TYPE STANDARD; CURV -0.01; DISZ 190"],
            head="GCAT SCHOTT",
        )
        .replace("FTYP 0 0", "FTYP 1 0")
        .replace("DISZ INFINITY", "DISZ 190")
    )
    info = run("info", "relay.zmx", "--json").document
    assert info["field_unit"] == "mm"
    result = run("focus", "relay.zmx", "--json").document
    assert result["object_distance"] == 190
    assert result["sensor_paraxial"] == info["paraxial_image_distance"]
    (entry,) = run(
        "spot", "relay.zmx", "--field", 2, "--sensor-distance", result["sensor_paraxial"], "--json"
    ).document["results"]
    assert entry["centroid"][1] == pytest.approx(2 * info["magnification"], rel=0.02)
    assert "object heights" in run("spot", "relay.zmx", "--object-distance", "inf").error


def test_focus_without_a_focus_is_refused(run):
    assert "no focus" in run("focus", "double_gauss", "--sampling", "square", "--points", 1).error
    assert "no ray reaches the image" in run("focus", "double_gauss", "--f-number", 0.1).error
    partly = run("focus", "double_gauss", "--f-number", 0.5, "--json")
    assert partly.code == 0
    assert "rays fail or are vignetted" in partly.err


def test_a_virtual_image_is_reported(run):
    """An object within the focal length of 100 mm: its image lies before the lens."""
    code, out, err = run("focus", "singlet", "--object-distance", "50", "--json")
    found = json.loads(out)
    assert (code, found["is_real"]) == (0, False)
    assert found["sensor_after"] < 0
    assert "warning: the image is virtual, at -548.252 mm" in err
    code, out, err = run("focus", "singlet", "--object-distance", "5000", "--json")
    assert (json.loads(out)["is_real"], "virtual" in err) == (True, False)


def test_focus_for_people(run):
    done = run("focus", "double_gauss", "--object-distance", 25000)
    for text in ("99.514552", "58.500000", "57.662011", "57.881769", "7.0750"):
        assert text in done.out
    assert done.err == ""


# ---------------------------------------------------------------- check, convert, glass


def test_check_reports_every_keyword(run):
    Path("odd.zmx").write_text(TEXT.replace("PFIL 0 0 0", "PFIL 0 0 0\nZZZZ 1 2 3"))
    document = run("check", "odd.zmx", "--json").document
    assert document["surfaces"] == 13
    assert document["stop_surface"] == 6
    assert "ZZZZ" in json.dumps(document)
    keywords = {line.split()[0] for line in Path("odd.zmx").read_text().splitlines() if line.strip()}
    report = run("check", "odd.zmx")
    assert report.code == 0
    assert all(keyword in report.out for keyword in keywords)
    assert "ZZZZ" in run("check", "odd.zmx", "--strict").error
    assert run("check", "double_gauss", "--strict").code == 0
    warned = run("info", "odd.zmx", "--json")
    assert warned.document
    assert "ZZZZ" in warned.err


def test_convert_there_and_back(run):
    for name in ("there.csv", "there.tsv", "there.txt", "there.zmx"):
        done = run("convert", "double_gauss_28deg", name, "--json")
        assert done.document["output"] == name
        assert run("info", name, "--json").document == run("info", "double_gauss_28deg", "--json").document


@pytest.mark.parametrize("output", ["out.foo", "out", "missing/out.zmx", "folder.zmx"])
def test_lenses_that_cannot_be_written(run, output):
    Path("folder.zmx").mkdir()
    for arguments in (("convert", "double_gauss", output), ("focus", "double_gauss", "-o", output)):
        assert output in run(*arguments).error
    assert [path.name for path in Path().rglob("*")] == ["folder.zmx"]


@pytest.mark.parametrize("output", ["missing/out.csv", "folder.csv"])
def test_tables_that_cannot_be_written(run, output):
    Path("folder.csv").mkdir()
    assert output in run("trace", "double_gauss", "-o", output).error
    assert [path.name for path in Path().rglob("*")] == ["folder.csv"]


@pytest.mark.parametrize(
    "arguments",
    [("trace", "double_gauss", "-o"), ("convert", "double_gauss"), ("focus", "double_gauss", "-o")],
    ids=lambda arguments: arguments[0],
)
def test_a_write_that_fails_leaves_the_old_file(run, monkeypatch, arguments):
    Path("out.csv").write_text("old")

    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    done = run(*arguments, "out.csv")
    assert done.code == 1
    assert re.search("raytrace: error: .*out.csv: .*No space left", done.err)
    assert bool(done.out) == (arguments[0] == "focus")  # what was found is printed all the same
    assert Path("out.csv").read_text() == "old"
    assert len(list(Path().iterdir())) == 1


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs named pipes")
@pytest.mark.parametrize(
    "arguments", [("trace", "double_gauss"), ("convert", "double_gauss"), ("focus", "double_gauss")]
)
def test_only_regular_files_are_replaced(run, arguments):
    """-o onto a device or a pipe must not turn it into a file."""
    pipe = Path("pipe.zmx")
    os.mkfifo(pipe)
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)  # a writer that opens the pipe does not wait
    try:
        run(*arguments, *([pipe] if arguments[0] == "convert" else ["-o", pipe]))
        assert pipe.is_fifo()
    finally:
        os.close(reader)


def test_symbolic_links_are_written_through(run):
    Path("real.csv").write_text("old")
    Path("link.csv").symlink_to("real.csv")
    run("trace", "double_gauss", "-o", "link.csv")
    assert Path("link.csv").is_symlink()
    assert Path("real.csv").read_text().startswith("ray,surface,")


def test_glass(run):
    document = run("glass", "SK16", "--wavelength", 0.53, "--json").document
    assert document["name"] == "SK16"
    assert document["catalog"] == "SCHOTT"
    assert document["wavelengths"] == [0.53]
    assert document["indices"][0] == pytest.approx(SK16, abs=6e-11)
    assert document["nd"] == pytest.approx(1.62041, abs=2e-5)
    assert document["vd"] == pytest.approx(60.32, abs=0.05)
    assert document["wavelength_range"][0] < 0.53 < document["wavelength_range"][1]
    printed = run("glass", "SK16").out
    for text in ("SK16", "SCHOTT", "nd", "Vd", "formula", "range"):
        assert text in printed
    code = run("glass", "517642", "--json").document
    assert code["nd"] == pytest.approx(1.517, abs=5e-6)  # the fit goes through lines rounded to 0.1 nm
    assert code["vd"] == pytest.approx(64.2, abs=0.05)
    miss = run("glass", "BK77").error
    assert "N-BK7" in miss
    assert "--catalog" in miss
    assert run("glass", "").error
    assert "no real refractive index" in run("glass", "N-BK7", "--wavelength", 10).error
    assert "expected 3e-05 to 100" in run("glass", "N-BK7", "--wavelength", 1e300).error
    outside = run("glass", "N-BK7", "--wavelength", 5, "--json")
    assert outside.document
    assert "N-BK7" in outside.err


def test_user_catalogs(run, monkeypatch):
    """A glass of one's own: n² = 2.25 by Sellmeier's formula without terms."""
    Path("own.agf").write_text(
        "CC mine\nNM UNOBTAINIUM 2 0 1.5 50.0 0 0\nED 0 0 0 0 0\nCD 1.25 0 0 0 0 0\nTD 0 0 0 0 0 0 20\nLD 0.3 2.5\n"
    )
    Path("lens.zmx").write_text(
        zmx(["STOP; TYPE STANDARD; CURV 0.02; DISZ 4; GLAS UNOBTAINIUM", "TYPE STANDARD; CURV 0; DISZ 98"])
    )
    assert "UNOBTAINIUM" in run("info", "lens.zmx").error
    document = run("info", "lens.zmx", "--catalog", "own.agf", "--json").document
    assert document["surfaces"][1]["indices"] == [pytest.approx(1.5, abs=1e-12)]
    assert document["effective_focal_length"] == pytest.approx(100, rel=1e-12)
    assert run("focus", "lens.zmx", "--catalog", "own.agf", "-o", "focused.zmx").code == 0
    assert "missing.agf" in run("info", "lens.zmx", "--catalog", "missing.agf").error
    assert "bad.agf" in run("info", "lens.zmx", "--catalog", _write("bad.agf", "hello\n")).error
    monkeypatch.setenv("RAYTRACE_CATALOGS", "own.agf")
    assert run("info", "lens.zmx", "--json").document == document
    assert run("glass", "UNOBTAINIUM", "--json").document["nd"] == pytest.approx(1.5, abs=1e-12)


def _write(name: str, text: str) -> str:
    Path(name).write_text(text)
    return name


# ---------------------------------------------------------------- figures


@pytest.mark.parametrize(
    "arguments",
    [
        ("layout", "double_gauss", "--plot"),
        ("spot", "double_gauss", "--field", "0", "--rings", "4", "--plot"),
        ("focus", "double_gauss", "--object-distance", "25000", "--rings", "4", "--plot"),
    ],
    ids=lambda arguments: arguments[0],
)
def test_figures(run, arguments):
    plain = run(*arguments[:-1], "--json") if arguments[0] != "layout" else None
    done = run(*arguments, "figure.png", "--json")
    assert done.code == 0
    assert done.document
    if plain is not None:
        assert done.document == plain.document
    assert Path("figure.png").read_bytes().startswith(b"\x89PNG")
    assert [path.name for path in Path().iterdir()] == ["figure.png"]
    for output in ("figure.foo", "missing/figure.png", "figure"):
        assert output in run(*arguments, output).error
    assert [path.name for path in Path().iterdir()] == ["figure.png"]


@pytest.mark.parametrize("command", ["info", "check", "spot", "focus", "trace"])
@pytest.mark.parametrize("lens", ["hubble", "phone", "cooke_triplet", "retrofocus"])
def test_every_command_writes_strict_json(run, command, lens):
    done = run(command, lens, "--json")
    assert done.code == 0, done.err
    assert done.document


@pytest.mark.skipif(os.name != "posix", reason="closes a descriptor of the shell")
def test_a_closed_standard_output_is_an_error():
    command = f"{sys.executable} -m raytrace --version >&-"
    done = subprocess.run(["sh", "-c", command], capture_output=True, text=True, timeout=120)
    assert done.returncode == 1
    assert done.stderr == ("raytrace: error: output: standard output is closed; send it to a file, or to /dev/null\n")
