"""The socket and the server of a page."""

from __future__ import annotations

import socket
from collections.abc import Sequence
from typing import Any

import uvicorn

from sealscope.errors import InputError
from sealscope.web.guard import BACKLOG, connection_limit, limit_protocol


def open_socket(host: str, port: int, name: str) -> socket.socket:
    """Open the socket of a page; raise InputError, which names the setting `name`, if the port is taken."""
    try:
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        return socket.create_server((host, port), family=family, backlog=BACKLOG)
    except OSError as error:
        raise InputError(f"{name} must be free, got {error.strerror or error} ({format_place(host, port)})") from None


def format_place(host: str, port: int) -> str:
    """Format host and port of a page as in a URL, with an IPv6 address in brackets."""
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"


def make_server(application: Any, proxies: Sequence[str] = ()) -> uvicorn.Server:
    """Make the web server of an application, which limits connections and their idle time (`guard`).

    `proxies`: addresses that are believed whom they ask for.
    """
    config = uvicorn.Config(
        application,
        http=limit_protocol(connection_limit()),
        ws="none",
        lifespan="off",
        log_config=None,
        access_log=False,
        backlog=BACKLOG,
        timeout_graceful_shutdown=1,
        proxy_headers=bool(proxies),
        forwarded_allow_ips=list(proxies),
    )
    return uvicorn.Server(config)
