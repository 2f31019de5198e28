"""The local page of ``stereokit live``: pictures as they come, values under the pointer, and settings that can change.

It listens on the loopback address only. A request whose Host is another name is refused, so that a foreign page whose
name resolves to this machine (DNS rebinding) reads nothing; so is a change of settings that another page sends.
"""

from __future__ import annotations

import asyncio
import json
from collections.abc import Awaitable, Callable
from contextlib import suppress
from importlib.resources import files
from typing import Any

from aiohttp import web

from stereokit import METHODS
from stereokit.errors import OptionError, StereokitError
from stereokit.registry import REFINERS
from stereokit_evaluation.live.engine import Engine

__all__ = ["ADDRESS", "make_app", "serve"]

ADDRESS = "127.0.0.1"
_BOUNDARY = "frame"
_POLICY = (
    "default-src 'none'; img-src 'self' data:; connect-src 'self'; "
    "style-src 'unsafe-inline'; script-src 'unsafe-inline'"
)
_FRESH = {"Cache-Control": "no-store"}
_LARGEST_BODY = 4096  # bytes of a change of settings


class _Signal:
    """An event for any number of waiters: each wait ends at the next `notify`."""

    def __init__(self) -> None:
        self._event = asyncio.Event()

    def notify(self) -> None:
        self._event.set()
        self._event = asyncio.Event()

    async def wait(self, seconds: float) -> None:
        try:
            await asyncio.wait_for(self._event.wait(), seconds)
        except asyncio.TimeoutError:  # not TimeoutError in Python 3.10
            return


def make_app(engine: Engine) -> web.Application:
    """Return the application for an engine; its port is known only when a request comes in.

    Parameters
    ----------
    engine : Engine
        Its ``listener`` is set when the application starts.
    """
    fresh = _Signal()

    @web.middleware
    async def same_machine(request: web.Request, handler: Callable[..., Awaitable[Any]]) -> Any:
        port = request.transport.get_extra_info("sockname")[1] if request.transport is not None else None
        names = {f"{name}:{port}" for name in ("127.0.0.1", "localhost")}
        origin = request.headers.get("Origin")
        if request.host not in names:
            raise web.HTTPForbidden(text=f"this page is {ADDRESS}:{port} only\n")
        if origin is not None and origin not in {f"http://{name}" for name in names}:
            raise web.HTTPForbidden(text="requests of other pages are refused\n")
        response = await handler(request)
        return response

    async def page(request: web.Request) -> web.Response:
        text = (files("stereokit_evaluation.live") / "assets" / "live.html").read_text("utf-8")
        return web.Response(
            text=text,
            content_type="text/html",
            headers={"Content-Security-Policy": _POLICY, "Cache-Control": "no-store"},
        )

    async def pictures(request: web.Request) -> web.StreamResponse:
        response = web.StreamResponse(
            headers={"Content-Type": f"multipart/x-mixed-replace; boundary={_BOUNDARY}", **_FRESH}
        )
        await response.prepare(request)
        with suppress(ConnectionError):  # a page that was closed
            await send(response, request.match_info["name"])
        return response

    async def send(response: web.StreamResponse, name: str) -> None:
        sent: Any = None
        await response.write(f"--{_BOUNDARY}\r\n".encode())
        while not (engine.ended and engine.view is sent):
            view = engine.view
            if view is sent:
                await fresh.wait(1.0)
                continue
            assert view is not None  # the newest one; those between are dropped
            data = view.left if name == "left" else view.disparity
            head = f"Content-Type: image/jpeg\r\nContent-Length: {len(data)}\r\n\r\n"
            # A browser shows a picture when the boundary after it has come, so that comes at once.
            await response.write(head.encode() + data + f"\r\n--{_BOUNDARY}\r\n".encode())
            sent = view

    async def picture(request: web.Request) -> web.Response:
        view = engine.view
        if view is None:
            raise web.HTTPNotFound(text="no frame has been matched yet\n")
        data = view.left if request.match_info["name"] == "left" else view.disparity
        return web.Response(body=data, content_type="image/jpeg", headers=_FRESH)

    async def state(request: web.Request) -> web.Response:
        choices = {"method": list(METHODS), "refiner": sorted(set(REFINERS.names()) - {"file"})}
        return web.json_response({**engine.state(), "choices": choices})

    async def value(request: web.Request) -> web.Response:
        try:
            x, y = (int(request.query.get(name, "")) for name in ("x", "y"))
        except ValueError:
            return web.json_response({"error": "x and y must be integers"}, status=400)
        return _answered(lambda: engine.at(x, y))

    async def change(request: web.Request) -> web.Response:
        try:
            changes = json.loads(await request.text())
        except ValueError:
            changes = None
        if request.content_type != "application/json" or not isinstance(changes, dict):
            return web.json_response({"error": "settings must be a JSON object"}, status=400)
        return _answered(lambda: engine.change(**{str(name): value for name, value in changes.items()}))

    async def begin(app: web.Application) -> None:
        loop = asyncio.get_running_loop()

        def listener() -> None:
            if not loop.is_closed():
                loop.call_soon_threadsafe(fresh.notify)

        engine.listener = listener
        engine.start()

    async def end(app: web.Application) -> None:
        engine.listener = lambda: None
        await asyncio.get_running_loop().run_in_executor(None, engine.close)

    app = web.Application(middlewares=[same_machine], client_max_size=_LARGEST_BODY)
    app.add_routes(
        [
            web.get("/", page),
            web.get("/{name:left|disparity}.mjpg", pictures),
            web.get("/{name:left|disparity}.jpg", picture),
            web.get("/state", state),
            web.get("/value", value),
            web.post("/settings", change),
        ]
    )
    app.on_startup.append(begin)
    app.on_cleanup.append(end)
    return app


def _answered(call: Callable[[], dict[str, Any]]) -> web.Response:
    try:
        return web.json_response(call())
    except StereokitError as error:
        return web.json_response({"error": str(error)}, status=400)


def serve(engine: Engine, port: int, ready: Callable[[str], None], until_end: bool = False) -> None:
    """Serve the page until interrupted, or until the source ends.

    Parameters
    ----------
    engine : Engine
    port : int
        0 takes a free one.
    ready : callable
        Called with the page's address.
    until_end : bool
        Return when the source ends.

    Raises
    ------
    OptionError
        If the port cannot be had.
    """
    asyncio.run(_serve(engine, port, ready, until_end))


async def _serve(engine: Engine, port: int, ready: Callable[[str], None], until_end: bool) -> None:
    runner = web.AppRunner(make_app(engine), access_log=None, shutdown_timeout=1.0)
    await runner.setup()
    try:
        site = web.TCPSite(runner, ADDRESS, port)
        try:
            await site.start()
        except OSError as error:
            raise OptionError(
                f"port {port} cannot be had: {error.strerror or error}; --port 0 takes a free one"
            ) from None
        ready(f"http://{ADDRESS}:{runner.addresses[0][1]}/")
        while not (until_end and engine.ended):
            await asyncio.sleep(0.2)
    finally:
        await runner.cleanup()
