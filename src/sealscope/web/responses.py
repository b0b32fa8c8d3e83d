"""Headers, refusals and packaged files of the pages, and the limits of a request's body.

Nothing is loaded from other sites, and no script but those of the package runs.
"""

from __future__ import annotations

import asyncio

from starlette.requests import Request
from starlette.responses import JSONResponse, Response

from sealscope.errors import InputError
from sealscope.reporting.template import read_package_file

#: Largest body of a request [bytes] and time limit for receiving it [s].
MAX_BODY_BYTES, BODY_S = 10_000, 10.0
#: Headers of every answer.
HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; "
    "img-src 'self' data:; form-action 'self'; frame-ancestors 'none'; base-uri 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
}
#: Host names of this computer, which a page without a token serves alone.
LOCAL = ("127.0.0.1", "localhost", "::1")
#: Files that all pages share: address -> (package, name, media type).
SHARED_FILES = {
    "/uPlot.js": ("sealscope.reporting", "vendor/uPlot.iife.min.js", "text/javascript"),
    "/uPlot.css": ("sealscope.reporting", "vendor/uPlot.min.css", "text/css"),
    "/base.css": ("sealscope.web", "base.css", "text/css"),
    "/base.js": ("sealscope.web", "base.js", "text/javascript"),
}


def serve_shared_file(request: Request) -> Response:
    """Answer with one of `SHARED_FILES`."""
    package, name, media_type = SHARED_FILES[request.url.path]
    return Response(read_package_file(name, package), media_type=media_type)


def make_refusal(error: str, status: int, headers: dict[str, str] | None = None) -> JSONResponse:
    """Make the JSON answer that states an `error`, with an HTTP status such as 403."""
    return JSONResponse({"error": error}, status, headers)


async def read_body(request: Request, max_bytes: int = MAX_BODY_BYTES) -> bytes:
    """Read the body of a request; raise InputError if it is too long, TimeoutError if it takes over `BODY_S`."""
    data = bytearray()
    async with asyncio.timeout(BODY_S):
        async for part in request.stream():
            data += part
            if len(data) > max_bytes:
                raise InputError(f"a request must have at most {max_bytes} bytes")
    return bytes(data)
