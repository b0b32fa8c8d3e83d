"""The page under connections that say nothing, too many listeners, guessed tokens, and odd names and addresses."""

from __future__ import annotations

import http.client
import os
import resource
import socket
import time
import urllib.request
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from urllib.parse import quote

import pytest
from hypothesis import given
from hypothesis import settings as examples
from hypothesis import strategies as st
from starlette.testclient import TestClient

from sealscope.monitor.page import site as site_module
from sealscope.monitor.page.site import PageServer, site
from sealscope.monitor.service import Service
from sealscope.monitor.settings import PageSettings, topic_level
from sealscope.web.guard import Admission, connection_limit, limit_protocol

from ..refusals import refusal
from .plant import served, settings_in, until
from .test_outputs import LINES

NAMES = ("line 1/press 2", "/", "..", "a/../b", "%2F?&#+;=", "\u00fcber\n\u202e", "'\"<b>", "a/mark", "x" * 100)
#: How many of them run by default; each takes the samples of a leak.
QUICK = 3
MARK = {"X-Sealscope": "mark"}


def watched(folder: Path, names: tuple[str, ...]) -> Service:
    """A service that has raised an alarm of an actuator of each name."""
    import json

    more = "".join(f"[[actuator]]\nname = {json.dumps(name)}\n" for name in names)
    lines = b"".join(LINES.replace(b'"press 1"', json.dumps(name).encode()) for name in names)
    return served(settings_in(folder, more), lines)[0]


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    service = watched(tmp_path_factory.mktemp("odd names"), NAMES[:QUICK])
    yield service
    service.store.engine.dispose()


@pytest.fixture(scope="module")
def page(service: Service) -> TestClient:
    return TestClient(site(service.actuators, PageSettings(), None), base_url="http://localhost")


@pytest.mark.parametrize("name", NAMES[:QUICK])
def test_any_name_of_an_actuator_works_in_every_address(page: TestClient, name: str):
    check_addresses(page, name)


@pytest.mark.slow
def test_other_names_of_an_actuator_work_in_every_address(tmp_path: Path):
    service = watched(tmp_path, NAMES[QUICK:])
    page = TestClient(site(service.actuators, PageSettings(), None), base_url="http://localhost")
    for name in NAMES[QUICK:]:
        check_addresses(page, name)
    service.store.engine.dispose()


def check_addresses(page: TestClient, name: str) -> None:
    of = f"?name={quote(name, safe='')}"
    life = page.get(f"/api/actuator{of}").json()
    assert (life["name"], life["alarms"][0]["state"]) == (name, "new")
    answer = page.post(f"/api/mark{of}", json={"mark": "acknowledged"}, headers=MARK)
    assert (answer.status_code, answer.json()["actuator"]) == (200, name)
    assert page.get(f"/api/actuator{of}").json()["events"][0]["event"] == "acknowledged"


def test_names_that_would_share_a_topic_are_refused(tmp_path: Path):
    more = '[[actuator]]\nname = "line 1/press"\n[[actuator]]\nname = "line 1_press"\n'
    settings_in(tmp_path, more)
    with refusal("differ"):
        settings_in(tmp_path, more + "[mqtt]\n")
    assert topic_level("line 1/press") == topic_level("line 1_press")


@examples(deadline=None, max_examples=8)
@given(
    span=st.one_of(
        st.sampled_from(["\u00b2", "\u0663", "1e9", "-1", "nan", "inf", ".", "1.", "0x1", "9" * 99]), st.text()
    )
)
def test_any_span_of_hours_is_answered(page: TestClient, span: str):
    address = f"/api/actuator?name=..&hours={quote(span.encode('utf-8', 'replace'), safe='')}"
    assert page.get(address).status_code == 200


def test_only_names_of_this_machine_are_served(page: TestClient):
    for host in ("testserver", "evil.example", "localhost.evil.example", "127.0.0.1.evil", ""):
        assert page.get("/api/fleet", headers={"Host": host}).status_code == 400
    for host in ("localhost", "127.0.0.1:8765", "[::1]:8765"):
        assert page.get("/api/fleet", headers={"Host": host}).status_code == 200


def test_guesses_of_an_address_are_slowed_down_and_others_are_not():
    clock = [0.0]
    admission = Admission("right", lambda: clock[0])
    for _ in range(5):
        assert admission.pause_s("10.0.0.1") == 0.0
        assert not admission.admits("10.0.0.1", "wrong")
    viewing = 0
    for second in range(3600):
        clock[0] = float(second)
        if admission.pause_s("10.0.0.1") == 0.0:
            viewing += 1
            assert not admission.admits("10.0.0.1", f"wrong {second}")
    assert 50 < viewing < 80  # one a minute, in the end
    assert admission.pause_s("10.0.0.2") == 0.0
    assert admission.admits("10.0.0.2", "right")
    clock[0] += 61.0
    assert admission.admits("10.0.0.1", "right")
    assert admission.pause_s("10.0.0.1") == 0.0
    for _ in range(6):
        assert not admission.admits("2001:db8::1", admission.session)  # a session is no token
    assert admission.pause_s("2001:db8::ffff") > 0.0  # the same network
    assert admission.pause_s("2001:db8:0:1::1") == 0.0
    assert admission.admits("x", admission.session, session=True)


def test_a_page_with_a_token_answers_guesses_later(service: Service, tmp_path: Path, monkeypatch):
    monkeypatch.setattr("sealscope.web.guard._FIRST_PAUSE_S", 50.0)
    settings = PageSettings(host="0.0.0.0", token_file=tmp_path)
    page = TestClient(site(service.actuators, settings, "s3cret"), base_url="http://monitor.example")
    statuses = [page.get("/metrics", headers={"Authorization": f"Bearer {k}"}).status_code for k in range(30)]
    assert statuses == [401] * 5 + [429] * 25
    right = {"Authorization": "Bearer s3cret"}
    refused = page.get("/metrics", headers=right)
    assert refused.status_code == 429 and 0 < int(refused.headers["retry-after"]) <= 50
    assert page.post("/login", data={"token": "s3cret"}).status_code == 429
    assert page.get("/metrics").status_code == 401  # without a token nothing is guessed
    monkeypatch.setattr("sealscope.web.guard._FIRST_PAUSE_S", 0.0)  # the pause is over
    assert page.get("/metrics", headers=right).status_code == 200


@pytest.mark.parametrize(
    "proxies", [pytest.param([], marks=[pytest.mark.slow, pytest.mark.long]), ["192.0.2.1"], ["127.0.0.1"]]
)
def test_who_asks_is_who_connects_unless_a_proxy_is_named(service: Service, tmp_path: Path, monkeypatch, proxies):
    """100 guesses, each for another address: looked at are five, or all where the settings believe this machine."""
    monkeypatch.setattr("sealscope.web.guard._FIRST_PAUSE_S", 50.0)
    (tmp_path / "token").write_text("s3cret")
    service.stopping.clear()
    server = PageServer(service.actuators, PageSettings(port=0, token_file=tmp_path / "token", proxies=proxies))
    try:
        statuses = list[int]()
        for k in range(100):
            line = http.client.HTTPConnection("127.0.0.1", server.port, timeout=20.0)
            headers = {"X-Forwarded-For": f"10.0.0.{k}", "Forwarded": f"for=10.1.0.{k}"}
            line.request("GET", "/metrics", headers={"Authorization": f"Bearer guess {k}", **headers})
            statuses.append(line.getresponse().status)
            line.close()
    finally:
        server.close()
        service.actuators.closed = False
    assert statuses == ([401] * 100 if proxies == ["127.0.0.1"] else [401] * 5 + [429] * 95)


def test_a_proxy_is_an_address(tmp_path: Path):
    for wrong in ("*", "proxy.example", "10.0.0.0/8"):
        with refusal("page.proxies"):
            settings_in(tmp_path, f'[page]\nproxies = ["{wrong}"]\n')


def test_a_session_of_an_earlier_token_is_taken_from_the_browser(service: Service, tmp_path: Path):
    settings = PageSettings(host="0.0.0.0", token_file=tmp_path)
    old, new = (TestClient(site(service.actuators, settings, token), base_url="http://a") for token in ("old", "new"))
    old.post("/login", data={"token": "old"}, follow_redirects=False)
    new.cookies = old.cookies
    answer = new.get("/", follow_redirects=False)
    assert answer.headers["location"] == "/login"
    assert 'sealscope=""' in answer.headers["set-cookie"]


@pytest.mark.parametrize(("scheme", "secure"), [("https", True), ("http", False)])
def test_the_cookie_is_secure_where_the_page_is(service: Service, tmp_path: Path, scheme: str, secure: bool):
    settings = PageSettings(host="0.0.0.0", token_file=tmp_path)
    page = TestClient(site(service.actuators, settings, "s3cret"), base_url=f"{scheme}://monitor.example")
    cookie = page.post("/login", data={"token": "s3cret"}, follow_redirects=False).headers["set-cookie"]
    assert ("; Secure" in cookie) == secure


@pytest.fixture
def server(service: Service) -> Iterator[PageServer]:
    service.stopping.clear()  # it has ended
    served = PageServer(service.actuators, PageSettings(port=0))
    yield served
    served.close()
    service.actuators.closed = False


@pytest.fixture
def narrow(monkeypatch) -> None:
    """A page with room for 20 connections, silent for at most 1 s."""
    monkeypatch.setattr("sealscope.web.guard._CHECK_INTERVAL_S", 0.1)
    monkeypatch.setattr(site_module, "connection_limit", lambda: 20)
    monkeypatch.setattr("sealscope.web.serving.connection_limit", lambda: 20)
    monkeypatch.setattr("sealscope.web.serving.limit_protocol", lambda most: limit_protocol(most, 1.0))


def connected(server: PageServer, count: int, first: bytes = b"") -> list[socket.socket]:
    lines = []
    for _ in range(count):
        lines.append(socket.create_connection(("127.0.0.1", server.port), timeout=10.0))
        lines[-1].sendall(first)
    return lines


def is_closed(line: socket.socket) -> bool:
    line.setblocking(False)
    try:
        return line.recv(1 << 20) == b""
    except BlockingIOError:
        return False
    except OSError:
        return True


def test_silent_connections_leave_room_and_are_closed(narrow, server: PageServer):
    begun = (b"", b"GET / HT", b"GET /api/fleet HTTP/1.1\r\nHost: a\r\nX: ", b"POST /api/mark HTTP/1.1\r\nHost: a\r\n")
    lines = [line for first in begun for line in connected(server, 15, first)]
    with urllib.request.urlopen(server.address + "metrics", timeout=5.0) as answer:
        assert answer.status == 200
    assert sum(map(is_closed, lines)) >= 40
    until(lambda: all(map(is_closed, lines)), 10.0)


def test_a_listener_that_does_not_read_is_closed(narrow, server: PageServer, service: Service):
    (line,) = connected(server, 1)
    line.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    line.sendall(b"GET /uPlot.js HTTP/1.1\r\nHost: localhost\r\n\r\n" * 400)

    def is_refused() -> bool:
        try:
            line.send(b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n", socket.MSG_DONTWAIT)
        except BlockingIOError:
            return False
        except OSError:
            return True
        return False

    until(is_refused)


def test_listeners_have_a_limit(narrow, server: PageServer):
    """Those that ask at once count, too; where one ends, another has room."""
    ask = b"GET /api/changes HTTP/1.1\r\nHost: localhost\r\n\r\n"
    with ExitStack() as held:
        lines = [held.enter_context(line) for line in connected(server, 18, ask)]
        heads = [line.recv(12) for line in lines]
        assert heads.count(b"HTTP/1.1 200") == 10
        assert heads.count(b"HTTP/1.1 503") == 8
        time.sleep(1.4)  # longer than a silent one may be held
        assert not any(is_closed(line) for line, head in zip(lines, heads, strict=True) if head.endswith(b"200"))

    def room() -> bool:
        (line,) = connected(server, 1, ask)
        with line:
            return line.recv(12).endswith(b"200")

    until(room, 10.0)


def test_the_page_leaves_descriptors_to_others():
    soft, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    assert 8 <= connection_limit() <= min(400, max(8, 0.4 * soft))


def test_a_page_whose_server_ends_begins_again(server: PageServer):
    address = (server.port,)
    until(lambda: server._server is not None, 10.0)
    server._server.should_exit = True  # as after an error inside uvicorn
    until(lambda: server._server.started and not server._server.should_exit, 10.0)
    connection = http.client.HTTPConnection("127.0.0.1", *address, timeout=10.0)
    connection.request("GET", "/metrics")
    assert connection.getresponse().status == 200


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.skipif(not os.path.isdir("/proc/self/fd"), reason="descriptors are counted in /proc")  # noqa: PTH112
def test_eleven_hundred_silent_connections(tmp_path: Path):
    """A monitor with 1024 descriptors: its metrics are there, and its log stays small."""
    import json
    import subprocess
    import sys

    from .servers import free_port

    port = free_port()
    learned = "learn_hours = 0.02\nwarning_lpm = 0.0005\n"
    more = f'[defaults]\n{learned}[page]\nport = {port}\n[[actuator]]\nname = "press 1"\n'
    (tmp_path / "m.toml").write_text(f"lines = true\n{more}")
    limit = "import resource; resource.setrlimit(resource.RLIMIT_NOFILE, (1024, 1024)); "
    call = (
        f"{limit}import sys; sys.argv = ['sealscope', 'monitor', 'm.toml']; from sealscope.cli.app import main; main()"
    )
    log, out = (tmp_path / "log").open("wb"), (tmp_path / "out").open("wb")
    process = subprocess.Popen(
        [sys.executable, "-c", call], cwd=tmp_path, stdin=subprocess.PIPE, stdout=out, stderr=log
    )
    held: list[socket.socket] = []
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (min(hard, max(soft, 4096)), hard))
    try:
        until(lambda: b"page:" in (tmp_path / "log").read_bytes(), 60.0)
        assert process.stdin is not None
        time.sleep(1.0)
        held += (socket.create_connection(("127.0.0.1", port), timeout=5.0) for _ in range(1100))
        most = 0
        for _ in range(20):
            most = max(most, len(list(Path(f"/proc/{process.pid}/fd").iterdir())))
            with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=5.0) as answer:
                assert answer.status == 200
            time.sleep(0.2)
        assert most < 550
        process.stdin.write(LINES)
        process.stdin.flush()
        until(lambda: (tmp_path / "out").read_bytes().endswith(b"\n"), 60.0)
        assert json.loads((tmp_path / "out").read_bytes().splitlines()[0])["event"] == "raised"
        until(lambda: all(map(is_closed, held)), 30.0)
        assert (tmp_path / "log").stat().st_size < 10_000
    finally:
        for line in held:
            line.close()
        process.terminate()
        process.wait()
        log.close()
        out.close()
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
