"""The viewer behind a local address: an ASGI application of Starlette on 127.0.0.1, ended by Ctrl-C.

A random token is part of the address. Every request needs it, and a `Host` of this machine, so that no name that leads
here from outside is served; an event also needs the page's own `Origin`. Events come by POST and are answered by JSON.
"""

import contextlib
import html
import json
import secrets
import socket
import sys
import warnings
import webbrowser
from collections import OrderedDict
from collections.abc import Awaitable, Callable
from pathlib import Path

import torch

from raytrace.system.lens import Lens
from raytrace.viewer.session import Session
from raytrace.words import missing_extra

STATIC = Path(__file__).parent / "static"
_TYPES = {"viewer.js": "text/javascript", "viewer.css": "text/css"}
_MOST_SESSIONS, _MOST_BYTES, _LONGEST_NAME = 32, 1_000_000, 64


def application(lens: Lens, file: Path | None, token: str, port: int) -> Callable:
    """The ASGI application of a lens. Every tab has a session of its own, which a reload of the tab resumes."""
    from starlette.applications import Starlette
    from starlette.concurrency import run_in_threadpool
    from starlette.middleware.base import BaseHTTPMiddleware
    from starlette.requests import Request
    from starlette.responses import HTMLResponse, JSONResponse, Response
    from starlette.routing import Route

    hosts = {f"127.0.0.1:{port}", f"localhost:{port}"}
    origins = {f"http://{host}" for host in hosts}
    sessions: OrderedDict[str, Session] = OrderedDict()

    async def guard(request: Request, call_next: Callable[[Request], Awaitable[Response]]) -> Response:
        given = request.query_params.get("token", "")
        origin = request.headers.get("origin")
        if request.headers.get("host") not in hosts:
            return Response("refused: the address is not of this machine", 403)
        if not secrets.compare_digest(given.encode(), token.encode()):
            return Response("refused: open the address that `raytrace view` printed, with its token", 403)
        if origin not in origins and (origin is not None or request.method != "GET"):
            return Response("refused: the request comes from another page", 403)
        response = await call_next(request)
        response.headers["Cache-Control"] = "no-store"
        response.headers["Referrer-Policy"] = "no-referrer"
        response.headers["X-Content-Type-Options"] = "nosniff"
        return response

    def page(request: Request) -> Response:
        nonce = secrets.token_urlsafe(16)
        policy = (
            f"default-src 'none'; script-src 'self' 'nonce-{nonce}'; style-src 'self'; connect-src 'self'; "
            "img-src data:; frame-ancestors 'none'; base-uri 'none'; form-action 'none'"
        )
        text = (STATIC / "page.html").read_text(encoding="utf-8")
        title = html.escape(f"{file.name if file else lens.name or 'lens'} – raytrace")
        return HTMLResponse(
            text.format(title=title, token=token, nonce=nonce), headers={"Content-Security-Policy": policy}
        )

    def static(request: Request) -> Response:
        name = request.path_params["name"]
        if name not in _TYPES:
            return Response("no such file", 404)
        return Response((STATIC / name).read_bytes(), media_type=_TYPES[name])

    async def event(request: Request) -> Response:
        body = b""
        async for part in request.stream():
            body += part
            if len(body) > _MOST_BYTES:
                return Response("refused: the event is too long", 413)
        try:
            match json.loads(body):
                case {"session": str(name), "event": dict(happened)} if len(name) <= _LONGEST_NAME:
                    pass
                case _:
                    raise ValueError
        except (ValueError, RecursionError):
            return Response("refused: expected a session and an event as JSON", 400)
        if name not in sessions:
            sessions[name] = Session(lens, file)
        sessions.move_to_end(name)
        while len(sessions) > _MOST_SESSIONS:
            sessions.popitem(last=False)
        return JSONResponse(await run_in_threadpool(sessions[name].answer, happened))

    routes = [Route("/", page), Route("/event", event, methods=["POST"]), Route("/{name}", static)]
    app = Starlette(routes=routes)
    app.add_middleware(BaseHTTPMiddleware, dispatch=guard)
    return app


def serve(lens: Lens, *, file: Path | None = None, port: int = 0, browser: bool = True, as_json: bool = False) -> None:
    """Serve the viewer of a lens until Ctrl-C. Raises MissingExtra, and OSError for a port that is taken."""
    try:
        import uvicorn

        token = secrets.token_urlsafe(24)
        listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            listener.bind(("127.0.0.1", port))
        except OSError as error:
            raise OSError(error.errno, f"port {port} cannot be used: {error.strerror}; choose another") from error
        listener.listen()  # who reads the address may connect at once
        port = listener.getsockname()[1]
        app = application(lens, file, token, port)
    except ModuleNotFoundError as error:
        raise missing_extra("the viewer", "view", error) from error
    address = f"http://127.0.0.1:{port}/?token={token}"
    print(json.dumps({"address": address}) if as_json else f"{address}\nCtrl-C ends the viewer", flush=True)
    if browser:
        webbrowser.open(address)
    warnings.simplefilter("ignore")  # the page lists them as remarks, and sessions share the filters
    torch.set_num_threads(1)  # with more threads small batches wait: measured in docs/reference/viewer.md
    settings = uvicorn.Config(app, log_level="warning", access_log=False, lifespan="off", timeout_graceful_shutdown=1)
    with contextlib.suppress(KeyboardInterrupt):
        uvicorn.Server(settings).run(sockets=[listener])
    print("the viewer has ended", file=sys.stderr)
