"""Damaged files: every reader gives a value or its own one-line error, in 5 s and 500 MB."""

import contextlib
import io
import os
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from mutations import Reader, survive
from PIL import Image
from problems import number
from problems_codev import ACHROMAT, ASPHERE, DOUBLE_GAUSS, EVERYTHING, QUESTAR, THREE_MIRRORS
from problems_configurations import CASES as CONFIGURED
from problems_configurations import scan
from problems_oslo import CONIC, FAR, SINGLET, double_gauss
from problems_oslo import text as oslo_text
from problems_tables import LOWENTHAL, NOCTILUX, summilux
from problems_zemax import archive, file
from problems_zemax_optimization import CONFIGURED as VARIED
from problems_zemax_optimization import MERIT_LINES, RULES, STOP_RULES
from problems_zemax_types import CASES, text

from raytrace.imaging.training import DamagedRun, OtherSettings, Run, load_state, read_state
from raytrace.io import FORMATS, LensFileError, read_lens, read_lens_with_report
from raytrace.io.pictures import PictureError, read_grey
from raytrace.io.ray_tables import RayTableError, read_rays
from raytrace.materials.agf import CatalogError, read_agf
from raytrace.materials.catalogs import UnknownGlass
from raytrace.materials.glass import ImplausibleWavelength, InvalidIndex
from raytrace.maths.arrays import ArrayError, read_npy, read_npz
from raytrace.system.configurations import count
from raytrace.wave_optics.element import Pixels, Rings
from raytrace.wave_optics.height_maps import FORMATS as HEIGHTS
from raytrace.wave_optics.height_maps import HeightMapError, read_heights, write_heights

ROOT = Path(__file__).parents[1]


def from_file(read, path):
    """`read` of the bytes written to a path."""

    def of(content: bytes):
        path.write_bytes(content)
        return read(path)

    return of


def catalogs(folder: Path) -> Reader:
    whole = (ROOT / "glass_catalogs" / "SCHOTT.AGF").read_bytes()
    parts = tuple(whole[: whole.index(b"\nNM", size) + 1] for size in (2_000, 20_000))
    return Reader(parts, from_file(read_agf, folder / "glass.agf"), (CatalogError,))


def heights(suffix: str, folder: Path) -> Reader:
    random = torch.Generator().manual_seed(0)
    drawn = 1e-3 * torch.rand(7, 9, dtype=torch.float64, generator=random)
    maps = [Pixels(drawn, number(0.002)), Pixels(number([[0.0, 1, 0, 1, 1]] * 6), number(0.1))]
    maps += [] if suffix in (".dat", ".grd") else [Rings(drawn[0], number(0.003))]
    path = folder / f"map{suffix}"
    originals = []
    for profile in maps:
        write_heights(profile, path)
        originals.append(path.read_bytes())

    def read(written: Path) -> None:
        for known in ({}, {"pitch": 0.1, "span": (0.0, 1.0)}):
            found = read_heights(written, **known)
            assert bool(torch.isfinite(found.heights).all())
            assert float(found.pitch) > 0

    return Reader(tuple(originals), from_file(read, path), (HeightMapError,))


def pictures(folder: Path) -> Reader:
    drawn = Image.fromarray(np.random.default_rng(0).integers(0, 255, (40, 50, 3), dtype=np.uint8))
    kinds = [("PNG", {}), ("JPEG", {}), ("JPEG", {"progressive": True}), ("BMP", {}), ("TIFF", {})]
    kinds += [("TIFF", {"compression": "tiff_lzw"}), ("TIFF", {"compression": "tiff_deflate"})]
    originals = []
    for mode in ("L", "RGB", "P", "1"):
        for kind, options in kinds:
            if (mode, kind) not in (("P", "JPEG"), ("1", "JPEG")):
                stream = io.BytesIO()
                drawn.convert(mode).save(stream, kind, **options)
                originals.append(stream.getvalue())
    return Reader(tuple(originals), from_file(read_grey, folder / "picture.png"), (PictureError,))


def rays(folder: Path) -> Reader:
    lens = read_lens(ROOT / "lenses" / "double_gauss.zmx")
    coloured = "".join(f"{k}.5,{k},-1e1,0,0.01,0.99995,0.53\n" for k in range(9))
    plain = "".join(f"0,{k},0,0,0,1,,\n" for k in range(6))
    originals = [f"x,y,z,l,m,n,wavelength\n{coloured}", f"x, y, z, l, m, n,,\n{plain}"]

    def read(path: Path) -> None:
        found = read_rays(path, lens)
        count = found.position[0].numel()
        assert found.wavelength is None or found.wavelength.numel() == count
        assert all(bool(torch.isfinite(one).all()) for one in (*found.position, *found.direction))

    errors = (RayTableError, ImplausibleWavelength, InvalidIndex)
    return Reader(tuple(text.encode() for text in originals), from_file(read, folder / "rays.csv"), errors)


def lenses(suffix: str, folder: Path) -> Reader:
    originals = [path.read_bytes() for path in sorted((ROOT / "lenses").glob(f"*{suffix}"))]
    if suffix == ".seq":
        own = [FORMATS[suffix].write(read_lens(name), "lens") for name in ("cooke_triplet", "phone")]
        texts = (ACHROMAT, ASPHERE, DOUBLE_GAUSS.format("PIM", -0.4), EVERYTHING, QUESTAR, THREE_MIRRORS)
        originals += own + [text.encode() for text in texts]
    elif suffix == ".zmx":
        originals += [text(name).encode() for name in CASES]
        configured = (file(**changes, tail=tail) for tail, changes, _ in CONFIGURED.values())
        meant = (file(surface=RULES, stop=STOP_RULES, tail=tail) for tail in (MERIT_LINES, VARIED))
        originals += [one.encode() for one in (scan(), *configured, *meant)]
    else:
        originals += [text.encode() for text in (summilux("No.,R,Nd,νd,d", "No R n V d"), NOCTILUX, LOWENTHAL)]

    def read(path: Path) -> None:
        lens, _ = read_lens_with_report(path)
        for one in range(1, count(lens.operands) + 1):
            with contextlib.suppress(ValueError):  # a configuration that differs in what is not followed
                lens.configuration(one)

    return Reader(tuple(originals), from_file(read, folder / f"lens{suffix}"), (LensFileError, UnknownGlass))


def oslo(folder: Path) -> Reader:
    """Every command that is read, and some that are left out or refused."""
    solved = ("TH 200", "GLA MOD G1 1.564 1.571 1.561; CV 0.02; TH 3", "PK GLA -1; TH 1", "RFL; PU 0.1; PY 0")
    tilts = "DCX 1; DCY 2; DCZ 3; TLA 4; TLB 5; TLC 6; DT -1; RCO"
    picked = "PK CVM -1 .01; PK TH -1 1; TLA 1", "PK CV -1; PK THM -1", "RFH; TLB 45; BEN; TH -10; TOX 0"
    originals = [
        double_gauss("WV 0.48613 0.58756; WV3 0.65627; WW 1 1; WW3 0.5"),
        oslo_text((FAR, "AST; AP CHK 10; TH 0", *CONIC), 'EBR 10\nANG 5\nUNI 25.4\nSNO1 "a // note"'),
        oslo_text((*SINGLET, "AIR; TH 1; TLA 0; DT 1; TCE 7"), "FNO 4; OBH -1e19", tail="CFG NEW; TH 1 2; END"),
        oslo_text((FAR, *solved[1:]), "EBR 2; ANG 1"),
        oslo_text((FAR, f"RD 20; GLA 1.5; TH 2; {tilts}", *picked), "EBR 1"),
        oslo_text((*solved[:2], "RD -50; PY 0"), "NAO 0.02; OBH 3; TELE OFF; DES me", stated="50 3"),
    ]
    path = folder / "lens.len"
    read = from_file(read_lens_with_report, path)
    whole = tuple(one.encode() for one in originals)
    for content in whole:
        read(content)
    return Reader(whole, read, (LensFileError, UnknownGlass))


def archives(folder: Path) -> Reader:
    """The lens and a catalog it names, of both layouts, packed and stored."""
    lens = (ROOT / "lenses" / "singlet.zmx").read_bytes()
    files = {"LENS.CFG": b"1", "LENS.ZMX": lens, "SCHOTT.AGF": catalogs(folder).originals[0]}
    originals = tuple(archive(files, version, packed) for version in (0xEA, 0xEC) for packed in (True, False))
    return Reader(originals, from_file(read_lens_with_report, folder / "lens.zar"), (LensFileError, UnknownGlass))


def checkpoints(folder: Path) -> Reader:
    module = torch.nn.Sequential(torch.nn.Linear(3, 2), torch.nn.Linear(2, 1))
    optimizer = torch.optim.Adam(module.parameters())
    module(torch.ones(3)).sum().backward()
    optimizer.step()
    run = Run(folder / "run", {"a": 1})
    run.save({"step": 3, "module": module.state_dict(), "optimizer": optimizer.state_dict()})
    state = run.checkpoint.read_bytes()

    def read(path: Path) -> None:
        assert load_state(module, read_state(path), path, optimizer) == 3

    return Reader((state,), from_file(read, run.checkpoint), (DamagedRun,))


def logs(folder: Path) -> Reader:
    run = Run(folder / "run", {"a": 1})
    run.append([(k, {"loss": 1.0 / (k + 1), "rate": 1e-3}) for k in range(9)])

    def read(path: Path) -> None:
        run.rows()
        run.drop_rows_from(5)

    return Reader((run.log.read_bytes(),), from_file(read, run.log), (DamagedRun,))


def settings(folder: Path) -> Reader:
    values = {"a": 1, "world": {"b": [1.5, 2]}, "name": "x"}
    run = Run(folder / "run", values)
    written = run.path / "settings.json"
    return Reader(
        (written.read_bytes(),),
        from_file(lambda _: Run(run.path, values), written),
        (DamagedRun, OtherSettings),
    )


def arrays(folder: Path) -> Reader:
    originals = []
    for save in (np.savez, np.savez_compressed):
        stream = io.BytesIO()
        save(stream, heights=np.zeros((9, 9)), pitch=0.1, glass="PMMA")
        originals.append(stream.getvalue())
    return Reader(tuple(originals), read_npz, (ArrayError,))


READERS = {
    "agf": catalogs,
    "zar": archives,
    "len": oslo,
    "pictures": pictures,
    "npz": arrays,
    "rays": rays,
    "checkpoints": checkpoints,
    "logs": logs,
    "settings": settings,
    **{f"lenses{suffix}": lambda folder, suffix=suffix: lenses(suffix, folder) for suffix in (".zmx", ".csv", ".seq")},
    **{f"heights{suffix}": lambda folder, suffix=suffix: heights(suffix, folder) for suffix in HEIGHTS},
}


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow if name == "lenses.seq" else ()) for name in READERS]
)
def test_damaged_files_are_read_or_refused(name, tmp_path, capfd):
    read, refused = survive(READERS[name](tmp_path), 200, seed=1)
    assert read  # unread files would test nothing
    assert refused
    capfd.readouterr()  # libtiff speaks to the terminal


@pytest.mark.slow
@pytest.mark.parametrize("name", READERS)
def test_very_many_damaged_files_are_read_or_refused(name, tmp_path, capfd):
    survive(READERS[name](tmp_path), 7_000, seed=2)
    capfd.readouterr()


# -- files that were written to harm ----------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_a_small_file_that_unpacks_to_gigabytes_is_refused_undecoded(suffix, tmp_path):
    path = tmp_path / f"bomb{suffix}"
    options = {"compression": "tiff_deflate"} if suffix == ".tif" else {}
    stream = io.BytesIO()
    Image.new("1", (9_000, 9_000)).save(stream, "PNG" if suffix == ".png" else "TIFF", **options)
    path.write_bytes(stream.getvalue())
    assert path.stat().st_size < 80_000
    with pytest.raises(PictureError, match="9000 × 9000 pixels in"):
        read_grey(path)
    with pytest.raises(HeightMapError, match="9000 × 9000 pixels in"):
        read_heights(path)


def test_an_array_that_announces_more_than_follows_is_refused():
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(stream, {"descr": "<f8", "fortran_order": False, "shape": (10**6, 10**6)})
    with pytest.raises(ArrayError, match="announced, but only 0 bytes follow"):
        read_npy(stream.getvalue())


def test_an_archive_is_no_npy_and_a_bomb_no_npz(tmp_path):
    path = tmp_path / "map.npy"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a.npy", b"")
    with pytest.raises(HeightMapError, match=r"map\.npy: is no \.npy file"):
        read_heights(path)
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a.npy", bytes(10**6))
    content = bytearray(stream.getvalue())
    entry = content.index(b"PK\x01\x02")
    content[entry + 24 : entry + 28] = (2**32 - 2).to_bytes(4, "little")  # announces 4 GB
    with pytest.raises(ArrayError):
        read_npz(bytes(content))


def test_arrays_round_trip(tmp_path):
    given = {"heights": np.arange(6.0).reshape(2, 3), "by_columns": np.asfortranarray(np.eye(3, 2)), "glass": "PMMA"}
    np.savez_compressed(tmp_path / "a.npz", empty=np.zeros((0, 3)), **given)
    found = read_npz((tmp_path / "a.npz").read_bytes())
    assert found.keys() == {"empty", *given}
    assert all(np.array_equal(found[name], given[name]) for name in given)
    np.save(tmp_path / "a.npy", np.array([{}]), allow_pickle=True)
    with pytest.raises(ArrayError, match="expected numbers"):
        read_npy((tmp_path / "a.npy").read_bytes())


def test_a_map_of_one_pixel_without_a_pitch_is_asked_for_it(tmp_path):
    (tmp_path / "map.csv").write_text("x_mm,y_mm,sag_mm\n0,0,1e-3\n")
    with pytest.raises(HeightMapError, match="give pitch in mm"):
        read_heights(tmp_path / "map.csv")


@pytest.mark.parametrize("read", [read_heights, read_grey, read_agf])
def test_a_pipe_is_refused_and_not_waited_for(read, tmp_path):
    os.mkfifo(tmp_path / "pipe.png")
    with pytest.raises((HeightMapError, PictureError, CatalogError), match="not a regular file"):
        read(tmp_path / "pipe.png")


def test_a_damaged_checkpoint_is_named_and_nothing_in_it_is_run(tmp_path):
    path = tmp_path / "checkpoint.pt"
    torch.save({"step": 1, "weights": torch.zeros(3)}, path)
    assert read_state(path)["step"] == 1
    content = path.read_bytes()
    at = content.index(bytes(12), content.index(b"data/0"))
    path.write_bytes(content[: at + 5] + b"\1" + content[at + 6 :])  # one bit of a weight
    with pytest.raises(DamagedRun, match=r"checkpoint\.pt: .*checksum.*remove it"):
        read_state(path)
    torch.save({"step": 1, "run": os.getcwd}, path)
    with pytest.raises(DamagedRun, match="not a readable checkpoint"):
        read_state(path)
    torch.save({"step": 1, "module": {}}, path)
    with pytest.raises(DamagedRun, match="not a checkpoint of this run"):
        load_state(torch.nn.Linear(1, 1), read_state(path), path)
