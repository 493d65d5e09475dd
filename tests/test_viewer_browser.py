"""The viewer in a browser: Debian's chromium, driven headless by playwright, and the local server.

pip install '.[view]' playwright; apt-get install chromium; pytest -m browser
"""

import http.client
import json
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from shutil import which

import pytest

import raytrace as rt

pytestmark = pytest.mark.browser

for library in ("starlette", "uvicorn"):
    pytest.importorskip(library, reason=f"the viewer needs {library}: pip install '.[view]'")
playwright = pytest.importorskip("playwright.sync_api", reason="needs playwright: pip install playwright")
CHROMIUM = which("chromium") or which("chromium-browser")
if CHROMIUM is None:
    pytest.skip("needs a browser: apt-get install chromium", allow_module_level=True)

VIEWER = ".raytrace-viewer"
SECONDS = 120_000  # ms: a loaded machine compiles the trace first


class Served:
    """`raytrace view` in a process of its own."""

    def __init__(self, lens: str, folder: Path):
        command = [sys.executable, "-m", "raytrace", "view", lens, "--no-browser", "--json"]
        self.process = subprocess.Popen(
            command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment()
        )
        self.address = json.loads(self.process.stdout.readline())["address"]
        self.port, self.token = re.fullmatch(r"http://127\.0\.0\.1:(\d+)/\?token=(.+)", self.address).groups()

    def end(self) -> tuple[int, str]:
        """Ctrl-C: exit code and what was said."""
        self.process.send_signal(signal.SIGINT)
        _, said = self.process.communicate(timeout=30)
        return self.process.returncode, said

    def request(self, method: str, path: str, body: str | None = None, **headers: str) -> http.client.HTTPResponse:
        connection = http.client.HTTPConnection("127.0.0.1", int(self.port), timeout=60)
        connection.request(method, path, body, {name.replace("_", "-"): value for name, value in headers.items()})
        return connection.getresponse()


def environment() -> dict[str, str]:
    import os

    return {**os.environ, "PYTHONPATH": str(Path(rt.__file__).parents[1])}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    found = tmp_path_factory.mktemp("lenses")
    rt.write_lens(rt.read_lens("cooke_triplet"), found / "triplet.zmx")
    return found


@pytest.fixture(scope="module")
def served(folder):
    found = Served("triplet.zmx", folder)
    yield found
    found.process.kill()
    found.process.communicate()


@pytest.fixture(scope="module")
def browser():
    with playwright.sync_playwright() as driver:
        found = driver.chromium.launch(
            executable_path=CHROMIUM, args=["--headless=new", "--no-sandbox", "--disable-background-networking"]
        )
        yield found
        found.close()


@pytest.fixture
def page(browser, served):
    """A new tab at the address of the viewer, with its numbers; errors of the console fail the test."""
    context = browser.new_context(viewport={"width": 1280, "height": 720})
    tab = context.new_page()
    errors = []
    tab.on("console", lambda message: errors.append(message.text) if message.type == "error" else None)
    tab.on("pageerror", lambda error: errors.append(str(error)))
    tab.goto(served.address)
    tab.wait_for_selector(f"{VIEWER}[data-count]", timeout=SECONDS)
    yield tab
    context.close()
    assert errors == []


def count(page) -> int:
    return int(page.get_attribute(VIEWER, "data-count"))


def settled(page) -> None:
    """Wait until no event is under way and the slower analyses are there."""
    deadline = time.monotonic() + 120
    while time.monotonic() < deadline:
        at = page.get_attribute(VIEWER, "data-settled")
        if at is not None and int(at) == count(page):
            return
        page.wait_for_timeout(50)
    raise AssertionError("the viewer does not settle")


def until(page, condition) -> None:
    deadline = time.monotonic() + SECONDS / 1e3
    while not condition():
        assert time.monotonic() < deadline
        page.wait_for_timeout(20)


def changed(page, action) -> None:
    """Do something, and wait for the new numbers."""
    idle = f"{VIEWER}[aria-busy=false]"
    page.wait_for_selector(idle)
    before = count(page)
    action()
    until(page, lambda: count(page) > before)
    page.wait_for_selector(idle)


def shown(page, name: str) -> float:
    return float(page.get_attribute(f'[data-number="{name}"]', "data-value"))


def cell(page, name: str) -> float:
    return float(page.input_value(f'[data-cell="{name}"]'))


def typed(page, name: str, text: str) -> None:
    page.fill(f'[data-cell="{name}"]', text)
    page.press(f'[data-cell="{name}"]', "Enter")


def agrees(page, lens) -> None:
    """The numbers on the page are the library's."""
    assert shown(page, "EFL") == float(rt.first_order(lens).effective_focal_length)
    spots = 1e3 * rt.spot(lens).whole.rms_radius
    assert [shown(page, f"rms-{f}") for f in range(3)] == pytest.approx(spots.tolist(), rel=1e-7)


@pytest.mark.filterwarnings("ignore::raytrace.tracing.launch.UnfilledStop")
def test_a_slider_is_dragged_and_the_numbers_are_those_of_the_library(page):
    lens = rt.read_lens("cooke_triplet")
    agrees(page, lens)
    before = count(page)
    slider = page.locator('[data-slider="curvature:3"]')
    box = slider.bounding_box()
    middle = box["y"] + box["height"] / 2
    page.mouse.move(box["x"] + box["width"] / 2, middle)
    page.mouse.down()
    for step in range(1, 9):
        page.mouse.move(box["x"] + box["width"] * (0.5 + 0.002 * step), middle)
        page.wait_for_timeout(30)
    page.mouse.up()
    settled(page)
    assert count(page) >= before + 2  # it was redrawn on the way
    assert cell(page, "radius:3") != pytest.approx(-42.65)
    edited = lens.replace(3, radius=cell(page, "radius:3"))
    assert shown(page, "EFL") == pytest.approx(float(rt.first_order(edited).effective_focal_length), rel=1e-7)
    spots = 1e3 * rt.spot(edited).whole.rms_radius
    assert shown(page, "rms-1") == pytest.approx(float(spots[1]), rel=1e-5)
    for figure in ("layout", "spot-0", "spot-2", "fan-0", "fan-2", "mtf", "curvature"):
        assert page.locator(f'svg[data-figure="{figure}"] path').count() > 0
    changed(page, lambda: page.click("text=Undo"))  # the drag is one step
    agrees(page, lens)
    assert page.is_disabled("text=Undo")


@pytest.mark.filterwarnings("ignore::raytrace.tracing.launch.UnfilledStop")
def test_numbers_are_typed_undone_and_redone_by_keys(page):
    lens = rt.read_lens("cooke_triplet")
    changed(page, lambda: typed(page, "thickness:2", "13.5"))
    agrees(page, lens.replace(2, thickness=13.5))
    changed(page, lambda: page.keyboard.press("Control+z"))
    agrees(page, lens)
    assert cell(page, "thickness:2") == pytest.approx(12.93)
    changed(page, lambda: page.keyboard.press("Control+Shift+z"))
    agrees(page, lens.replace(2, thickness=13.5))
    changed(page, lambda: page.click("text=Restore"))
    agrees(page, lens)
    page.focus('[data-slider="thickness:2"]')
    changed(page, lambda: page.keyboard.press("ArrowRight"))
    assert cell(page, "thickness:2") == pytest.approx(12.93 + 12.93 / 1000, rel=1e-6)
    page.focus('[data-cell="thickness:4"]')
    changed(page, lambda: page.keyboard.press("ArrowUp"))
    assert cell(page, "thickness:4") > 2


def test_sizes_of_parts_are_typed_and_freed(page):
    page.get_by_label("all numbers").check()
    cell, zone = page.locator("[data-cell='mechanical_semi_diameter:3']"), page.locator("[data-cell='chip_zone:3']")
    assert "automatic" in cell.get_attribute("class")
    changed(page, lambda: (cell.fill("15.5"), cell.press("Tab")))
    assert "automatic" not in cell.get_attribute("class")
    page.get_by_label("all numbers").uncheck()
    assert (cell.input_value(), zone.count()) == ("15.5", 0)
    changed(page, lambda: (cell.fill(""), cell.press("Tab")))
    assert cell.count() == 0


def test_keys_act_after_a_click_beside_the_controls(page):
    changed(page, lambda: typed(page, "thickness:2", "13.5"))
    page.mouse.click(640, 715)
    page.locator("h1").click()
    changed(page, lambda: page.keyboard.press("Control+z"))
    assert cell(page, "thickness:2") == pytest.approx(12.93)
    changed(page, lambda: page.keyboard.press("Control+Shift+z"))
    assert cell(page, "thickness:2") == 13.5


def test_an_arrow_key_moves_the_sensor_by_a_depth_of_focus_and_a_slider_ends_at_its_ends(page):
    lens = rt.read_lens("cooke_triplet")
    depth = 2e-3 * float(lens.primary) * float(rt.first_order(lens).f_number) ** 2
    last = len(lens.surfaces) - 2
    before = float(lens.surfaces[last].thickness)
    page.focus(f'[data-cell="thickness:{last}"]')
    changed(page, lambda: page.keyboard.press("ArrowUp"))
    assert cell(page, f"thickness:{last}") == pytest.approx(before + depth, rel=1e-7)
    changed(page, lambda: page.keyboard.press("Shift+ArrowDown"))
    assert cell(page, f"thickness:{last}") == pytest.approx(before + 0.9 * depth, rel=1e-7)
    slider = page.locator(f'[data-slider="thickness:{last}"]')
    changed(page, lambda: slider.press("End"))
    slider.press("ArrowRight")
    assert cell(page, f"thickness:{last}") == pytest.approx(before + 50 * depth, rel=1e-7)
    assert "thickness from" in slider.get_attribute("title")


def test_numbers_under_the_pointer_are_those_of_the_figures(page):
    settled(page)
    lens = rt.read_lens("cooke_triplet")
    box = page.locator('svg[data-figure="mtf"]').bounding_box()
    page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    lines = page.inner_text(".readout").splitlines()
    frequency = float(lines[0].removesuffix("/mm"))
    mtf = rt.mtf(lens, frequency)
    for line, tangential, sagittal in zip(lines[1:], mtf.tangential, mtf.sagittal, strict=True):
        read = re.search(r"T ([\d.]+), S ([\d.]+)", line)
        assert float(read[1]) == pytest.approx(float(tangential), abs=0.02)  # of a frequency of three digits
        assert float(read[2]) == pytest.approx(float(sagittal), abs=0.02)
    for figure, unit in (("layout", "mm"), ("spot-0", "µm"), ("fan-1", "µm"), ("curvature", "mm")):
        box = page.locator(f'svg[data-figure="{figure}"]').bounding_box()
        page.mouse.move(box["x"] + 0.4 * box["width"], box["y"] + box["height"] / 2)
        assert unit in page.inner_text(".readout"), figure
    page.mouse.move(2, 2)
    assert page.is_hidden(".readout")


def test_every_control_is_reached_by_tab_and_has_a_name(page):
    page.focus("header button:enabled")
    for _ in range(400):
        page.keyboard.press("Tab")
        if page.evaluate("document.activeElement === document.body"):
            break
    seen = page.evaluate(
        "[...document.querySelectorAll('input:enabled, select, button:enabled')].filter((one) => one.checkVisibility())"
        ".map((one) => one.ariaLabel || one.title || one.textContent || one.closest('label')?.textContent || '')"
    )
    assert len(seen) > 40
    assert all(name.strip() for name in seen)
    assert page.evaluate("[...document.querySelectorAll('svg[role=img]')].every((one) => one.ariaLabel)")
    assert page.evaluate("document.documentElement.scrollWidth <= 1280 && document.documentElement.scrollHeight <= 720")


def test_a_number_that_is_no_number_is_one_message_and_changes_nothing(page):
    before = shown(page, "EFL")
    typed(page, "radius:1", "12abc")
    page.wait_for_selector(".message.wrong")
    assert page.inner_text(".message") == "radius of surface 1: '12abc' is not a number; nothing was changed"
    assert shown(page, "EFL") == before
    assert cell(page, "radius:1") == pytest.approx(37.4)
    assert page.is_disabled("text=Undo")
    page.fill('[data-condition="fields"]', "0, x")
    page.press('[data-condition="fields"]', "Enter")
    page.wait_for_selector("text=fields: 'x' is not a number")
    changed(page, lambda: typed(page, "radius:1", "37"))
    assert page.inner_text(".message") == ""


def test_a_lens_that_loses_all_rays_says_where_and_comes_back(page):
    """Without a field on the axis, where the middle of the beam passes a surface of any curvature."""
    page.fill('[data-condition="fields"]', "8.4, 11.9")
    changed(page, lambda: page.press('[data-condition="fields"]', "Enter"))
    changed(page, lambda: typed(page, "radius:1", "0.01"))
    settled(page)
    assert page.inner_text('[data-number="rms-0"]').strip() == "no ray arrives"
    assert page.locator('p[data-figure="mtf"]').inner_text() == "no MTF"
    changed(page, lambda: page.keyboard.press("Control+z"))
    assert shown(page, "rms-0") > 0
    assert page.locator('svg[data-figure="mtf"]').count() == 1


@pytest.mark.filterwarnings("ignore::raytrace.tracing.launch.UnfilledStop")
def test_conditions_and_comparison(page):
    page.fill('[data-condition="fields"]', "0, 5, 10")
    changed(page, lambda: page.press('[data-condition="fields"]', "Enter"))
    spots = 1e3 * rt.spot(rt.read_lens("cooke_triplet"), fields=[0, 5, 10]).whole.rms_radius
    assert shown(page, "rms-1") == pytest.approx(float(spots[1]), rel=0.05)  # vignetting factors stay with the field
    changed(page, lambda: page.select_option('[aria-label="kind of aperture"]', "image_f_number"))
    page.fill('[data-condition="aperture"]', "5.6")
    changed(page, lambda: page.press('[data-condition="aperture"]', "Enter"))
    assert shown(page, "F/#") == pytest.approx(5.6, rel=1e-12)
    changed(page, lambda: typed(page, "thickness:0", "2000"))
    assert shown(page, "m") < 0
    changed(page, lambda: page.click("text=compare"))
    assert page.locator("path.ghost").count() == 3
    assert page.locator(".was").count() > 3


def test_conditions_of_the_lens_are_added_edited_switched_off_and_removed(page):
    words = lambda: page.eval_on_selector_all(".held input[type=text]", "all => all.map((one) => one.value)")  # noqa: E731
    page.fill('[aria-label="new condition"]', "efl=100 total_track<=120")
    changed(page, lambda: page.press('[aria-label="new condition"]', "Enter"))
    assert words() == ["efl=100", "total_track<=120", ""]
    assert page.inner_text('[data-condition-value="efl=100"]') == "101.181, not met"
    assert page.inner_text('[data-condition-value="total_track<=120"]') == "116.485"
    changed(page, lambda: page.uncheck('[aria-label="condition 2 is met"]'))
    assert page.inner_text('[data-condition-value="total_track<=120"]') == "off"
    page.fill('[aria-label="condition 1"]', "elf=99")
    changed(page, lambda: page.press('[aria-label="condition 1"]', "Enter"))
    assert "did you mean" in page.inner_text(".message") or "nothing to hold" in page.inner_text(".message")
    assert words()[0] == "efl=100"
    changed(page, lambda: page.click('[aria-label="remove condition 2"]'))
    assert words() == ["efl=100", ""]


def test_save_writes_only_where_it_is_told(page, folder):
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    changed(page, lambda: typed(page, "thickness:2", "13.25"))
    page.fill(".path", "triplet.zmx")
    page.click("text=Save")
    page.wait_for_selector("text=triplet.zmx exists")
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before
    page.fill(".path", "edited.seq")
    page.click("text=Save")
    page.wait_for_selector("text=written:")
    assert float(rt.read_lens(folder / "edited.seq").surfaces[2].thickness) == 13.25
    assert {path.name for path in folder.iterdir()} == {*before, "edited.seq"}
    (folder / "edited.seq").unlink()


def test_a_duplicate_of_a_tab_has_a_session_of_its_own(page):
    changed(page, lambda: typed(page, "thickness:2", "14"))
    with page.context.expect_page() as opened:
        page.evaluate("window.open(location.href)")  # with a copy of the storage of the tab
    other = opened.value
    other.wait_for_selector(f"{VIEWER}[data-count]", timeout=SECONDS)
    assert cell(other, "thickness:2") == pytest.approx(12.93)
    page.reload()
    page.wait_for_selector(f"{VIEWER}[data-count]", timeout=SECONDS)
    assert cell(page, "thickness:2") == 14


def test_two_tabs_have_a_session_each_and_a_reload_resumes_its_own(page, browser, served):
    with browser.new_context(viewport={"width": 1280, "height": 720}) as context:
        other = context.new_page()
        other.goto(served.address)
        other.wait_for_selector(f"{VIEWER}[data-count]", timeout=SECONDS)
        changed(page, lambda: typed(page, "thickness:2", "14"))
        changed(other, lambda: typed(other, "thickness:2", "11"))
        assert cell(page, "thickness:2") == 14
        other.reload()
        other.wait_for_selector(f"{VIEWER}[data-count]", timeout=SECONDS)
        assert cell(other, "thickness:2") == 11
        changed(other, lambda: other.click("text=Undo"))
        assert cell(other, "thickness:2") == pytest.approx(12.93)


@pytest.mark.filterwarnings("ignore::raytrace.tracing.launch.UnfilledStop")
def test_variables_are_ticked_and_optimised(page):
    before = shown(page, "rms-1")
    for surface in (1, 2, 3, 4, 6, 7):
        page.check(f'[data-vary="curvature:{surface}"]')
    settled(page)
    page.click("text=Optimise")
    page.wait_for_selector(f"{VIEWER}.running")
    page.wait_for_selector(f"{VIEWER}:not(.running)", timeout=SECONDS)
    page.wait_for_selector("text=optimised:")
    settled(page)
    assert int(page.get_attribute(VIEWER, "data-cycles")) > 3
    assert shown(page, "rms-1") < 0.8 * before
    optimised = shown(page, "EFL")
    changed(page, lambda: page.keyboard.press("Control+z"))
    assert shown(page, "rms-1") == pytest.approx(before)
    changed(page, lambda: page.keyboard.press("Control+y"))
    assert shown(page, "EFL") == optimised


def test_an_optimisation_is_shown_stopped_and_undone_in_one_step(page):
    for name in ("curvature:1", "curvature:2", "curvature:3", "curvature:4", "curvature:6", "thickness:2"):
        page.check(f'[data-vary="{name}"]')
    settled(page)
    page.select_option('[aria-label="merit function"]', "mtf")
    settled(page)
    glass = page.locator('svg[data-figure="layout"] path.glass').first
    before, outline = shown(page, "EFL"), glass.get_attribute("d")
    page.focus('[data-cell="thickness:2"]')
    page.keyboard.press("Control+Enter")
    page.wait_for_selector(f"{VIEWER}.running")
    until(page, lambda: shown(page, "EFL") != before)
    assert int(page.get_attribute(VIEWER, "data-cycles")) > 0
    assert glass.get_attribute("d") != outline
    assert page.evaluate("document.querySelector('.left').inert")
    page.keyboard.press("Control+Enter")
    page.wait_for_selector(f"{VIEWER}:not(.running)", timeout=SECONDS)
    assert re.search("stopped|→", page.inner_text(".message"))  # or its end came first
    settled(page)
    assert shown(page, "EFL") != before
    changed(page, lambda: page.click("text=Undo"))
    assert shown(page, "EFL") == before


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_the_page_follows_the_colour_scheme(browser, served, scheme):
    with browser.new_context(viewport={"width": 1280, "height": 720}, color_scheme=scheme) as context:
        tab = context.new_page()
        tab.goto(served.address)
        tab.wait_for_selector(f"{VIEWER}[data-count]", timeout=SECONDS)
        ground = tab.evaluate("getComputedStyle(document.querySelector('.raytrace-viewer')).backgroundColor")
        assert ground == {"light": "rgb(255, 255, 255)", "dark": "rgb(23, 25, 28)"}[scheme]


# -- the server


def test_no_request_without_the_token_of_another_origin_or_host_is_served(served):
    host, mine = f"127.0.0.1:{served.port}", f"http://127.0.0.1:{served.port}"
    event = json.dumps({"session": "a", "event": {"type": "compare"}})
    with_token = f"?token={served.token}"

    def code(method, path, body=None, **headers):
        return served.request(method, path, body, **headers).status

    assert code("GET", f"/{with_token}") == 200
    assert code("GET", f"/viewer.js{with_token}") == 200
    for path in ("/", "/viewer.js", "/viewer.css", f"/?token={served.token[:-1]}", "/?token="):
        assert code("GET", path) == 403
    for path in (f"/server.py{with_token}", f"/../server.py{with_token}", f"/%2e%2e%2fserver.py{with_token}"):
        assert code("GET", path) in (403, 404)
    assert code("GET", f"/{with_token}", Host="evil.example") == 403
    assert code("GET", f"/{with_token}", Origin="http://evil.example") == 403
    assert code("POST", "/event", event, Origin=mine) == 403
    assert code("POST", f"/event{with_token}", event) == 403
    assert code("POST", f"/event{with_token}", event, Origin="http://evil.example") == 403
    assert code("POST", f"/event{with_token}", event, Origin="null") == 403
    assert code("POST", f"/event{with_token}", event, Origin=mine, Host="evil.example") == 403
    assert code("POST", f"/event{with_token}", event, Origin=mine, Host=host) == 200
    assert code("POST", f"/event{with_token}", "no event", Origin=mine) == 400
    assert code("POST", f"/event{with_token}", "x" * 1_100_000, Origin=mine) == 413
    policy = served.request("GET", f"/{with_token}").getheader("Content-Security-Policy")
    assert "default-src 'none'" in policy
    assert served.request("GET", f"/{with_token}").getheader("Referrer-Policy") == "no-referrer"


def test_malformed_events_are_refused_and_the_server_goes_on(served):
    def posted(text):
        response = served.request(
            "POST", f"/event?token={served.token}", text, Origin=f"http://127.0.0.1:{served.port}"
        )
        return response.status, response.read().decode()

    def event(text):
        return posted(f'{{"session": "malformed", "event": {text}}}')

    for text in ("[" * 100_000, "[]", '{"session": [], "event": {}}', '{"session": "a", "event": [["type", "open"]]}'):
        assert posted(text)[0] == 400
    for text in (
        '{"type": "settle", "field": Infinity}',
        '{"type": "edit", "surface": 1, "quantity": "radius", "value": [1]}',
        '{"type": "fields", "values": "0 1 2", "axis": "kind"}',
        '{"type": "save", "path": "~nosuchuser/x.zmx"}',
        f'{{"type": "wavelengths", "values": {[0.5 + 1e-5 * k for k in range(5000)]}}}',
    ):
        status, reply = event(text)
        assert status == 200, text
        assert json.loads(reply)["message"], text
    assert json.loads(event('{"type": "open"}')[1])["analyses"]["spots"]["rms"]


def test_a_page_without_the_token_shows_nothing(browser, served):
    with browser.new_context() as context:
        tab = context.new_page()
        assert tab.goto(f"http://127.0.0.1:{served.port}/").status == 403
        assert "token" in tab.inner_text("body")


def test_ctrl_c_ends_the_server(folder):
    served = Served("triplet.zmx", folder)
    assert served.request("GET", f"/?token={served.token}").status == 200
    code, said = served.end()
    assert code == 0, said
    assert "the viewer has ended" in said
    assert "Traceback" not in said


def test_a_port_that_is_taken_is_one_message(served, folder):
    command = [sys.executable, "-m", "raytrace", "view", "triplet.zmx", "--no-browser", "--port", served.port]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=120, env=environment())
    assert done.returncode == 1
    assert f"port {served.port} cannot be used" in done.stderr
    assert "Traceback" not in done.stderr


NOTEBOOK = """<!doctype html><body data-jp-theme-light="{light}"><div id="cell"></div><script type="module">
import viewer from "./viewer.js";
const handlers = new Set();
const model = {{
  on: (name, handler) => name === "msg:custom" && handlers.add(handler),
  off: (name, handler) => handlers.delete(handler),
  send: async (content) => {{
    const reply = await window.kernel(content);
    handlers.forEach((handler) => handler(reply, []));
  }},
}};
window.clean = await viewer.render({{ model, el: document.getElementById("cell") }});
window.handlers = handlers;
</script></body>"""


@pytest.fixture
def notebook(browser):
    """A page as a notebook renders the widget, and the widget: messages go to Python as a kernel passes them on."""
    pytest.importorskip("anywidget", reason="needs anywidget: pip install '.[view]'")
    from raytrace.viewer.widget import widget_of

    widget, sent = widget_of(rt.read_lens("cooke_triplet")), []
    widget.send = sent.append

    def kernel(content: dict) -> dict:
        widget._handle_custom_msg(json.loads(json.dumps(content)), [])
        return json.loads(json.dumps(sent.pop()))

    with browser.new_context(viewport={"width": 1280, "height": 720}) as context:
        tab, errors = context.new_page(), []
        tab.on("console", lambda message: errors.append(message.text) if message.type == "error" else None)
        tab.on("pageerror", lambda error: errors.append(str(error)))
        tab.expose_function("kernel", kernel)
        page = NOTEBOOK.format(light="false")
        tab.route("**/dark.html", lambda route: route.fulfill(body=page, content_type="text/html"))
        tab.route("**/viewer.js", lambda route: route.fulfill(body=widget._esm, content_type="text/javascript"))
        tab.goto("http://127.0.0.1:9/dark.html")
        tab.add_style_tag(content=widget._css)
        tab.wait_for_selector(f"{VIEWER}[data-count]", timeout=SECONDS)
        yield tab, widget
        assert errors == []


@pytest.mark.filterwarnings("ignore::raytrace.tracing.launch.UnfilledStop")
def test_the_widget_is_rendered_and_answers_events(notebook):
    tab, widget = notebook
    agrees(tab, rt.read_lens("cooke_triplet"))
    settled(tab)
    changed(tab, lambda: typed(tab, "thickness:2", "13"))
    assert float(widget.lens.surfaces[2].thickness) == 13
    agrees(tab, widget.lens)
    tab.focus('[data-slider="thickness:4"]')
    changed(tab, lambda: tab.keyboard.press("ArrowRight"))
    assert float(widget.lens.surfaces[4].thickness) > 2
    changed(tab, lambda: tab.keyboard.press("Control+z"))
    assert float(widget.lens.surfaces[4].thickness) == 2
    for surface in (1, 2, 3):
        tab.check(f'[data-vary="curvature:{surface}"]')
    settled(tab)
    tab.click("text=Optimise")
    tab.wait_for_selector("text=optimised:", timeout=SECONDS)
    settled(tab)
    agrees(tab, widget.lens)
    assert widget.state.vary == ("curvature:1", "curvature:2", "curvature:3")
    ground = tab.evaluate("getComputedStyle(document.querySelector('.raytrace-viewer')).backgroundColor")
    assert ground == "rgb(23, 25, 28)"  # the theme of the notebook goes before that of the system
    tab.evaluate("document.body.dataset.jpThemeLight = 'true'")
    tab.wait_for_selector(f"{VIEWER}:not(.dark)")
    assert tab.evaluate("[window.clean(), window.handlers.size][1]") == 0


def test_the_widget_answers_events():
    pytest.importorskip("anywidget", reason="needs anywidget: pip install '.[view]'")
    from raytrace.viewer.widget import widget_of

    widget, sent = widget_of(rt.read_lens("cooke_triplet")), []
    widget.send = sent.append
    event = {"type": "edit", "surface": 2, "quantity": "thickness", "value": "13"}
    widget._answer(widget, {"number": 7, "event": event}, [])
    assert sent[0]["number"] == 7
    assert sent[0]["reply"]["analyses"]["spots"]["rms"][0] > 0
    assert float(widget.lens.surfaces[2].thickness) == 13
    assert "export default" in widget._esm
