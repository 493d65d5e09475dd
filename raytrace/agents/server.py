"""The MCP server: lists the tools, and has a worker process run each call. Loads no torch.

A cancelled call, or a call whose client has left, interrupts its worker, which may write what it has so far, as after
Ctrl-C, and ends it after a few seconds.
"""

import argparse
import contextlib
import json
import os
import signal
import sys
from collections.abc import AsyncIterator, Awaitable, Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from raytrace.agents.tools import TOOLS, BadParameter, instructions, tool_of
from raytrace.cli import version
from raytrace.cli.progress import silence
from raytrace.words import RaytraceError, missing_extra

if TYPE_CHECKING:
    import mcp_types
    from anyio.abc import Process
    from anyio.streams.buffered import BufferedByteReceiveStream
    from mcp.server.lowlevel import Server

_GRACE = 3.0  # s between the interrupt of a cancelled call and the end of its process
_LONGEST = 2**28  # bytes of an answer
_MOST = min(4, os.cpu_count() or 1)  # calls at a time

Progress = Callable[[float, float | None, str], Awaitable[None]]


class NoFolder(RaytraceError, ValueError):
    """The folder of the server does not exist."""


class Worker:
    """A process of `agents.worker` in a folder."""

    def __init__(self, process: "Process", lines: "BufferedByteReceiveStream") -> None:
        self.process, self.lines = process, lines

    @classmethod
    async def start(cls, folder: Path) -> "Worker":
        import anyio
        from anyio.streams.buffered import BufferedByteReceiveStream

        package = str(Path(__file__).parents[2])
        paths = [package, *filter(None, [os.environ.get("PYTHONPATH")])]
        process = await anyio.open_process(
            [sys.executable, "-P", "-m", "raytrace.agents.worker", str(folder)],  # -P: imports nothing from here
            stderr=None,
            start_new_session=True,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(paths)},
        )
        assert process.stdout is not None
        return cls(process, BufferedByteReceiveStream(process.stdout))

    async def call(self, request: dict, progress: Progress) -> dict:
        """The result of a request. Raises EndOfStream and BrokenResourceError where the process has ended."""
        assert self.process.stdin is not None
        await self.process.stdin.send(json.dumps(request).encode() + b"\n")
        while True:
            message = json.loads(await self.lines.receive_until(b"\n", _LONGEST))
            if "result" in message:
                return message["result"]
            await progress(*message["progress"])

    async def interrupt(self) -> None:
        """Interrupt the tool that runs, wait for what it writes, and end the process."""
        import anyio

        with anyio.CancelScope(shield=True):
            with anyio.move_on_after(_GRACE), contextlib.suppress(ProcessLookupError, anyio.EndOfStream):
                self.process.send_signal(signal.SIGINT)
                while "result" not in json.loads(await self.lines.receive_until(b"\n", _LONGEST)):
                    pass
            await self.end()

    async def end(self) -> None:
        """End the process, with the compilers that it started."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.process.pid, signal.SIGKILL)
        await self.process.aclose()


class Workers:
    """The processes of a server: a call takes an idle one, or starts one."""

    def __init__(self, folder: Path) -> None:
        import anyio

        self.folder, self.idle = folder, list[Worker]()
        self.limit = anyio.CapacityLimiter(_MOST)

    async def call(self, request: dict, progress: Progress) -> dict:
        import anyio

        async with self.limit:
            worker = self.idle.pop() if self.idle else await Worker.start(self.folder)
            try:
                answer = await worker.call(request, progress)
            except (anyio.EndOfStream, anyio.BrokenResourceError, anyio.IncompleteRead):
                await worker.end()
                return {"text": "the process of the computation has ended, as if out of memory", "is_error": True}
            except BaseException:
                await worker.interrupt()
                raise
            self.idle.append(worker)
            return answer

    async def close(self) -> None:
        while self.idle:
            await self.idle.pop().end()


def server(folder: Path) -> "Server":
    """The server of a folder. Raises MissingExtra, and NoFolder."""
    try:
        import mcp_types
        from mcp.server.lowlevel import Server
    except ModuleNotFoundError as error:
        raise missing_extra("the server of agents", "mcp", error) from error
    if not folder.is_dir():
        raise NoFolder(f"{folder}: no such folder; give one that exists")
    folder = folder.resolve()

    @contextlib.asynccontextmanager
    async def workers(_: Any) -> AsyncIterator[Workers]:
        pool = Workers(folder)
        try:
            yield pool
        finally:
            await pool.close()

    async def tools(context: Any, params: Any) -> "mcp_types.ListToolsResult":
        return mcp_types.ListToolsResult(tools=[mcp_types.Tool.model_validate(tool) for tool in documents()])

    async def call(context: Any, params: "mcp_types.CallToolRequestParams") -> "mcp_types.CallToolResult":
        try:
            tool_of(params.name)
        except BadParameter as error:
            answer: dict[str, Any] = {"text": str(error), "is_error": True}
        else:
            request = {"tool": params.name, "arguments": params.arguments or {}}
            answer = await context.lifespan_context.call(request, context.session.report_progress)
        pictures = [mcp_types.ImageContent(data=data, mime_type="image/png") for data in answer.get("pictures", ())]
        return mcp_types.CallToolResult(
            content=[mcp_types.TextContent(text=answer["text"]), *pictures],
            structured_content=answer.get("document"),
            is_error=answer["is_error"],
        )

    return Server(
        "raytrace",
        version=version(),
        instructions=instructions(),
        lifespan=workers,
        on_list_tools=tools,
        on_call_tool=call,
    )


def documents() -> list[dict]:
    """The tools as the protocol lists them: name, description, schema of the parameters, and whether they write."""
    return [
        {
            "name": tool.name,
            "description": tool.description,
            "inputSchema": tool.schema(),
            "annotations": {
                "readOnlyHint": not tool.writes,
                **({"destructiveHint": True} if tool.writes else {}),
                "openWorldHint": False,
            },
        }
        for tool in TOOLS.values()
    ]


def carry_out(arguments: argparse.Namespace) -> int:
    """Serve standard input and output until they are closed, or print the tools."""
    if arguments.json:
        print(json.dumps({"instructions": instructions(), "tools": documents()}, indent=2, ensure_ascii=False))
        return 0
    silence()
    served = server(Path(arguments.folder))
    import anyio
    from mcp.server.stdio import stdio_server

    async def serve() -> None:
        async with stdio_server() as (requests, answers):
            await served.run(requests, answers, served.create_initialization_options())

    anyio.run(serve)
    return 0
