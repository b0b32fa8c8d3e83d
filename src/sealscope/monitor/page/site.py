"""The monitor's page as a web application, for this computer only or protected by a token.

Nothing is loaded from other sites, and all names and texts from outside are shown as plain text.
"""

from __future__ import annotations

import asyncio
import json
import math
import re
import socket
import threading
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping
from contextlib import ExitStack, suppress
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
from sealscope.monitor.alarms import rank_actuators
from sealscope.monitor.bounded_queue import QueueLoad
from sealscope.monitor.database.sqlite_files import FilesReplaced
from sealscope.monitor.database.store import MAX_QUERIES, QUERY_WAIT_S, outage_reason
from sealscope.monitor.outputs.prometheus import CONTENT_TYPE, format_metrics
from sealscope.monitor.page.live import DETAIL_FORMS, PRESSURES, LiveSamples, describe_rig
from sealscope.monitor.settings import PageSettings, read_secret
from sealscope.monitor.supervisor import DATABASE
from sealscope.reporting.template import read_package_file
from sealscope.storage.plain_values import parse_json
from sealscope.web.guard import Admission, connection_limit
from sealscope.web.responses import BODY_S, HEADERS, LOCAL, SHARED_FILES, make_refusal, read_body, serve_shared_file
from sealscope.web.serving import format_place, make_server, open_socket

#: Most listeners at a time.
_MAX_LISTENERS = 200
#: How often changes are looked for [s], and silence after which an event keeps a connection to a browser alive [s].
_POLL_S, _KEEP_ALIVE_S = 0.3, 15.0
_HOURS = re.compile(r"[0-9]{1,8}(\.[0-9]{1,8})?")
#: Header that states when to repeat a request [s].
_RETRY_HEADERS = {"Retry-After": "5"}
#: Name of the login's cookie, and its lifetime [s].
_COOKIE, _COOKIE_S = "sealscope", 30 * 86_400
_PACKAGE = "sealscope.monitor.page"
#: By address: static file and its media type.
_FILES = {
    "/": ("page.html", "text/html"),
    **{f"/{name}": (name, "text/javascript") for name in ("page.js", "live.js", "twin.js")},
    "/page.css": ("page.css", "text/css"),
}


def site(
    actuators: WatchedActuators,
    settings: PageSettings,
    token: str | None,
    queue_load: Callable[[], QueueLoad] = QueueLoad,
    live: LiveSamples | None = None,
) -> Starlette:
    """Build the web application that serves the page of a monitor.

    `token`: text that is needed for all but the login form, None to admit everybody; `queue_load`: function that
    returns the load of the queue of blocks; `live`: the last samples of the service, by default only the stored ones.
    """
    pages = _Pages(actuators, token, queue_load, live or LiveSamples(actuators.store.last_samples))
    routes = [
        *(Route(path, pages.file) for path in _FILES),
        *(Route(path, serve_shared_file) for path in SHARED_FILES),
        Route("/login", pages.login, methods=["GET", "POST"]),
        Route("/api/fleet", pages.limit_queries(pages.fleet)),
        Route("/api/actuator", pages.limit_queries(pages.actuator)),
        Route("/api/mark", pages.mark, methods=["POST"]),
        Route("/api/changes", pages.changes),
        Route("/metrics", pages.limit_queries(pages.metrics)),
    ]
    middleware = [Middleware(BaseHTTPMiddleware, dispatch=pages.guard)]
    if settings.host in LOCAL:  # against DNS rebinding: refuse host names of other sites
        middleware.append(Middleware(TrustedHostMiddleware, allowed_hosts=[*LOCAL, "[::1]"]))
    handlers: Any = {SQLAlchemyError: pages.answer_outage, FilesReplaced: pages.answer_outage}
    return Starlette(routes=routes, middleware=middleware, exception_handlers=handlers)


class _Pages:
    """The request handlers of the page, by which `site` serves its URL paths."""

    def __init__(
        self, actuators: WatchedActuators, token: str | None, queue_load: Callable[[], QueueLoad], live: LiveSamples
    ) -> None:
        self._actuators, self._store, self._queue_load, self._live = actuators, actuators.store, queue_load, live
        self._supervisor = actuators.supervisor
        self._machines = {name: describe_rig(settings.rig) for name, settings in actuators.settings.items()}
        # times of files are shown in their logger's zone, not the browser's
        self._by_files = {name for name, settings in actuators.settings.items() if settings.folder is not None}
        # half of the connections remain for other requests
        self._n_listeners, self._max_listeners = 0, min(_MAX_LISTENERS, connection_limit() // 2)
        self._admission = None if token is None else Admission(token)
        self._queries = threading.BoundedSemaphore(MAX_QUERIES)

    def limit_queries(self, handler: Callable[[Request], Response]) -> Callable[[Request], Response]:
        """Build a request handler of which at most `MAX_QUERIES` run at a time, so that storage keeps its share.

        A request that must wait for more than `QUERY_WAIT_S` is refused.
        """

        def answer(request: Request) -> Response:
            if not self._queries.acquire(timeout=QUERY_WAIT_S):
                return make_refusal("too many queries at a time", 503, _RETRY_HEADERS)
            try:
                return handler(request)
            finally:
                self._queries.release()

        return answer

    def file(self, request: Request) -> Response:
        name, media_type = _FILES[request.url.path]
        return Response(read_package_file(name, _PACKAGE), media_type=media_type)

    def _counters_and_outages(self) -> dict[str, Any]:
        """Collect the counters, the number of queued blocks and the outages, without access to the database."""
        counters, outages = self._actuators.counters, self._supervisor.outages()
        return {"counters": counters, "waiting": self._queue_load().n_blocks, "outages": outages}

    def fleet(self, request: Request) -> Response:
        """Answer with the summaries of all actuators, most urgent first, and the state of the monitor, as JSON."""
        rows = rank_actuators(self._actuators.summaries(), self._store.alarms(open_only=True))
        rows = [{**row, "by_files": row["name"] in self._by_files} for row in rows]
        limit = self._actuators.false_alarms_per_1000_h
        return JSONResponse({"actuators": rows, **self._counters_and_outages(), "false_alarms_per_1000_h": limit})

    def actuator(self, request: Request) -> Response:
        """Answer with the summary, history, events and alarms of one actuator, as JSON.

        Query: `name` of the actuator; `hours`: length of the history [h], all of it if missing or no number.
        """
        name, hours = request.query_params.get("name", ""), request.query_params.get("hours", "")
        summary = self._actuators.summaries().get(name)
        if summary is None:
            return make_refusal("no such actuator", 404)
        settings = self._actuators.settings[name]
        seconds = float(hours) * 3600.0 if _HOURS.fullmatch(hours) else None
        details = {
            "name": name,
            "summary": summary,
            "machine": self._machines[name],
            "by_files": name in self._by_files,
            "course": self._store.history(name, seconds=seconds),
            "events": self._store.last_events(name),
            "limit_lpm": settings.error_lpm or settings.warning_lpm or None,  # None instead of a limit of 0
            "alarms": self._store.alarms(actuator=name)[:50],
        }
        return JSONResponse(details)

    async def mark(self, request: Request) -> Response:
        """Apply the mark in the request's body to the alarm of an actuator, and answer with the alarm as JSON.

        Query: `name` of the actuator. The body is a JSON mapping of texts: `mark`, such as "acknowledged", and
        optionally `by`, the name of the person, and `text`, a comment.
        """
        # against forged requests: a form of another site cannot send this header
        if request.headers.get("x-sealscope") != "mark":
            return make_refusal("the header X-Sealscope is missing", 403)
        name = request.query_params.get("name", "")
        try:
            values = parse_json(await read_body(request))
            if not isinstance(values, dict) or not all(isinstance(value, str) for value in values.values()):
                raise InputError("a mark must be a mapping of texts")
            note = {"by_whom": values.get("by", ""), "text": values.get("text", "")}
            alarm = await asyncio.to_thread(self._actuators.apply_mark, name, values.get("mark", ""), **note)
        except TimeoutError:
            return make_refusal(f"a request must arrive within {BODY_S:g} s", 408)
        except ValueError as error:
            return make_refusal(str(error), 400)
        return JSONResponse(alarm.as_dict())

    async def changes(self, request: Request) -> Response:
        """Answer with a stream of server-sent events that keeps the page up to date.

        An event without a name tells the page to load results, alarms and outages again. Its data is the number of
        changes so far; it is sent after each change, and after `_KEEP_ALIVE_S` [s] without a change. An event "live"
        has the curves of the last samples of an actuator (`LiveSamples.curves`). Query: `actuator`, the name of this
        actuator; `pressure`, "p_A" or "p_B", whose wavelet details are drawn; `drawn`, "details", or "rms" for their
        RMS.
        """
        if self._n_listeners >= self._max_listeners:
            return make_refusal("too many listeners", 503)
        defaults = {"actuator": "", "pressure": "p_A", "drawn": "rms"}
        name, pressure, detail_form = (request.query_params.get(key, default) for key, default in defaults.items())
        if name and name not in self._machines:
            return make_refusal("no such actuator", 404)
        if pressure not in PRESSURES or detail_form not in DETAIL_FORMS:
            return make_refusal(f"pressure must be one of {PRESSURES}, drawn one of {DETAIL_FORMS}", 400)
        self._n_listeners += 1
        return _EventStream(self._events(request, name, pressure, detail_form), self._remove_listener)

    def _remove_listener(self) -> None:
        self._n_listeners -= 1

    async def _events(self, request: Request, name: str, pressure: str, detail_form: str) -> AsyncIterator[str]:
        """Yield the server-sent events of `changes`, as text, until the client disconnects or the monitor ends.

        `name`: actuator whose curves are sent, "" for none. If too many actuators are viewed already, an event "live"
        states this error.
        """
        live, actuators = self._live, self._actuators
        with ExitStack() as contexts:
            is_viewing = bool(name) and await asyncio.to_thread(contexts.enter_context, live.viewing(name))
            if name and not is_viewing:
                yield _format_live({"name": name, "t": None, "error": "too many actuators are viewed"})
            sent_change_number = sent_version = -1  # nothing is sent yet
            silence_s = 0.0  # since the last event without a name
            while not await request.is_disconnected() and not actuators.closed:
                if actuators.change_number != sent_change_number or silence_s >= _KEEP_ALIVE_S:
                    sent_change_number, silence_s = actuators.change_number, 0.0
                    yield f"data: {sent_change_number}\n\n"
                if is_viewing and live.version(name) != sent_version:
                    sent_version = live.version(name)
                    yield _format_live(await asyncio.to_thread(live.curves, name, pressure, detail_form))
                await asyncio.sleep(_POLL_S)
                silence_s += _POLL_S

    def metrics(self, request: Request) -> Response:
        return Response(self._render_metrics(self._actuators.summaries()), media_type=CONTENT_TYPE)

    def _render_metrics(self, summaries: Mapping[str, Mapping[str, Any]]) -> str:
        """Format the metrics for Prometheus from the summary of each actuator; `summaries` is {} in an outage."""
        totals, load = self._supervisor.outage_totals(), self._queue_load()
        return format_metrics(summaries, self._actuators.counters, totals, load)

    async def answer_outage(self, request: Request, error: Exception) -> Response:
        """Answer with status 503 in an outage of the database and report the outage; raise any other error again."""
        reason = outage_reason(error)
        if reason is None:
            raise error
        self._supervisor.part(DATABASE).begin_outage(reason)
        text = f"the database does not answer: {reason}"
        if request.url.path == "/metrics":
            headers = {**_RETRY_HEADERS, "Content-Type": CONTENT_TYPE}
            return Response(f"# {text}\n{self._render_metrics({})}", 503, headers)
        return JSONResponse({"error": text, **self._counters_and_outages()}, 503, _RETRY_HEADERS)

    async def login(self, request: Request) -> Response:
        """Answer with the login form; if the right token is posted, set a cookie and redirect to the page.

        The status is 401 after a wrong token, and 429 for a client that must wait after several wrong tokens.
        """
        status = 200
        admission, address = self._admission, _client_address(request)
        if request.method == "POST" and admission is not None:
            if wait := admission.pause_s(address):
                return _refuse_for_now(wait)
            token = ""  # of a body that is too long or too slow: counts as wrong
            with suppress(InputError, TimeoutError):
                form = parse_qs((await read_body(request)).decode("utf-8", "replace"))
                token, *_ = form.get("token", [""])
            if admission.admits(address, token):
                answer = RedirectResponse("/", 303)
                options: Any = {"max_age": _COOKIE_S, "secure": request.url.scheme == "https", "samesite": "strict"}
                answer.set_cookie(_COOKIE, admission.session, httponly=True, **options)
                return answer
            status = 401
        return Response(read_package_file("login.html", _PACKAGE), status, media_type="text/html")

    def _find_refusal(self, request: Request) -> Response | None:
        """Check the token or cookie of a request; return the answer that refuses the request, or None to admit it."""
        admission, path = self._admission, request.url.path
        if admission is None or path in ("/login", "/base.css"):
            return None
        authorization, session = request.headers.get("authorization"), request.cookies.get(_COOKIE)
        if authorization is not None or session is not None:
            address = _client_address(request)
            if wait := admission.pause_s(address):
                return _refuse_for_now(wait)
            if authorization is not None and admission.admits(address, authorization.removeprefix("Bearer ")):
                return None
            if session is not None and admission.admits(address, session, session=True):
                return None
        answer: Response = RedirectResponse("/login", 303) if path == "/" else make_refusal("a token is needed", 401)
        if session is not None:  # an invalid cookie, for example of an earlier token
            answer.delete_cookie(_COOKIE)
        return answer

    async def guard(self, request: Request, call_next: Callable[[Request], Awaitable[Response]]) -> Response:
        """Refuse a request without a valid token or cookie, or answer it by `call_next`; add the security headers."""
        answer = self._find_refusal(request) or await call_next(request)
        answer.headers.update(HEADERS)
        return answer


class _EventStream(StreamingResponse):
    """A response of server-sent events; the function `on_end` is called when the response ends for any reason."""

    def __init__(self, events: AsyncIterator[str], on_end: Callable[[], None]) -> None:
        super().__init__(events, media_type="text/event-stream")
        self._on_end = on_end

    async def __call__(self, *connection: Any) -> None:
        try:
            await super().__call__(*connection)
        finally:
            self._on_end()


def _refuse_for_now(wait: float) -> Response:
    return make_refusal(f"too many wrong tokens: wait {wait:.0f} s", 429, {"Retry-After": str(math.ceil(wait))})


def _format_live(curves: Mapping[str, Any]) -> str:
    """Format the server-sent event "live"."""
    return f"event: live\ndata: {json.dumps(curves, allow_nan=False)}\n\n"


def _client_address(request: Request) -> str:
    return "" if request.client is None else request.client.host


class PageServer:
    """The web server of the page (`site`), which runs in a separate thread until `close`.

    Raises InputError if the port is taken or the token cannot be read.
    """

    def __init__(
        self,
        actuators: WatchedActuators,
        settings: PageSettings,
        queue_load: Callable[[], QueueLoad] = QueueLoad,
        live: LiveSamples | None = None,
    ) -> None:
        token = read_secret(settings.token_file, "page.token_file")
        self._actuators, self._host, self.port = actuators, settings.host, settings.port
        self._application = site(actuators, settings, token, queue_load, live)
        self._proxies = [str(address) for address in settings.proxies]
        self._socket: socket.socket | None = open_socket(self._host, self.port, "page.port")
        self.port = int(self._socket.getsockname()[1])  # chosen by the system if the stated port is 0
        self.address = f"http://{format_place(self._host, self.port)}/"
        self._server: uvicorn.Server | None = None
        self._thread = actuators.supervisor.start("page", self._serve)

    def _serve(self) -> None:
        """Serve the page until `leave` is called; uvicorn closes the socket at the end.

        Raises RuntimeError if the server ends before, so that the supervisor starts it again.
        """
        # opened again after an error, which closes it
        page_socket = self._socket or open_socket(self._host, self.port, "page.port")
        self._socket = None
        self._server = make_server(self._application, self._proxies)
        self._server.should_exit = self._actuators.closed  # `leave` may have been called before
        self._server.run(sockets=[page_socket])
        if not self._actuators.closed:
            raise RuntimeError("the page's server has ended")

    def leave(self) -> None:
        """Tell the web server and its open event streams to end."""
        self._actuators.closed = True
        if self._server is not None:
            self._server.should_exit = True

    def close(self) -> None:
        """End the server, wait up to 1 s for its thread, and close the socket if it is still open."""
        self.leave()
        self._thread.join(timeout=1.0)
        if self._socket is not None:
            self._socket.close()
