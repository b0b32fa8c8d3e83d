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
from contextlib import ExitStack, suppress
from importlib import resources
from typing import Any
from urllib.parse import parse_qs

import uvicorn
from sqlalchemy.exc import SQLAlchemyError
from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.middleware.base import BaseHTTPMiddleware
from starlette.middleware.trustedhost import TrustedHostMiddleware
from starlette.requests import Request
from starlette.responses import JSONResponse, RedirectResponse, Response, StreamingResponse
from starlette.routing import Route

from sealscope.errors import InputError
from sealscope.monitor.actuators import WatchedActuators
from sealscope.monitor.alarms import ranked
from sealscope.monitor.database.store import outage_reason
from sealscope.monitor.outputs.prometheus import CONTENT_TYPE, metrics_text
from sealscope.monitor.page.guard import BACKLOG, Admission, limited_protocol, most_connections
from sealscope.monitor.page.live import DRAWN, PRESSURES, LiveSamples, machine_of
from sealscope.monitor.settings import PageSettings, secret_of
from sealscope.monitor.supervisor import DATABASE
from sealscope.reporting.template import packaged
from sealscope.storage.plain_values import parse_json

#: Largest body of a request [bytes], how long it may take to come [s], and most listeners at a time.
_LARGEST_BODY, _BODY_S, _MOST_LISTENERS = 10_000, 10.0, 200
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
#: When to ask again [s].
_LATER = {"Retry-After": "5"}
_COOKIE = "sealscope"
_LOCAL = ("127.0.0.1", "localhost", "::1")
#: Address -> file and kind of what the page is made of.
_FILES = {
    "/": ("page.html", "text/html"),
    **{f"/{name}": (name, "text/javascript") for name in ("page.js", "live.js", "twin.js")},
    **dict.fromkeys(("/page.css", "/login.css"), ("page.css", "text/css")),
    "/uPlot.js": ("vendor/uPlot.iife.min.js", "text/javascript"),
    "/uPlot.css": ("vendor/uPlot.min.css", "text/css"),
}
#: Address -> name of the method that answers, and what it is asked by.
_ROUTES = {
    **{path: ("file", "GET") for path in _FILES},
    "/login": ("login", "GET POST"),
    "/api/fleet": ("fleet", "GET"),
    "/api/actuator": ("actuator", "GET"),
    "/api/mark": ("mark", "POST"),
    "/api/changes": ("changes", "GET"),
    "/metrics": ("metrics", "GET"),
}
#: Returns how many blocks wait to be stored, their bytes, and how often a source had to wait for them.
Waits = Callable[[], tuple[int, int, int]]


def site(
    actuators: WatchedActuators,
    settings: PageSettings,
    token: str | None,
    waits: Waits = lambda: (0, 0, 0),
    live: LiveSamples | None = None,
) -> Starlette:
    """Return the application of a monitor; with a token, nothing but the form for it is open without.

    `live`: the samples that the service takes, those that are stored alone where there is none.
    """
    pages = _Pages(actuators, token, waits, live or LiveSamples(actuators.store.last_samples))
    routes = [Route(path, getattr(pages, name), methods=ways.split()) for path, (name, ways) in _ROUTES.items()]
    middleware = [Middleware(BaseHTTPMiddleware, dispatch=pages.guard)]
    if settings.host in _LOCAL:  # a name of another site that leads to this machine is refused
        middleware.append(Middleware(TrustedHostMiddleware, allowed_hosts=[*_LOCAL, "[::1]"]))
    handlers: Any = {SQLAlchemyError: pages.not_answering}
    return Starlette(routes=routes, middleware=middleware, exception_handlers=handlers)


class _Pages:
    """The answers of the page: each method one address of `_ROUTES`."""

    def __init__(self, actuators: WatchedActuators, token: str | None, waits: Waits, live: LiveSamples) -> None:
        self._actuators, self._store, self._waits, self._live = actuators, actuators.store, waits, live
        self._supervisor = actuators.supervisor
        self._machines = {name: machine_of(settings.rig) for name, settings in actuators.settings.items()}
        # times of files are those of their logger's clock, whatever the browser's zone
        self._by_files = {name for name, settings in actuators.settings.items() if settings.folder is not None}
        self._listeners, self._most_listeners = 0, min(_MOST_LISTENERS, most_connections() // 2)
        self._admission = None if token is None else Admission(token)

    def file(self, request: Request) -> Response:
        name, kind = _FILES[request.url.path]
        return Response(str(packaged(name)) if name.startswith("vendor/") else _read_packaged(name), media_type=kind)

    def _counters_and_outages(self) -> dict[str, Any]:
        """Return the counters, waiting blocks and outages, which need no database."""
        counters, outages = self._actuators.counters, self._supervisor.outages()
        return {"counters": counters, "waiting": self._waits()[0], "outages": outages}

    def fleet(self, request: Request) -> Response:
        rows = ranked(self._actuators.plain(), self._store.alarms(open_only=True))
        rows = [{**row, "by_files": row["name"] in self._by_files} for row in rows]
        budget = self._actuators.false_alarms_per_1000_h
        return JSONResponse({"actuators": rows, **self._counters_and_outages(), "false_alarms_per_1000_h": budget})

    def actuator(self, request: Request) -> Response:
        name, span = request.query_params.get("name", ""), request.query_params.get("hours", "")
        summary = self._actuators.plain().get(name)
        if summary is None:
            return _refusal("no such actuator", 404)
        settings = self._actuators.settings[name]
        seconds = float(span) * 3600.0 if _HOURS.fullmatch(span) else None
        life = {
            "name": name,
            "summary": summary,
            "machine": self._machines[name],
            "by_files": name in self._by_files,
            "course": self._store.course(name, seconds=seconds),
            "events": self._store.last_events(name),
            "limit_lpm": settings.error_lpm or settings.warning_lpm or None,
            "alarms": self._store.alarms(actuator=name)[:50],
        }
        return JSONResponse(life)

    async def mark(self, request: Request) -> Response:
        if request.headers.get("x-sealscope") != "mark":  # no form of another site can send it
            return _refusal("the header X-Sealscope is missing", 403)
        name = request.query_params.get("name", "")
        try:
            values = parse_json(await _body(request))
            if not isinstance(values, dict) or not all(isinstance(value, str) for value in values.values()):
                raise InputError("a mark must be a mapping of texts")
            note = {"by_whom": values.get("by", ""), "text": values.get("text", "")}
            alarm = await asyncio.to_thread(self._actuators.mark, name, values.get("mark", ""), **note)
        except TimeoutError:
            return _refusal(f"a request must have come within {_BODY_S:g} s", 408)
        except ValueError as error:
            return _refusal(str(error), 400)
        return JSONResponse(alarm.plain())

    async def changes(self, request: Request) -> Response:
        if self._listeners >= self._most_listeners:
            return _refusal("too many listeners", 503)
        parameters = request.query_params
        name, pressure, drawn = (
            parameters.get("actuator", ""),
            parameters.get("pressure", "p_A"),
            parameters.get("drawn", "rms"),
        )
        if name and name not in self._machines:
            return _refusal("no such actuator", 404)
        if pressure not in PRESSURES or drawn not in DRAWN:
            return _refusal(f"pressure must be one of {PRESSURES}, drawn one of {DRAWN}", 400)
        self._listeners += 1
        return _Listening(self._lines(request, name, pressure, drawn), self._remove_listener)

    def _remove_listener(self) -> None:
        self._listeners -= 1

    async def _lines(self, request: Request, name: str, pressure: str, drawn: str) -> AsyncIterator[str]:
        """Yield server-sent events: numbers where something has changed, and pictures of an actuator's samples."""
        live, actuators = self._live, self._actuators
        with ExitStack() as looking:
            admitted = bool(name) and await asyncio.to_thread(looking.enter_context, live.looked_at(name))
            if name and not admitted:
                yield _event("live", {"name": name, "t": None, "error": "too many others are looked at"})
            shown, pictured, silent = -1, -1, 0.0
            while not await request.is_disconnected() and not actuators.closed:
                if actuators.changed != shown or silent >= _ALIVE_S:
                    shown, silent = actuators.changed, 0.0
                    yield f"data: {shown}\n\n"
                if admitted and live.version(name) != pictured:
                    pictured = live.version(name)
                    yield _event("live", await asyncio.to_thread(live.picture, name, pressure, drawn))
                await asyncio.sleep(_LOOK_S)
                silent += _LOOK_S

    def metrics(self, request: Request) -> Response:
        return Response(self._render_metrics(self._actuators.plain()), media_type=CONTENT_TYPE)

    def _render_metrics(self, summaries: Mapping[str, Mapping[str, Any]]) -> str:
        return metrics_text(summaries, self._actuators.counters, self._supervisor.totals(), self._waits())

    async def not_answering(self, request: Request, error: Exception) -> Response:
        """Answer in the requested form if the database is away, with the values known without it."""
        reason = outage_reason(error)
        if reason is None:
            raise error
        self._supervisor.part(DATABASE).begin_outage(reason)
        text = f"the database does not answer: {reason}"
        if request.url.path == "/metrics":
            return Response(f"# {text}\n{self._render_metrics({})}", 503, {**_LATER, "Content-Type": CONTENT_TYPE})
        return JSONResponse({"error": text, **self._counters_and_outages()}, 503, _LATER)

    async def login(self, request: Request) -> Response:
        status, admission, address = 200, self._admission, _address(request)
        if request.method == "POST" and admission is not None:
            if wait := admission.pause_s(address):
                return _later(wait)
            token = ""
            with suppress(InputError, TimeoutError):
                token = parse_qs((await _body(request)).decode("utf-8", "replace")).get("token", [""])[0]
            if admission.admits(address, token):
                answer = RedirectResponse("/", 303)
                secure, longest = request.url.scheme == "https", 30 * 86_400
                answer.set_cookie(_COOKIE, admission.session, longest, secure=secure, httponly=True, samesite="strict")
                return answer
            status = 401
        return Response(_read_packaged("login.html"), status, media_type="text/html")

    def _find_refusal(self, request: Request) -> Response | None:
        """Return the refusal of a request without the token, None if it has the token."""
        admission = self._admission
        if admission is None or request.url.path in ("/login", "/login.css"):
            return None
        authorization, session = request.headers.get("authorization"), request.cookies.get(_COOKIE)
        if authorization is not None or session is not None:
            address = _address(request)
            if wait := admission.pause_s(address):
                return _later(wait)
            if authorization is not None and admission.admits(address, authorization.removeprefix("Bearer ")):
                return None
            if session is not None and admission.admits(address, session, session=True):
                return None
        is_page = request.url.path == "/"
        answer: Response = RedirectResponse("/login", 303) if is_page else _refusal("a token is needed", 401)
        if session is not None:  # of an earlier token: the browser must not go on with it
            answer.delete_cookie(_COOKIE)
        return answer

    async def guard(self, request: Request, call_next: Callable[[Request], Awaitable[Response]]) -> Response:
        answer = self._find_refusal(request) or await call_next(request)
        answer.headers.update(_HEADERS)
        return answer


class _Listening(StreamingResponse):
    """Server-sent events; `ended` is called when it ends, however it ends."""

    def __init__(self, lines: AsyncIterator[str], ended: Callable[[], None]) -> None:
        super().__init__(lines, media_type="text/event-stream")
        self._ended = ended

    async def __call__(self, *connection: Any) -> None:
        try:
            await super().__call__(*connection)
        finally:
            self._ended()


def _read_packaged(name: str) -> str:
    return (resources.files("sealscope.monitor.page") / name).read_text("utf-8")


def _refusal(error: str, status: int, headers: dict[str, str] | None = None) -> JSONResponse:
    return JSONResponse({"error": error}, status, headers)


def _later(wait: float) -> Response:
    return _refusal(f"too many wrong tokens: wait {wait:.0f} s", 429, {"Retry-After": str(math.ceil(wait))})


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
    """The page, served by a thread of its own until `close`; InputError where its port or its token cannot be had."""

    def __init__(
        self,
        actuators: WatchedActuators,
        settings: PageSettings,
        waits: Waits = lambda: (0, 0, 0),
        live: LiveSamples | None = None,
    ) -> None:
        token = secret_of(settings.token_file, "page.token_file")
        self._actuators, self._host, self.port = actuators, settings.host, settings.port
        self._application = site(actuators, settings, token, waits, live)
        self._proxies = [str(address) for address in settings.proxies]
        self._socket: socket.socket | None = self._open_socket()
        self.port = int(self._socket.getsockname()[1])
        self.address = f"http://{settings.host}:{self.port}/"
        self._server: uvicorn.Server | None = None
        self._thread = actuators.supervisor.start("page", self._serve)

    def _open_socket(self) -> socket.socket:
        try:
            family = socket.AF_INET6 if ":" in self._host else socket.AF_INET
            return socket.create_server((self._host, self.port), family=family, backlog=BACKLOG)
        except OSError as error:
            place = f"{self._host}:{self.port}"
            raise InputError(f"page.port must be free, got {error.strerror or error} ({place})") from None

    def _serve(self) -> None:
        """Serve the page until `leave`; uvicorn closes the socket."""
        opened, self._socket = self._socket or self._open_socket(), None
        config = uvicorn.Config(
            self._application,
            http=limited_protocol(most_connections()),
            ws="none",
            lifespan="off",
            log_config=None,
            access_log=False,
            backlog=BACKLOG,
            timeout_graceful_shutdown=1,
            proxy_headers=bool(self._proxies),
            forwarded_allow_ips=self._proxies,
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
