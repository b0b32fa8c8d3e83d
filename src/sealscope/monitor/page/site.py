"""The page as a web application: on this machine only, or with a token.

Nothing is loaded from elsewhere, and whatever comes from the wire is shown as text.
"""

from __future__ import annotations

import asyncio
import hashlib
import hmac
import json
import socket
import threading
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping
from contextlib import ExitStack
from importlib import resources
from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qs

from sealscope.errors import InputError, MissingExtra
from sealscope.monitor.actuators import WatchedActuators
from sealscope.monitor.memory.store import away
from sealscope.monitor.outages import DATABASE
from sealscope.monitor.outputs.prometheus import CONTENT_TYPE, metrics_text
from sealscope.monitor.page.live import DRAWN, PRESSURES, LiveSamples, machine_of
from sealscope.monitor.page.ranking import ranked
from sealscope.monitor.settings import PageSettings, secret_of
from sealscope.reporting.template import packaged
from sealscope.storage.plain_values import parse_json

if TYPE_CHECKING:
    from starlette.applications import Starlette
    from starlette.requests import Request
    from starlette.responses import Response

#: Largest body of a request [bytes], and most listeners at a time.
_LARGEST_BODY, _MOST_LISTENERS = 10_000, 200
#: How often listeners are served [s], those who look at an actuator with its last samples too, and how often they get a
#: sign of life without news.
_LOOK_S, _ALIVE_S = 0.3, 15.0
_HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; "
    "img-src 'self' data:; form-action 'self'; frame-ancestors 'none'; base-uri 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
}
#: When to ask again [s].
_LATER = {"Retry-After": "5"}
_COOKIE = "sealscope"
_LOCAL = ("127.0.0.1", "localhost", "::1")
#: Address -> file and kind of what the page is made of.
_FILES = {
    "/": ("page.html", "text/html"),
    "/page.js": ("page.js", "text/javascript"),
    "/live.js": ("live.js", "text/javascript"),
    "/twin.js": ("twin.js", "text/javascript"),
    "/page.css": ("page.css", "text/css"),
    "/login.css": ("page.css", "text/css"),
}
_VENDORED = {
    "/uPlot.js": ("vendor/uPlot.iife.min.js", "text/javascript"),
    "/uPlot.css": ("vendor/uPlot.min.css", "text/css"),
}


def site(
    actuators: WatchedActuators,
    settings: PageSettings,
    token: str | None,
    waits: Callable[[], tuple[int, int, int]] = lambda: (0, 0, 0),
    live: LiveSamples | None = None,
) -> Starlette:
    """Return the application of a monitor; with a token, nothing but the form for it is open without.

    `waits`: returns how many blocks wait to be stored, their bytes, and how often a source had to wait for them;
    `live`: the samples that the service takes, those that are stored alone where there is none.
    """
    from sqlalchemy.exc import SQLAlchemyError
    from starlette.applications import Starlette
    from starlette.middleware import Middleware
    from starlette.middleware.trustedhost import TrustedHostMiddleware
    from starlette.responses import JSONResponse, RedirectResponse, Response, StreamingResponse
    from starlette.routing import Route

    store = actuators.store
    live = live or LiveSamples(store.last_samples)
    machines = {name: machine_of(rig) for name, rig in actuators.rigs.items()}
    listeners = 0

    def file(request: Request) -> Response:
        path = request.url.path
        if path in _VENDORED:
            name, kind = _VENDORED[path]
            return Response(str(packaged(name)), media_type=kind)
        name, kind = _FILES[path]
        return Response((resources.files("sealscope.monitor.page") / name).read_text("utf-8"), media_type=kind)

    def fleet(request: Request) -> Response:
        rows = ranked(actuators.plain(), store.alarms(open_only=True))
        shown = {"actuators": rows, "counters": actuators.counters, "waiting": waits()[0]}
        budget = actuators.false_alarms_per_1000_h
        return JSONResponse({**shown, "outages": actuators.outages.plain(), "false_alarms_per_1000_h": budget})

    def actuator(request: Request) -> Response:
        name = request.path_params["name"]
        if name not in actuators.plain():
            return JSONResponse({"error": "no such actuator"}, 404)
        span = request.query_params.get("hours", "")
        seconds = float(span) * 3600.0 if span.replace(".", "", 1).isdigit() and len(span) < 10 else None
        return JSONResponse(
            {
                "name": name,
                "summary": actuators.plain()[name],
                "machine": machines[name],
                "course": store.course(name, seconds=seconds),
                "alarms": store.alarms(actuator=name)[:50],
                "events": store.last_events(name),
            }
        )

    async def mark(request: Request) -> Response:
        if request.headers.get("x-sealscope") != "mark":  # no form of another site can send it
            return JSONResponse({"error": "the header X-Sealscope is missing"}, 403)
        try:
            values = parse_json(await _body(request))
            if not isinstance(values, dict) or not all(isinstance(value, str) for value in values.values()):
                raise InputError("a mark must be a mapping of texts")
            alarm = await asyncio.to_thread(
                actuators.mark,
                request.path_params["name"],
                values.get("mark", ""),
                by_whom=values.get("by", ""),
                text=values.get("text", ""),
            )
        except ValueError as error:
            return JSONResponse({"error": str(error)}, 400)
        return JSONResponse(alarm.plain())

    async def changes(request: Request) -> Response:
        nonlocal listeners
        if listeners >= _MOST_LISTENERS:
            return JSONResponse({"error": "too many listeners"}, 503)
        asked = request.query_params
        name, pressure, drawn = asked.get("actuator", ""), asked.get("pressure", "p_A"), asked.get("drawn", "rms")
        if name and name not in machines:
            return JSONResponse({"error": "no such actuator"}, 404)
        if pressure not in PRESSURES or drawn not in DRAWN:
            return JSONResponse({"error": f"pressure must be one of {PRESSURES}, drawn one of {DRAWN}"}, 400)

        async def lines() -> AsyncIterator[str]:
            nonlocal listeners
            listeners += 1
            looking = ExitStack()
            try:
                room = bool(name) and await asyncio.to_thread(looking.enter_context, live.looked_at(name))
                if name and not room:
                    yield _event("live", {"name": name, "t": None, "error": "too many others are looked at"})
                seen, pictured, silent = -1, -1, 0.0
                while not await request.is_disconnected() and not actuators.closed:
                    if actuators.changed != seen or silent >= _ALIVE_S:
                        seen, silent = actuators.changed, 0.0
                        yield f"data: {seen}\n\n"
                    if room and live.version(name) != pictured:
                        pictured = live.version(name)
                        yield _event("live", await asyncio.to_thread(live.picture, name, pressure, drawn))
                    await asyncio.sleep(_LOOK_S)
                    silent += _LOOK_S
            finally:
                listeners -= 1
                looking.close()

        return StreamingResponse(lines(), media_type="text/event-stream")

    def metrics(request: Request) -> Response:
        return Response(measured(actuators.plain()), headers={"Content-Type": CONTENT_TYPE})

    def measured(summaries: Mapping[str, Mapping[str, Any]]) -> str:
        return metrics_text(summaries, actuators.counters, actuators.outages.totals(), waits())

    async def not_answering(request: Request, error: Exception) -> Response:
        """Say in the form that was asked for that the database is away, and what is known without it."""
        reason = away(error)
        if reason is None:
            raise error
        actuators.outages.lost(DATABASE, reason)
        text = f"the database does not answer: {reason}"
        if request.url.path == "/metrics":
            return Response(f"# {text}\n{measured({})}", 503, {**_LATER, "Content-Type": CONTENT_TYPE})
        known = {"counters": actuators.counters, "waiting": waits()[0], "outages": actuators.outages.plain()}
        return JSONResponse({"error": text, **known}, 503, _LATER)

    async def login(request: Request) -> Response:
        if request.method == "POST" and token is not None:
            try:
                given = parse_qs((await _body(request)).decode("utf-8", "replace")).get("token", [""])[0]
            except InputError:
                given = ""
            if _same(given, token):
                answer = RedirectResponse("/", 303)
                answer.set_cookie(_COOKIE, _session(token), httponly=True, samesite="strict", max_age=30 * 86_400)
                return answer
            await asyncio.sleep(1.0)
        text = (resources.files("sealscope.monitor.page") / "login.html").read_text("utf-8")
        return Response(text, 401 if request.method == "POST" else 200, media_type="text/html")

    routes = [Route(path, file) for path in (*_FILES, *_VENDORED)]
    routes += [
        Route("/login", login, methods=["GET", "POST"]),
        Route("/api/fleet", fleet),
        Route("/api/actuator/{name}", actuator),
        Route("/api/actuator/{name}/mark", mark, methods=["POST"]),
        Route("/api/changes", changes),
        Route("/metrics", metrics),
    ]
    middleware = []
    if settings.host in _LOCAL:  # a name of another site that leads to this machine is refused
        middleware.append(Middleware(TrustedHostMiddleware, allowed_hosts=[*_LOCAL, "[::1]", "testserver"]))
    application = Starlette(routes=routes, middleware=middleware, exception_handlers={SQLAlchemyError: not_answering})

    async def guard(request: Request, call_next: Callable[[Request], Awaitable[Response]]) -> Response:
        answer: Response
        if token is None or request.url.path in ("/login", "/login.css") or _admitted(request, token):
            answer = await call_next(request)
        elif request.url.path == "/":
            answer = RedirectResponse("/login", 303)
        else:
            answer = JSONResponse({"error": "a token is needed"}, 401)
        for name, value in _HEADERS.items():
            answer.headers[name] = value
        return answer

    from starlette.middleware.base import BaseHTTPMiddleware

    application.add_middleware(BaseHTTPMiddleware, dispatch=guard)
    return application


def _event(kind: str, values: Mapping[str, Any]) -> str:
    """Return an event of a stream of server-sent events; JSON keeps it on one line."""
    return f"event: {kind}\ndata: {json.dumps(values, allow_nan=False)}\n\n"


def _same(given: str, token: str) -> bool:
    return hmac.compare_digest(given.encode(), token.encode())


def _session(token: str) -> str:
    """Return what a browser keeps in place of the token."""
    return hmac.new(token.encode(), b"sealscope session", hashlib.sha256).hexdigest()


def _admitted(request: Request, token: str) -> bool:
    given = request.headers.get("authorization", "").removeprefix("Bearer ")
    return _same(given, token) or _same(request.cookies.get(_COOKIE, ""), _session(token))


async def _body(request: Request) -> bytes:
    data = b""
    async for part in request.stream():
        data += part
        if len(data) > _LARGEST_BODY:
            raise InputError(f"a request must have at most {_LARGEST_BODY} bytes")
    return data


class PageServer:
    """The page, served by a thread of its own until `close`.

    Raises MissingExtra without starlette and uvicorn, InputError where the port is taken or the token cannot be read.
    """

    def __init__(
        self,
        actuators: WatchedActuators,
        settings: PageSettings,
        waits: Callable[[], tuple[int, int, int]] = lambda: (0, 0, 0),
        live: LiveSamples | None = None,
    ) -> None:
        try:
            import starlette  # noqa: F401 (asked for before the port is taken)
            import uvicorn
        except ImportError:
            raise MissingExtra("the page needs starlette and uvicorn: pip install 'sealscope[serve]'") from None
        token = secret_of(settings.token_file, "page.token_file")
        self._actuators = actuators
        family = socket.AF_INET6 if ":" in settings.host else socket.AF_INET
        try:
            self._socket = socket.create_server((settings.host, settings.port), family=family)
        except OSError as error:
            place = f"{settings.host}:{settings.port}"
            raise InputError(f"page.port must be free, got {error.strerror or error} ({place})") from None
        self.port = int(self._socket.getsockname()[1])
        self.address = f"http://{settings.host}:{self.port}/"
        config = uvicorn.Config(
            site(actuators, settings, token, waits, live),
            log_level="warning",
            access_log=False,
            timeout_graceful_shutdown=2,
        )
        self._server = uvicorn.Server(config)
        self._thread = threading.Thread(target=self._server.run, kwargs={"sockets": [self._socket]}, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the page."""
        self._actuators.closed = True
        self._server.should_exit = True
        self._thread.join(timeout=5.0)
        self._socket.close()
