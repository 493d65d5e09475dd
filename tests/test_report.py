"""Reports: numbers are those of the functions, pages and HTML hold them, and every kind of lens has one."""

import html.parser
import json
import re
import zlib
from pathlib import Path

import matplotlib
import pytest
from matplotlib.lines import Line2D

import raytrace as rt
from raytrace.plotting.style import new_figure, text_width
from raytrace.settings import ON_REQUEST, SECTIONS
from raytrace.workshop.document import Document, Grid, Heading, Picture, Section, rows_grid, settled
from raytrace.workshop.pages import _FOOT, ROOM, TALL, _paginated, pdf
from raytrace.workshop.report import KINDS_OF_SECTIONS, BadReport
from raytrace.workshop.web import page

DATE = "2026-11-29"
QUICK = ("first-order", "prescription", "layout", "spots", "field-curves", "distortion")


@pytest.fixture(scope="module")
def report():
    return rt.report("cooke_triplet", only=[*QUICK, "fans", "tolerances"], grade="precision", date=DATE)


def text_of(content: bytes) -> list[str]:
    """The texts of the pages of a PDF file of matplotlib, a line each, decoded by the tables of its fonts."""
    objects = dict(re.findall(rb"(\d+) 0 obj\r?\n(.*?)\r?\nendobj", content, flags=re.DOTALL))

    def stream(entry: bytes) -> bytes:
        found = re.search(rb"stream\r?\n(.*?)\r?\nendstream", entry, flags=re.DOTALL)
        return zlib.decompress(found[1]) if found and b"FlateDecode" in entry else b""

    fonts = {}
    for entry in objects.values():
        for name, number in re.findall(rb"/(F\d+) (\d+) 0 R", entry if b"stream" not in entry else b""):
            table = re.search(rb"/ToUnicode (\d+)", objects[number])
            ranges = re.findall(rb"<(\w+)> <\w+> \[(.*?)\]", stream(objects[table[1]]))
            fonts[name] = {
                int(first, 16) + k: bytes.fromhex(code.decode()).decode("utf-16-be")
                for first, codes in ranges
                for k, code in enumerate(re.findall(rb"<(\w+)>", codes))
            }
    token = re.compile(rb"/(F\d+) [\d.]+ Tf|\(((?:[^()\\]|\\.)*)\)", re.DOTALL)
    escapes = {b"n": b"\n", b"r": b"\r", b"t": b"\t", b"b": b"\b", b"f": b"\f"}
    pages = []
    for body in filter(lambda body: b" Tf" in body, map(stream, objects.values())):
        lines, font = [], b""
        for block in re.findall(rb"BT\n(.*?)\nET", body, flags=re.DOTALL):
            line = ""
            for name, written in token.findall(block):
                font = name or font
                plain = re.sub(rb"\\(.)", lambda m: escapes.get(m[1], m[1]), written, flags=re.DOTALL)
                line += "".join(
                    fonts[font][256 * high + low] for high, low in zip(plain[::2], plain[1::2], strict=True)
                )
            lines.append(line)
        pages.append("\n".join(lines))
    return pages


def results(report, name: str) -> list[dict]:
    return next(s for s in report.document()["sections"] if s["name"] == name)["results"]


def test_every_number_is_that_of_the_function(report):
    lens = rt.read_lens("cooke_triplet")
    expected = {
        "first-order": [rt.info(lens)],
        "spots": [rt.spot(lens)],
        "fans": [rt.ray_fan(lens), rt.opd_fan(lens)],
        "distortion": [rt.distortion(lens, samples=6)],
        "tolerances": [rt.tolerances(lens, grade="precision")],
        "field-curves": [
            rt.field_curvature(lens, samples=6), rt.longitudinal_aberration(lens), rt.lateral_colour(lens, samples=6),
            rt.chromatic_focal_shift(lens),
        ],
    }  # fmt: skip
    for name, functions in expected.items():
        assert results(report, name) == json.loads(json.dumps([one.document() for one in functions])), name


def test_radial_tolerances_are_those_of_the_function():
    lens = rt.read_lens("cooke_triplet")
    options = {"grade": "precision", "radial": True}
    document = rt.report(lens, only=["tolerances"], **options, date=DATE)
    assert results(document, "tolerances") == json.loads(json.dumps([rt.tolerances(lens, **options).document()]))


def test_the_pages_hold_the_numbers_and_are_counted(report):
    content = pdf(report.content)
    pages = text_of(content)
    count = len(re.findall(rb"/Type /Page\b", content))
    assert count == len(pages) > 4
    for number, text in enumerate(pages, 1):
        assert f"page {number} of {count}" in text
        assert DATE in text
    whole = "\n".join(pages)
    for _, figure, _ in rt.info("cooke_triplet").quantities():
        assert figure.lstrip("-") in whole
    for surface in rt.read_lens("cooke_triplet").surfaces[1:-1]:
        curvature = float(surface.curvature or 0)
        assert not curvature or f"{abs(1 / curvature):.6g}" in whole
    rms = rt.spot("cooke_triplet").rms_radius[-1, -1]
    assert f"{1e3 * float(rms):.4f}" in whole


def test_the_contents_name_the_page_of_every_section(report):
    pages = text_of(pdf(report.content))
    lines = pages[0].partition("Contents\n")[2].splitlines()
    count = len(report.content.sections)
    for number, section in enumerate(report.content.sections, 1):
        assert lines[2 * number - 2 : 2 * number] == [str(number), section.title]
        entry = re.compile(rf"{number}\s+{re.escape(section.title)}")
        places = [k for k, text in enumerate(pages, 1) for line in text.splitlines() if entry.fullmatch(line)]
        assert places == [int(lines[2 * count + number - 1])]


def test_titles_of_figures_leave_the_name_of_the_lens_to_the_head(report):
    figures = [
        block.figure for section in report.content.sections for block in section.blocks if hasattr(block, "figure")
    ]
    titles = [" ".join(figure.get_suptitle().split()) for figure in figures]
    assert "Ray fans" in titles
    assert "Field curvature" in titles
    assert {title for title in titles if report.lens.name in title} <= {report.lens.name}


def test_no_text_leaves_the_page_and_no_figure_overlaps_one(report):
    for placed in _paginated(report.content)[0]:
        bottom = 0.0
        for top, piece in placed:
            assert top >= bottom - 1e-6
            bottom = top + piece.height
            for x, _, text, look in piece.texts:
                width = text_width(text, look["fontsize"]) * (1.15 if look.get("weight") == "bold" else 1)
                left = x - width if look.get("ha") == "right" else x
                assert left >= -2, text
                assert left + width <= ROOM + 2, text
            for figure, x, y, scale in piece.pictures:
                wide, tall = 72 * scale * figure.get_size_inches()
                assert x >= -1e-6
                assert x + wide <= ROOM + 1e-6
                assert y + tall <= piece.height
        assert bottom <= TALL + 2 * _FOOT


def test_a_report_is_the_same_twice(report):
    assert pdf(report.content) == pdf(report.content)
    assert page(report.content) == page(report.content)


class Reader(html.parser.HTMLParser):
    """Checks the nesting of tags, and collects what a report has."""

    def __init__(self):
        super().__init__()
        self.open, self.cells, self.links, self.ids, self.sources = [], [], [], set(), []

    def handle_starttag(self, tag, attributes):
        values = dict(attributes)
        if tag not in ("meta", "img", "br"):
            self.open.append(tag)
        self.links += [values["href"]] if tag == "a" else []
        self.ids |= {values["id"]} if "id" in values else set()
        self.sources += [values["src"]] if "src" in values else []
        assert tag not in ("script", "link", "iframe")

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open[-1:] == ["td"]:
            self.cells.append(data)


def test_the_html_file_is_whole_and_refers_to_no_other(report, tmp_path):
    report.save(tmp_path / "report.html")
    content = (tmp_path / "report.html").read_text("utf-8")
    reader = Reader()
    reader.feed(content)
    assert reader.open == []
    assert reader.links == [f"#{section.name}" for section in report.content.sections]
    assert {link[1:] for link in reader.links} <= reader.ids
    figures = [block for s in report.content.sections for block in s.blocks if isinstance(block, Picture)]
    assert len(reader.sources) == len(figures) > 6
    assert all(source.startswith(("data:image/svg+xml;base64,", "data:image/png;base64,")) for source in reader.sources)
    assert not re.search(r"https?://", content)
    assert 'name="viewport"' in content
    rms = rt.spot("cooke_triplet").rms_radius
    assert {f"{1e3 * number:.4f}" for number in rms.flatten().tolist()} <= set(reader.cells)


def test_words_of_a_lens_do_not_become_tags_or_mathematics(tmp_path):
    lens = rt.edit.rename("singlet", "A <b>lens</b> & $x_1$")
    report = rt.report(lens, only=["first-order"], date="")
    assert "<b>" not in page(report.content)
    assert any("A <b>lens</b> & $x_1$" in text for text in text_of(pdf(report.content)))


def zoom():
    rows = [
        {"radius": 60, "thickness": 5, "glass": "N-BK7"}, {"radius": -80, "thickness": 20},
        {"radius": -50, "thickness": 3, "glass": "N-SF5"}, {"radius": 70, "thickness": 60},
    ]  # fmt: skip
    lens = rt.lens(rows, stop=1, entrance_pupil_diameter=8, fields=[0, 3], wavelengths=[0.55])
    return lens.with_configurations(thickness={2: [20.0, 15.0], 4: [60.0, 90.0]})


def test_a_zoom_is_shown_in_all_configurations_or_in_one():
    report = rt.report(zoom(), only=["first-order", "prescription", "layout", "spots"], date=DATE)
    lenses = zoom().configurations
    assert results(report, "first-order") == [rt.info(lens).document() for lens in lenses]
    assert results(report, "spots") == [rt.spot(lens).document() for lens in lenses]
    assert len(results(report, "layout")) == 3  # all superimposed, and each
    spots = next(section for section in report.content.sections if section.name == "spots")
    headings = [block.text for block in spots.blocks if isinstance(block, Heading)]
    assert headings == ["Configuration 1", "Configuration 2"]
    one = rt.report(zoom(), only=["spots"], configuration=2, date=DATE)
    assert results(one, "spots") == [rt.spot(lenses[1]).document()]


@pytest.mark.parametrize(
    ("name", "gaps"),
    [
        ("hubble", {}),
        ("folded_relay", {}),
        ("spectrometer", {"distortion": "all fields are on the axis"}),
    ],
)
def test_mirrors_breaks_and_lenses_without_fields_have_a_report(name, gaps):
    report = rt.report(name, only=QUICK, date=DATE)
    for section in report.content.sections:
        assert gaps.get(section.name, "") in section.gap
        assert "\n" not in section.gap
        assert bool(section.gap) == (section.name in gaps), section
    assert len(text_of(pdf(report.content))) > 1


def test_an_afocal_lens_has_a_report():
    rows = [
        {"radius": 100, "thickness": 6, "glass": "N-BK7"}, {"radius": float("inf"), "thickness": 290},
        {"radius": float("inf"), "thickness": 4, "glass": "N-BK7"}, {"radius": -50, "thickness": 30},
    ]  # fmt: skip
    lens = rt.lens(rows, stop=1, entrance_pupil_diameter=10, fields=[0, 1], wavelengths=[0.5876])
    report = rt.report(lens, only=[*QUICK, "mtf"], date=DATE)
    assert len(report.content.sections) == len(QUICK) + 1
    assert pdf(report.content)


def test_conditions_and_the_lens_as_built_are_listed():
    lens = rt.read_lens("cooke_triplet").with_conditions("efl=100 total_track<=90")
    report = rt.report(
        lens, only=["conditions"], tolerance=True, grade="precision", trials=8, date=DATE, temperatures=None
    )
    names = [section.name for section in report.content.sections]
    assert names == ["conditions", "as-built"]
    (conditions,) = results(report, "conditions")
    by_name = {row["name"]: row for row in conditions["conditions"]}
    assert by_name["efl"]["reached"] == pytest.approx(float(rt.first_order(lens).effective_focal_length), rel=1e-12)
    assert not by_name["efl"]["met"]
    (built,) = results(report, "as-built")
    expected = rt.tolerance(lens, grade="precision", trials=8).document()
    assert built["nominal"] == expected["nominal"]
    assert built["mean"] == expected["mean"]


def test_conditions_of_a_lens_with_a_merit_function_are_listed_once():
    lens = rt.read_lens("cooke_triplet").with_conditions("total_track<=90")
    lens = rt.optimize(lens, merit="spot", vary="curvature", hold=None, cycles=0).lens
    sections = rt.report(lens, only=["conditions"], date=DATE).content.sections
    assert len(sections) == 1
    assert str(sections[0].blocks).count("total_track") == 1


def test_sections_are_chosen_and_counted():
    assert set(KINDS_OF_SECTIONS) == set(SECTIONS)
    assert set(ON_REQUEST) < set(SECTIONS)
    counted = []

    def progress(work, unit):
        counted.append((list(work), unit))
        return work

    report = rt.report(
        "singlet", only=["layout", "first-order", "mtf"], without=["mtf"], also=["seidel"], progress=progress, date=DATE
    )
    names = ["first-order", "layout", "seidel"]
    assert [section.name for section in report.content.sections] == names
    assert counted == [(names, "section")]


def test_warnings_are_notes_once():
    lens = rt.read_lens("double_gauss").at(entrance_pupil_diameter=60.0)
    report = rt.report(lens, only=["first-order", "spots"], date=DATE)
    notes = [b for s in report.content.sections for b in s.blocks if isinstance(b, str) and b.startswith("Note: ")]
    assert notes
    assert len(notes) == len(set(notes))


def test_lines_of_a_figure_wider_than_the_page_reach_its_end():
    figure = new_figure(15, 4)
    figure.add_artist(Line2D([0.1, 0.9], [0.5, 0.5]))
    content = pdf(Document("Title", (), (Section("a", "A", (Picture(settled(figure), "wide"),)),)))
    streams = re.findall(rb"stream\r?\n(.*?)\r?\nendstream", content, flags=re.DOTALL)
    drawn = b"".join(zlib.decompress(stream) for stream in streams if stream.startswith(b"x"))
    assert re.search(rb"108 144 m\n972 144 l", drawn)


def test_long_tables_have_their_head_on_every_page():
    rows = [(str(k), "word " * 30, f"{k / 7:.6f}") for k in range(200)]
    grid = rows_grid(("number", "text", "value"), rows, "rlr")
    pages = text_of(pdf(Document("Title", (), (Section("a", "A", (grid,)),))))
    assert len(pages) > 5
    for text in pages:
        assert "number" in text
    numbers = [line for text in pages for line in text.splitlines() if re.fullmatch(r"0\.\d{6}|\d+\.\d{6}", line)]
    assert numbers == [row[2] for row in rows]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"path": "report.docx"}, r"report\.docx: expected a name that ends in \.pdf, \.html"),
        ({"only": ["spot"]}, "`only=spot`: no such section; did you mean spots?"),
        ({"only": ["spots"], "without": ["spots"]}, "leaves no section"),
        ({"configuration": 3}, "configuration 3: this lens has one configuration"),
    ],
)
def test_wrong_options_are_refused_before_the_work(options, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError, match=message):
        rt.report("singlet", **options)
    assert not [*tmp_path.iterdir()]
    assert issubclass(BadReport, rt.RaytraceError)


def test_the_command_writes_a_report_or_one_line(command):
    code, out, err = command(
        "report", "singlet", "--only", "first-order", "layout", "--date", DATE, "-o", "report.html"
    )
    assert code == 0, err
    assert "written: report.html" in err
    assert "Layout" in out
    assert 'src="data:image' in Path("report.html").read_text("utf-8")
    code, out, err = command("report", "singlet", "-o", "report.txt")
    assert code == 2
    assert "is no report: expected a name that ends in .pdf, .html" in err
    assert not Path("report.txt").exists()


def test_the_style_of_the_user_does_not_change(report):
    before = dict(matplotlib.rcParams)
    pdf(report.content)
    assert dict(matplotlib.rcParams) == before


@pytest.mark.parametrize("lines", range(28, 40))
def test_paragraphs_stay_with_the_table_behind_them(lines):
    grid = rows_grid(("a",), [(str(k),) for k in range(5)], "l")
    sections = Section("a", "A", ("text",) * lines), Section("b", "B", ("first", "second", grid))
    pages = [
        [text for _, piece in placed for _, _, text, _ in piece.texts]
        for placed in _paginated(Document("Title", (), sections))[0]
    ]
    (page,) = (texts for texts in pages if "first" in texts)
    assert {"2   B", "first", "second", "0", "4"} <= {*page}


def test_a_reason_of_all_configurations_is_stated_once():
    report = rt.report("scan_lens", only=["distortion"])
    (section,) = report.content.sections
    assert section.gap.count("all fields are on the axis") == 1
    assert section.gap.startswith("Distortion: nothing to show")


def test_the_tolerances_of_a_report_are_complete():
    report = rt.report("phone", only=["tolerances"], grade="precision")
    (grid,) = (block for block in report.content.sections[0].blocks if isinstance(block, Grid))
    assert len(grid.rows) == len(rt.tolerances(rt.read_lens("phone"), grade="precision")) > 100
