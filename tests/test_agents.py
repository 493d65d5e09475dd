"""The server of agents: its table of tools, its folder, and calls by the SDK's own client."""

import base64
import contextlib
import json
import os
import re
import subprocess
import sys
import time
from pathlib import Path

import pytest

import raytrace as rt
from raytrace.agents.server import documents
from raytrace.agents.tools import TOOLS, BadParameter, instructions
from raytrace.agents.worker import answer
from raytrace.cli import main

ROOT = Path(__file__).parents[1]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """The folder of the tools, next to a file that is none of theirs."""
    (tmp_path / "outside.csv").write_text("radius,thickness\n50,4\n")
    inside = tmp_path / "inside"
    inside.mkdir()
    monkeypatch.chdir(inside)
    return inside


# -- the table


@pytest.mark.parametrize("tool", TOOLS.values(), ids=lambda tool: tool.name)
def test_schemas_are_valid_and_speak_of_parameters_not_of_options(tool):
    schema = tool.schema()
    pytest.importorskip("jsonschema").Draft202012Validator.check_schema(schema)
    texts = [tool.description, *(parameter["description"] for parameter in schema["properties"].values())]
    assert all(texts)
    assert not [text for text in texts if " --" in text or "Ctrl-C" in text or "torchrun" in text]
    assert tool.writes == ("overwrite" in schema["properties"])


def test_schemas_have_units_choices_and_limits():
    schema = TOOLS["spot"].schema()
    properties = schema["properties"]
    assert schema["required"] == ["lens"]
    assert properties["sensor_distance"]["description"].endswith("; unit: mm")
    assert properties["wavelengths"]["items"] == {"type": "number", "exclusiveMinimum": 0}
    assert properties["wavelengths"]["description"].endswith("; unit: µm")
    assert properties["temperature"]["description"].endswith("; unit: °C")
    assert properties["sampling"]["enum"] == ["gauss", "hexapolar", "square", "sobol", "random"]
    assert TOOLS["convert"].schema()["required"] == ["source", "target"]
    assert "`target`" in TOOLS["convert"].description


def test_shared_parameters_have_short_texts_whose_full_ones_are_given_once():
    """An agent pays for the list of tools in every conversation."""
    size = len(json.dumps(documents(), ensure_ascii=False, separators=(",", ":")).encode())
    assert size + len(instructions().encode()) < 66_000
    texts = [TOOLS[name].schema()["properties"]["substitute"]["description"] for name in ("spot", "optimize", "psf")]
    assert len({*texts}) == 1
    assert len(texts[0]) < 60
    full = TOOLS["spot"].schema(in_full=True)["properties"]
    for name in ("substitute", "fields", "ray_aiming", "f_number"):
        assert f"- {name}: {full[name]['description']}" in instructions().splitlines()
    assert "unless `sensor_distance` is given" in instructions()
    seed = TOOLS["spot"].schema()["properties"]["seed"]
    assert seed["default"] == 0


def test_values_are_read_as_those_of_the_command_line():
    arguments = TOOLS["spot"].arguments(
        {"lens": "tessar", "field": [7, [3, -4]], "object_distances": ["inf", 2500], "max_bytes": "2GB", "rings": None}
    )
    assert arguments.fields == [(0, 7), (3, -4)]
    assert arguments.object_distances == [float("inf"), 2500]
    assert (arguments.max_bytes, arguments.rings, arguments.seed) == (2e9, None, 0)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({}, "`lens` is missing"),
        ({"lens": "tessar", "wavelenghts": [0.5]}, "no option `wavelenghts`; did you mean wavelengths"),
        ({"lens": "tessar", "wavelengths": [0]}, "`wavelengths`: '0' is not above 0"),
        ({"lens": "tessar", "wavelengths": []}, "`wavelengths` is an empty list"),
        ({"lens": "tessar", "sampling": "dartboard"}, "`sampling` is 'dartboard'; expected one of gauss"),
        ({"lens": "tessar", "json": "yes"}, "`json` is 'yes'; expected true or false"),
        ({"lens": "tessar", "rings": True}, "`rings` is True; expected a number"),
        ({"lens": "tessar", "vary": [{}]}, "no option `vary`"),
        ({"lens": "tessar", "fields": ["--output=x.csv"]}, "is not a number"),
        ({"lens": "tessar", "f_number": 4, "entrance_pupil_diameter": 9}, "exclude each other"),
    ],
    ids=str,
)
def test_wrong_values_are_refused_in_one_line(values, message):
    with pytest.raises(BadParameter) as refused:
        TOOLS["spot"].arguments(values)
    assert message in str(refused.value)
    assert "\n" not in str(refused.value)


def test_the_command_prints_the_table(capsys):
    assert main(["mcp", "--folder", ".", "--json"]) == 0
    tools = json.loads(capsys.readouterr().out)["tools"]
    assert [tool["name"] for tool in tools] == [*TOOLS]
    assert {tool["name"] for tool in tools if tool["annotations"]["readOnlyHint"]} == {
        *("lenses", "check", "layout", "glass"),
    }


def test_the_page_lists_the_tools():
    table = (
        (ROOT / "docs" / "reference" / "agents.md").read_text("utf-8").partition("| subject |")[2].partition("\n\n")[0]
    )
    assert {*re.findall(r"`(\w+)`", table)} == {*TOOLS}


def test_a_missing_extra_and_a_missing_folder_are_one_line(capsys, monkeypatch, tmp_path):
    pytest.importorskip("mcp")
    assert main(["mcp", "--folder", str(tmp_path / "none")]) == 1
    assert capsys.readouterr().err.endswith("none: no such folder; give one that exists\n")
    monkeypatch.setitem(sys.modules, "mcp_types", None)
    assert main(["mcp", "--folder", str(tmp_path)]) == 1
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert error.endswith("the server of agents needs mcp_types: install it by pip install 'raytrace[mcp]'\n")


def test_the_server_starts_without_torch():
    code = (
        "import sys; from raytrace.agents import server; server.documents();"
        "print({'torch', 'numpy', 'scipy', 'pandas', 'matplotlib'} & {*sys.modules})"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert done.stdout == "set()\n", done.stderr


# -- the folder


def test_numbers_are_those_of_the_function(folder):
    result = answer("spot", {"lens": "tessar", "json": True, "fields": [0, [3, 4]], "wavelengths": [0.55]})
    expected = rt.spot(rt.read_lens("tessar").at(wavelengths=[0.55]), fields=[(0, 0), (3, 4)])
    assert result["document"] == expected.document()
    assert json.loads(result["text"].partition("\n\n")[0]) == expected.document()
    assert not result["is_error"]


def test_a_figure_is_returned_and_not_stored(folder):
    result = answer("layout", {"lens": "tessar"})
    (picture,) = result["pictures"]
    assert base64.b64decode(picture).startswith(b"\x89PNG\r\n\x1a\n")
    assert [*folder.iterdir()] == []
    assert answer("info", {"lens": "tessar"})["pictures"] == []


@pytest.mark.parametrize("name", ["../outside.csv", "a/../../outside.csv", "/etc/passwd", "link.csv", "linked/x.zmx"])
def test_files_outside_are_neither_read_nor_written(folder, name):
    (folder / "link.csv").symlink_to("../outside.csv")
    (folder / "linked").symlink_to("..")
    before = sorted(folder.parent.iterdir())
    for tool, values in (
        ("info", {"lens": name}),
        ("info", {"lens": "tessar", "catalog": [name]}),
        ("lenses", {"folder": name}),
        ("info", {"lens": "tessar", "output": name, "overwrite": True}),
        ("convert", {"source": "tessar", "target": name, "overwrite": True}),
        ("search", {"lens": "tessar", "folder": name, "overwrite": True}),
    ):
        result = answer(tool, values)
        assert result["is_error"]
        assert "is outside the folder of this server" in result["text"]
    assert sorted(folder.parent.iterdir()) == before
    assert (folder.parent / "outside.csv").read_text() == "radius,thickness\n50,4\n"


def test_devices_and_bad_names_are_refused(folder):
    os.mkfifo("pipe.zmx")
    Path("loop.zmx").symlink_to("loop.zmx")
    for name, message in (("pipe.zmx", "is no regular file"), ("loop.zmx", ""), ("a\0b", "is no name of a file")):
        for values in ({"lens": name}, {"lens": "tessar", "output": name, "overwrite": True}):
            result = answer("info", values)
            assert result["is_error"]
            assert message in result["text"]
            assert "\n" not in result["text"]


def test_files_are_replaced_by_request_alone(folder):
    values = {"source": "tessar", "target": "lens.zmx"}
    assert not answer("convert", values)["is_error"]
    Path("lens.zmx").write_text("precious")
    result = answer("convert", values)
    assert result["is_error"]
    assert "lens.zmx exists; give another name, or `overwrite`" in result["text"]
    assert Path("lens.zmx").read_text() == "precious"
    assert not answer("convert", values | {"overwrite": True})["is_error"]
    assert rt.read_lens("lens.zmx").name == rt.read_lens("tessar").name
    Path("minima").mkdir()
    Path("minima/link").symlink_to("../../outside.csv")
    assert "is not empty" in answer("search", {"lens": "tessar", "folder": "minima"})["text"]
    assert "is outside" in answer("search", {"lens": "tessar", "folder": "minima", "overwrite": True})["text"]


def test_errors_are_one_line_without_traceback(folder):
    for values, message in (
        ({"lens": "tesar"}, "did you mean tessar"),
        ({"lens": "tessar", "rays": 100, "output": "rays.csv"}, "`output` needs the rays, and `rays` keeps none"),
    ):
        result = answer("spot", values)
        assert message in result["text"]
        assert result["is_error"]
        assert "\n" not in result["text"]
    assert "ray_aiming real aims them" in answer("spot", {"lens": "cooke_triplet", "rings": 3})["text"]


def test_shipped_lenses_and_files_are_listed(folder):
    answer("convert", {"source": "tessar", "target": "mine.zmx"})
    Path("notes.doc").write_text("")
    Path("sub").mkdir()
    entries = answer("lenses", {"json": True})["document"]["results"]
    assert {"kind": "shipped lens", "name": "tessar", "title": rt.read_lens("tessar").name} in entries
    assert [entry["name"] for entry in entries if entry["kind"] != "shipped lens"] == ["mine.zmx", "sub"]


# -- clients of the SDK


def run(server, session):
    """The result of a session with a client of a server."""
    anyio, mcp = pytest.importorskip("anyio"), pytest.importorskip("mcp")

    async def connected():
        async with mcp.Client(server) as client:
            return await session(client)

    return anyio.run(connected)


SEARCH = {"lens": "tessar", "merit": "spot", "vary": ["curvature thickness"], "hold": ["efl=100"], "starts": 5000}


@pytest.mark.slow
def test_a_cancelled_search_stops_within_seconds_and_reports_progress(folder):
    import anyio

    from raytrace.agents.server import server

    progress = []

    async def report(seconds, total, message):
        progress.append((seconds, message))

    async def session(client):
        await client.call_tool("info", {"lens": "tessar"})  # starts the process
        with anyio.CancelScope() as scope:

            async def stop_later(seconds, total, message):
                await report(seconds, total, message)
                if len(progress) == 4:
                    scope.cancel()

            await client.call_tool("search", SEARCH | {"folder": "minima"}, progress_callback=stop_later)
        cancelled = time.monotonic()
        assert scope.cancelled_caught
        result = await client.call_tool("info", {"lens": "tessar"})
        assert not result.is_error
        return cancelled

    from raytrace.agents import server as module

    ended = []
    end = module.Worker.end

    async def timed(worker):
        await end(worker)
        ended.append((time.monotonic(), worker.process.returncode))

    with contextlib.ExitStack() as stack:
        stack.enter_context(pytest.MonkeyPatch.context()).setattr(module.Worker, "end", timed)
        cancelled = run(server(folder), session)
    assert ended[0][0] < cancelled + 5
    assert ended[0][1] is not None
    assert [seconds for seconds, _ in progress] == sorted({seconds for seconds, _ in progress})
    assert all(message.startswith("search: ") for _, message in progress)


@pytest.mark.slow
def test_a_client_over_stdio(folder):
    """Handshake, list, result, picture, refusal and an unknown tool."""
    mcp = pytest.importorskip("mcp")
    command = mcp.StdioServerParameters(
        command=sys.executable,
        args=["-m", "raytrace", "mcp", "--folder", str(folder)],
        env={"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"},
    )

    async def session(client):
        listed = {tool.name: tool for tool in (await client.list_tools()).tools}
        assert [*listed] == [*TOOLS]
        assert listed["spot"].input_schema == TOOLS["spot"].schema()
        assert "mm" in client.instructions
        spots = await client.call_tool("spot", {"lens": "tessar", "json": True})
        assert spots.structured_content == rt.spot("tessar").document()
        text, picture = (await client.call_tool("layout", {"lens": "tessar"})).content
        assert "Tessar" in text.text
        assert (picture.type, picture.mime_type) == ("image", "image/png")
        for name, values in (("info", {"lens": "../outside.csv"}), ("inof", {})):
            refused = await client.call_tool(name, values)
            assert refused.is_error
            assert "outside the folder" in refused.content[0].text or "did you mean info" in refused.content[0].text

    run(command, session)
    assert [*folder.iterdir()] == []
