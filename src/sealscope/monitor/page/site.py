"""The page as a web application: on this machine only, or with a token.

Nothing is loaded from elsewhere, and whatever comes from the wire is shown as text.
"""

from __future__ import annotations

import asyncio
import json
import math
import re
import socket
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
from sealscope.monitor.page.admission import Admission
from sealscope.monitor.page.connections import BACKLOG, limited_protocol, most_connections
from sealscope.monitor.page.live import DRAWN, PRESSURES, LiveSamples, machine_of
from sealscope.monitor.page.ranking import ranked
from sealscope.monitor.settings import PageSettings, secret_of
from sealscope.monitor.supervisor import Supervisor
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
_HOURS = re.compile(r"[0-9]{1,8}(\.[0-9]{1,8})?")
#: How long a request may take to send its body [s].
_BODY_S = 10.0
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
    listeners, most_listeners = 0, min(_MOST_LISTENERS, most_connections() // 2)
    admission = None if token is None else Admission(token)

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
        name = request.query_params.get("name", "")
        if name not in actuators.plain():
            return JSONResponse({"error": "no such actuator"}, 404)
        span = request.query_params.get("hours", "")
        seconds = float(span) * 3600.0 if _HOURS.fullmatch(span) else None
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
                request.query_params.get("name", ""),
                values.get("mark", ""),
                by_whom=values.get("by", ""),
                text=values.get("text", ""),
            )
        except TimeoutError:
            return JSONResponse({"error": f"a request must have come within {_BODY_S:g} s"}, 408)
        except ValueError as error:
            return JSONResponse({"error": str(error)}, 400)
        return JSONResponse(alarm.plain())

    async def changes(request: Request) -> Response:
        nonlocal listeners
        if listeners >= most_listeners:
            return JSONResponse({"error": "too many listeners"}, 503)
        asked = request.query_params
        name, pressure, drawn = asked.get("actuator", ""), asked.get("pressure", "p_A"), asked.get("drawn", "rms")
        if name and name not in machines:
            return JSONResponse({"error": "no such actuator"}, 404)
        if pressure not in PRESSURES or drawn not in DRAWN:
            return JSONResponse({"error": f"pressure must be one of {PRESSURES}, drawn one of {DRAWN}"}, 400)

        async def lines() -> AsyncIterator[str]:
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
                looking.close()

        class Listening(StreamingResponse):
            """Counts as a listener until it ends, however it ends."""

            async def __call__(self, *connection: Any) -> None:
                nonlocal listeners
                try:
                    await super().__call__(*connection)
                finally:
                    listeners -= 1

        listeners += 1
        return Listening(lines(), media_type="text/event-stream")

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
        status = 200
        if request.method == "POST" and admission is not None:
            address = _address(request)
            if wait := admission.pause_s(address):
                return later(wait)
            try:
                given = parse_qs((await _body(request)).decode("utf-8", "replace")).get("token", [""])[0]
            except (InputError, TimeoutError):
                given = ""
            if admission.admits(address, given):
                answer = RedirectResponse("/", 303)
                answer.set_cookie(
                    _COOKIE,
                    admission.session,
                    max_age=30 * 86_400,
                    secure=request.url.scheme == "https",
                    httponly=True,
                    samesite="strict",
                )
                return answer
            status = 401
        text = (resources.files("sealscope.monitor.page") / "login.html").read_text("utf-8")
        return Response(text, status, media_type="text/html")

    def later(wait: float) -> Response:
        error = f"too many wrong tokens: wait {wait:.0f} s"
        return JSONResponse({"error": error}, 429, {"Retry-After": str(math.ceil(wait))})

    def refused(request: Request) -> Response | None:
        """Return the answer to a request without the token, None where it has it."""
        if admission is None or request.url.path in ("/login", "/login.css"):
            return None
        given, session = request.headers.get("authorization"), request.cookies.get(_COOKIE)
        if given is not None or session is not None:
            address = _address(request)
            if wait := admission.pause_s(address):
                return later(wait)
            if given is not None and admission.admits(address, given.removeprefix("Bearer ")):
                return None
            if session is not None and admission.admits(address, session, session=True):
                return None
        answer: Response
        if request.url.path == "/":
            answer = RedirectResponse("/login", 303)
        else:
            answer = JSONResponse({"error": "a token is needed"}, 401)
        if session is not None:  # of an earlier token: the browser must not go on with it
            answer.delete_cookie(_COOKIE)
        return answer

    routes = [Route(path, file) for path in (*_FILES, *_VENDORED)]
    routes += [
        Route("/login", login, methods=["GET", "POST"]),
        Route("/api/fleet", fleet),
        Route("/api/actuator", actuator),
        Route("/api/mark", mark, methods=["POST"]),
        Route("/api/changes", changes),
        Route("/metrics", metrics),
    ]
    middleware = []
    if settings.host in _LOCAL:  # a name of another site that leads to this machine is refused
        middleware.append(Middleware(TrustedHostMiddleware, allowed_hosts=[*_LOCAL, "[::1]"]))
    application = Starlette(routes=routes, middleware=middleware, exception_handlers={SQLAlchemyError: not_answering})

    async def guard(request: Request, call_next: Callable[[Request], Awaitable[Response]]) -> Response:
        answer = refused(request) or await call_next(request)
        for name, value in _HEADERS.items():
            answer.headers[name] = value
        return answer

    from starlette.middleware.base import BaseHTTPMiddleware

    application.add_middleware(BaseHTTPMiddleware, dispatch=guard)
    return application


def _event(kind: str, values: Mapping[str, Any]) -> str:
    """Return an event of a stream of server-sent events; JSON keeps it on one line."""
    return f"event: {kind}\ndata: {json.dumps(values, allow_nan=False)}\n\n"


def _address(request: Request) -> str:
    return "" if request.client is None else request.client.host


async def _body(request: Request) -> bytes:
    data = b""
    async with asyncio.timeout(_BODY_S):
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
        supervisor: Supervisor,
        waits: Callable[[], tuple[int, int, int]] = lambda: (0, 0, 0),
        live: LiveSamples | None = None,
    ) -> None:
        try:
            import starlette  # noqa: F401 (asked for before the port is taken)
            import uvicorn  # noqa: F401
        except ImportError:
            raise MissingExtra("the page needs starlette and uvicorn: pip install 'sealscope[serve]'") from None
        token = secret_of(settings.token_file, "page.token_file")
        self._actuators, self._host, self.port = actuators, settings.host, settings.port
        self._application = site(actuators, settings, token, waits, live)
        self._socket: socket.socket | None = self._opened()
        self.port = int(self._socket.getsockname()[1])
        self.address = f"http://{settings.host}:{self.port}/"
        self._server: Any = None
        self._thread = supervisor.start("page", self._serve)

    def _opened(self) -> socket.socket:
        try:
            family = socket.AF_INET6 if ":" in self._host else socket.AF_INET
            return socket.create_server((self._host, self.port), family=family, backlog=BACKLOG)
        except OSError as error:
            place = f"{self._host}:{self.port}"
            raise InputError(f"page.port must be free, got {error.strerror or error} ({place})") from None

    def _serve(self) -> None:
        """Serve the page until `leave`; uvicorn closes the socket."""
        import uvicorn

        opened, self._socket = self._socket or self._opened(), None
        config = uvicorn.Config(
            self._application,
            http=limited_protocol(most_connections()),
            ws="none",
            lifespan="off",
            log_config=None,
            access_log=False,
            backlog=BACKLOG,
            timeout_graceful_shutdown=1,
            forwarded_allow_ips=",".join(_LOCAL),
        )
        self._server = uvicorn.Server(config)
        self._server.should_exit = self._actuators.closed
        self._server.run(sockets=[opened])
        if not self._actuators.closed:
            raise RuntimeError("the page's server has ended")

    def leave(self) -> None:
        """Ask the page to end."""
        self._actuators.closed = True
        if self._server is not None:
            self._server.should_exit = True

    def close(self) -> None:
        """End the page."""
        self.leave()
        self._thread.join(timeout=1.0)
        if self._socket is not None:
            self._socket.close()
