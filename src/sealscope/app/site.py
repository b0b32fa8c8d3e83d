"""The page of the workbench as a web application for this computer alone.

A launch token, good for one use, is exchanged for a cookie. A change needs this cookie, a header that no form of
another site can send, and an origin that is this page's; other host names are refused, against DNS rebinding.
"""

from __future__ import annotations

import asyncio
import hmac
import secrets
import threading
from collections.abc import Awaitable, Callable, Mapping
from typing import Any
from urllib.parse import quote

import orjson
from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.middleware.base import BaseHTTPMiddleware
from starlette.middleware.trustedhost import TrustedHostMiddleware
from starlette.requests import Request
from starlette.responses import FileResponse, HTMLResponse, RedirectResponse, Response
from starlette.routing import Route

from sealscope.app.scripts import write_report_command, write_script, write_watch
from sealscope.app.session import REPORTS
from sealscope.app.workbench import Workbench
from sealscope.errors import InputError, SealscopeError
from sealscope.recordings.channels import CHANNEL_UNITS, LONG_NAMES
from sealscope.reporting.template import read_package_file, render
from sealscope.storage.plain_values import parse_json
from sealscope.web.guard import Admission
from sealscope.web.responses import HEADERS, LOCAL, SHARED_FILES, make_refusal, read_body, serve_shared_file

#: Largest body of a request that changes something, and largest piece of a dropped file [bytes].
_MAX_BODY, _MAX_PIECE = 1_000_000, 8_000_000
_COOKIE, _PACKAGE = "sealscope-app", "sealscope.app"
#: Files of the page, by their addresses.
_FILES = {
    "/app.css": "text/css",
    **dict.fromkeys(
        (f"/{name}.mjs" for name in ("main", "charts", "logs", "channels", "healthy", "verdict", "trend", "hold")),
        "text/javascript",
    ),
}
#: Headers of a page of results, which holds its own scripts: it may run them, but is of no origin.
_REPORT_HEADERS = {"Content-Security-Policy": "sandbox allow-scripts allow-popups; frame-ancestors 'none'"}
#: Words of `Sec-Fetch-Site` with which a page asks for itself, or a person for the page.
_OWN_SITES = ("same-origin", "none")


class LaunchGuard:
    """The launch token of an application, good for one use, and the cookie that it is exchanged for."""

    def __init__(self) -> None:
        self.token: str | None = secrets.token_urlsafe(32)
        self.session = secrets.token_urlsafe(32)
        self._lock = threading.Lock()
        self._admission = Admission(secrets.token_urlsafe(32))  # counts wrong tokens; no token of its own is used

    def pause_s(self, address: str) -> float:
        """Compute the time [s] for which a client must wait after wrong tokens."""
        return self._admission.pause_s(address)

    def use_token(self, address: str, token: str) -> bool:
        """Return True for the launch token, once; count any other as wrong."""
        with self._lock:
            if self.token is not None and hmac.compare_digest(token.encode("utf-8", "replace"), self.token.encode()):
                self.token = None
                return True
        self._admission.admits(address, "")
        return False

    def knows(self, cookie: str | None) -> bool:
        """Return True for the cookie of a browser that had the token."""
        return cookie is not None and hmac.compare_digest(cookie.encode("utf-8", "replace"), self.session.encode())


def _answer(values: Any, status: int = 200) -> Response:
    """Make an answer of JSON; NaN and infinity become null."""
    data = orjson.dumps(values, option=orjson.OPT_SERIALIZE_NUMPY | orjson.OPT_NON_STR_KEYS)
    return Response(data, status, media_type="application/json")


def _find_refusal(guard: LaunchGuard, request: Request) -> Response | None:
    """Return the answer that refuses a request, None to admit it."""
    path, headers = request.url.path, request.headers
    is_change = request.method not in ("GET", "HEAD")
    site = headers.get("sec-fetch-site")
    if is_change:
        origin = headers.get("origin")
        if (site or "same-origin") != "same-origin":
            return make_refusal("a change must be asked for by this page", 403)
        if origin != f"{request.url.scheme}://{headers.get('host', '')}":
            return make_refusal("a change must come from this page's origin", 403)
        if headers.get("x-sealscope") != "app":
            return make_refusal("the header X-Sealscope is missing", 403)
    elif site is not None and site not in _OWN_SITES and path not in ("/", "/start"):
        return make_refusal("the page is for this computer alone", 403)
    if path == "/start" or guard.knows(request.cookies.get(_COOKIE)):
        return None
    if path in ("/", "/base.css", "/app.css"):
        return None if path != "/" else HTMLResponse(str(read_package_file("page/closed.html", _PACKAGE)), 401)
    return make_refusal("start the workbench anew: sealscope app", 401)


def make_site(workbench: Workbench, guard: LaunchGuard) -> Starlette:
    """Build the web application of a workbench."""
    pages = _Screens(workbench, guard)
    routes = [
        Route("/", pages.page),
        Route("/start", pages.start),
        *(Route(path, pages.file) for path in _FILES),
        *(Route(path, serve_shared_file) for path in SHARED_FILES),
        Route("/api/drop", pages.received),
        Route("/api/drop", pages.receive, methods=["PUT"]),
        Route("/report/{name:str}", pages.report),
        Route("/machine/{name:str}", pages.machine_file),
        Route("/api/{what:str}", pages.read),
        Route("/api/{what:str}", pages.change, methods=["POST"]),
    ]

    async def check(request: Request, call_next: Callable[[Request], Awaitable[Response]]) -> Response:
        """Refuse a request, or answer it, with the headers of every answer."""
        answer = _find_refusal(guard, request) or await call_next(request)
        for name, value in HEADERS.items():
            answer.headers.setdefault(name, value)
        return answer

    middleware = [
        Middleware(BaseHTTPMiddleware, dispatch=check),
        Middleware(TrustedHostMiddleware, allowed_hosts=[*LOCAL, "[::1]"]),
    ]
    return Starlette(routes=routes, middleware=middleware)


class _Screens:
    """The request handlers of the page."""

    def __init__(self, workbench: Workbench, guard: LaunchGuard) -> None:
        self._bench, self._guard = workbench, guard

    def page(self, request: Request) -> Response:
        channels = [(name, LONG_NAMES[name], unit) for name, unit in CHANNEL_UNITS.items()]
        return HTMLResponse(render("app.html.j2", package=_PACKAGE, channels=channels))

    def start(self, request: Request) -> Response:
        """Exchange the launch token for a cookie."""
        address = "" if request.client is None else request.client.host
        if wait := self._guard.pause_s(address):
            return make_refusal(f"too many wrong tokens: wait {wait:.0f} s", 429, {"Retry-After": str(int(wait) + 1)})
        if not self._guard.use_token(address, request.query_params.get("token", "")):
            if self._guard.knows(request.cookies.get(_COOKIE)):
                return RedirectResponse("/", 303)
            return HTMLResponse(str(read_package_file("page/closed.html", _PACKAGE)), 401)
        answer = RedirectResponse("/", 303)
        answer.set_cookie(_COOKIE, self._guard.session, httponly=True, samesite="strict")
        return answer

    def file(self, request: Request) -> Response:
        name = request.url.path.removeprefix("/")
        return Response(read_package_file(f"page/{name}", _PACKAGE), media_type=_FILES[request.url.path])

    def report(self, request: Request) -> Response:
        """Answer with a page of results, which is of no origin and so cannot reach this one."""
        name = request.path_params["name"]
        file = self._bench.folder.folder / REPORTS / name
        if "/" in name or "\\" in name or name.startswith(".") or file.suffix != ".html" or not file.is_file():
            return make_refusal("no such page", 404)
        return FileResponse(file, headers=_REPORT_HEADERS, media_type="text/html")

    def machine_file(self, request: Request) -> Response:
        """Answer with the file of a commissioned machine, or with its healthy summaries, to be saved elsewhere."""
        name = request.path_params["name"]
        names = [f"{m.name}{end}" for m in self._bench.folder.read().machine for end in (".toml", ".healthy")]
        file = self._bench.folder.folder / name
        if name not in names or not file.is_file():
            return make_refusal("no such machine", 404)
        return FileResponse(file, filename=name, media_type="application/octet-stream")

    async def received(self, request: Request) -> Response:
        """Answer with the number of bytes of a dropped file that have come. Query: `name`, `size`."""
        return await self._try(lambda: {"offset": self._bench.received(*_name_and_size(request))})

    async def receive(self, request: Request) -> Response:
        """Append the body to a dropped file. Query: `name`, `size`, `offset`; status 409 for another offset."""
        try:
            name, size = _name_and_size(request)
            offset = _parse_whole(request, "offset")
            data = await read_body(request, _MAX_PIECE)
            if offset != (known := self._bench.received(name, size)):
                return _answer({"error": f"the next piece begins at {known}", "offset": known}, 409)
        except TimeoutError:
            return make_refusal("a piece must arrive in time", 408)
        except SealscopeError as error:
            return make_refusal(str(error), 400)
        return await self._try(lambda: {"offset": self._bench.receive(name, size, offset, data)})

    async def read(self, request: Request) -> Response:
        """Answer with what a screen shows; `READERS` lists the addresses."""
        reader = READERS.get(request.path_params["what"])
        if reader is None:
            return make_refusal("no such address", 404)
        return await self._try(lambda: reader(self._bench, _Query(request.query_params)))

    async def change(self, request: Request) -> Response:
        """Do what a screen asks for; `CHANGES` lists the addresses. The body is a JSON mapping."""
        change = CHANGES.get(request.path_params["what"])
        if change is None:
            return make_refusal("no such address", 404)
        try:
            values = parse_json(await read_body(request, _MAX_BODY))
            if not isinstance(values, dict):
                raise InputError("a change must be a mapping")
        except TimeoutError:
            return make_refusal("a request must arrive in time", 408)
        except ValueError as error:
            return make_refusal(" ".join(str(error).split())[:500], 400)
        return await self._try(lambda: change(self._bench, values) or {})

    @staticmethod
    async def _try(work: Callable[[], Any]) -> Response:
        """Answer with the result of `work`, or with its error in one line."""
        try:
            return _answer(await asyncio.to_thread(work))
        except (SealscopeError, OSError, MemoryError) as error:
            return make_refusal(" ".join((str(error) or "out of memory").split()), 400)
        except (KeyError, TypeError, AttributeError, ValueError) as error:
            return make_refusal(f"a request must have valid values, got {type(error).__name__}: {error}"[:300], 400)


class _Query:
    """The query of a request, with texts of at most 8000 characters."""

    def __init__(self, values: Mapping[str, str]) -> None:
        self._values = values

    def __call__(self, name: str) -> str:
        text = self._values.get(name, "")
        if len(text) > 8000:
            raise InputError(f"{name} must have at most 8000 characters")
        return text

    def number(self, name: str) -> float | None:
        """Return a number, None if the query has none."""
        try:
            value = float(self(name)) if self(name) else None
        except ValueError:
            raise InputError(f"{name} must be a number, got {self(name)[:40]!r}") from None
        if value is not None and not abs(value) < 1e15:
            raise InputError(f"{name} must be finite, got {self(name)[:40]!r}")
        return value


def _name_and_size(request: Request) -> tuple[str, int]:
    return request.query_params.get("name", ""), _parse_whole(request, "size")


def _parse_whole(request: Request, name: str) -> int:
    text = request.query_params.get(name, "")
    if not (text.isascii() and text.isdigit() and len(text) < 16):
        raise InputError(f"{name} must be a whole number, got {text[:40]!r}")
    return int(text)


def _read_window(bench: Workbench, query: _Query) -> Any:
    indices = [int(text) for text in query("columns").split(",") if text.isascii() and text.isdigit()]
    pixels = int(query.number("pixels") or 800)
    begin, end = query.number("from"), query.number("to")
    return bench.window(query("table"), query("file"), query("machine"), indices[:200], begin, end, pixels)


def _layout_of(values: Mapping[str, Any]) -> dict[str, Any]:
    """Convert the fields of a stated layout: numbers and texts, of which empty ones are not stated."""
    layout: dict[str, Any] = {}
    for name in ("first_row", "heading_row", "time_column"):
        text = str(values.get(name) or "").strip()
        if text:
            if not (text.isascii() and text.isdigit() and len(text) < 8):
                raise InputError(f"{name} must be the number of a line or column, got {text[:40]!r}")
            layout[name] = int(text)
    for name in ("delimiter", "decimal", "time_format"):
        text = str(values.get(name) or "")
        if text.strip() or text == " ":
            layout[name] = text
    return layout


def _say_limit(bench: Workbench, query: _Query) -> Any:
    return bench.limit_lpm(query("text"), query("machine"), query("rpm"))


#: What a screen asks for, by the address.
READERS: dict[str, Callable[[Workbench, _Query], Any]] = {
    "state": lambda bench, query: bench.state(int(query.number("since") or -1)),
    "preview": lambda bench, query: bench.preview(query("file"), _layout_of(query._values)),
    "window": _read_window,
    "proposal": lambda bench, query: bench.propose(query("machine"), query("file")),
    "channels": lambda bench, query: bench.describe_channels(query("machine"), query("file")),
    "drawing": lambda bench, query: {
        "svg": bench.draw_machine(query("machine"), [name for name in query("channels").split(",") if name])
    },
    "learnt": lambda bench, query: bench.learnt(query("machine")),
    "verdict": lambda bench, query: {"verdict": bench.verdict(query("machine"), query("file"))},
    "trend": lambda bench, query: bench.trend(query("machine"), recorded=query("kind") == "recorded"),
    "hold": lambda bench, query: {"results": bench.describe_hold(query("machine"), query("file"))},
    "limit": _say_limit,
    "script": lambda bench, query: write_script(bench, query("screen"), query("machine"), query("file")),
}


def _text(values: Mapping[str, Any], name: str) -> str:
    value = values.get(name, "")
    if not isinstance(value, str) or len(value) > 8000:
        raise InputError(f"{name} must be a text of at most 8000 characters")
    return value


def _texts(values: Mapping[str, Any], name: str) -> list[str]:
    items = values.get(name, [])
    if not isinstance(items, list) or not all(isinstance(item, str) and len(item) <= 8000 for item in items):
        raise InputError(f"{name} must be a list of texts")
    return items


def _report(bench: Workbench, values: Mapping[str, Any]) -> Any:
    name, key = _text(values, "machine"), _text(values, "file")
    page = bench.write_report(name, key)
    return {"page": page, "address": f"/report/{quote(page)}", "command": write_report_command(bench, name, key)}


def _trend_page(bench: Workbench, values: Mapping[str, Any]) -> Any:
    page = bench.write_trend(_text(values, "machine"))
    return {"page": page, "address": f"/report/{quote(page)}"}


def _hold_page(bench: Workbench, values: Mapping[str, Any]) -> Any:
    page = bench.write_hold(_text(values, "machine"), _text(values, "file"))
    return {"page": page, "address": f"/report/{quote(page)}"}


def _change_machine(bench: Workbench, values: Mapping[str, Any]) -> Any:
    changes = values.get("values", {})
    if not isinstance(changes, dict):
        raise InputError("values must be a table")
    return {"name": bench.change_machine(_text(values, "machine"), changes).name}


def _cancel(bench: Workbench, values: Mapping[str, Any]) -> Any:
    number = int(values.get("number", 0))
    queue = bench.reading if values.get("kind") == "read logs" else bench.work
    return {"cancelled": queue.cancel(number)}


#: What a screen asks to be done, by the address.
CHANGES: dict[str, Callable[[Workbench, Mapping[str, Any]], Any]] = {
    "open": lambda bench, values: bench.open_paths([_text(values, "path")]),
    "close": lambda bench, values: bench.close_source(_text(values, "source")),
    "mend": lambda bench, values: {"rows": bench.mend_log(_text(values, "file"), _layout_of(values.get("layout", {})))},
    "machine": _change_machine,
    "remove": lambda bench, values: bench.remove_machine(_text(values, "machine")),
    "mark": lambda bench, values: bench.mark(
        _text(values, "machine"), _texts(values, "files"), values.get("mark") or None
    ),
    "commission": lambda bench, values: bench.commission_in_background(_text(values, "machine")).as_dict(),
    "judge": lambda bench, values: bench.judge_in_background(
        _text(values, "machine"), _texts(values, "files")
    ).as_dict(),
    "opinion": lambda bench, values: bench.set_opinion(
        _text(values, "machine"), _text(values, "file"), _text(values, "opinion")
    ),
    "report": _report,
    "trend": lambda bench, values: bench.trend_in_background(_texts(values, "machines")).as_dict(),
    "trend-page": _trend_page,
    "hold-page": _hold_page,
    "watch": lambda bench, values: {"file": write_watch(bench, _text(values, "machine"), _text(values, "folder"))},
    "cancel": _cancel,
}
