"""The page behind nginx with TLS, as docs/howto/tls.md sets it up."""

from __future__ import annotations

import http.client
import re
import shutil
import socket
import ssl
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from sealscope.monitor.page.site import PageServer
from sealscope.monitor.service import Service
from sealscope.monitor.settings import PageSettings

from .plant import settings_in, until
from .servers import free_port
from .test_broker_security import signed

NGINX = shutil.which("nginx") or shutil.which("nginx", path="/usr/sbin")
GUIDE = Path(__file__).parents[2] / "docs" / "howto" / "tls.md"
pytestmark = [pytest.mark.slow, pytest.mark.skipif(NGINX is None, reason="nginx is not installed")]


@pytest.fixture
def proxy(tmp_path: Path) -> Iterator[http.client.HTTPSConnection]:
    """A connection to a page through nginx, whose settings are those of the guide but for ports and paths."""
    signed(tmp_path, "page", signed(tmp_path, "authority"))
    (tmp_path / "token.txt").write_text("the token\n")
    service = Service(settings_in(tmp_path), once=True)
    page = PageServer(service.actuators, PageSettings(port=0, token_file=tmp_path / "token.txt", proxies=["127.0.0.1"]))
    port, (site,) = free_port(), re.findall(r"```nginx\n(.*?)```", GUIDE.read_text("utf-8"), re.DOTALL)
    for given, here in (
        ("listen 443", f"listen 127.0.0.1:{port}"),
        ("/etc/ssl/monitor", str(tmp_path)),
        ("127.0.0.1:8765", f"127.0.0.1:{page.port}"),
    ):
        assert site.count(given) >= 1
        site = site.replace(given, here)
    temporary = "".join(f"{name}_temp_path {tmp_path}/{name};\n" for name in ("client_body", "proxy", "fastcgi"))
    more = "".join(f"{name}_temp_path {tmp_path}/{name};\n" for name in ("uwsgi", "scgi"))
    (tmp_path / "nginx.conf").write_text(
        f"daemon off; pid {tmp_path}/pid; error_log {tmp_path}/error.log; events {{}}\n"
        f"http {{ access_log off;\n{temporary}{more}{site}}}\n"
    )
    process = subprocess.Popen([str(NGINX), "-p", str(tmp_path), "-c", str(tmp_path / "nginx.conf")])
    try:
        until(lambda: process.poll() is not None or _answers(port), 20.0)
        context = ssl.create_default_context(cafile=tmp_path / "authority.pem")
        yield http.client.HTTPSConnection("127.0.0.1", port, context=context, timeout=20.0)
    finally:
        process.terminate()
        process.wait()
        page.close()
        service.close()
        service.store.engine.dispose()


def _answers(port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0


def asked(
    proxy: http.client.HTTPSConnection, path: str, body: str | None = None, **headers: str
) -> tuple[int, str, str]:
    """Status, the header `location` or `set-cookie`, and the text of an answer."""
    if body is not None:
        headers["Content-Type"] = "application/x-www-form-urlencoded"
    proxy.request("GET" if body is None else "POST", path, body, headers)
    answer = proxy.getresponse()
    return answer.status, answer.getheader("Set-Cookie") or answer.getheader("Location") or "", answer.read().decode()


def test_the_page_behind_a_proxy_with_tls(proxy: http.client.HTTPSConnection):
    assert asked(proxy, "/")[:2] == (303, "/login")
    status, cookie, _ = asked(proxy, "/login", "token=the+token")
    assert status == 303
    assert {"Secure", "HttpOnly", "SameSite=strict"} <= set(cookie.split("; "))
    session = cookie.split(";")[0]
    assert asked(proxy, "/api/fleet", Cookie=session)[0] == 200
    assert "sealscope_reached" in asked(proxy, "/metrics", Authorization="Bearer the token")[2]
    proxy.request("GET", "/api/changes", headers={"Cookie": session})
    stream = proxy.getresponse()
    assert stream.readline().startswith(b"data: ")  # it is sent at once
    assert stream.getheader("Strict-Transport-Security") is not None
    proxy.close()
    guesses = [
        asked(proxy, "/metrics", Authorization=f"Bearer {k}", **{"X-Forwarded-For": f"10.0.0.{k}"}) for k in range(9)
    ]
    assert [status for status, *_ in guesses] == [401] * 5 + [429] * 4  # who asks is not who they say they are
