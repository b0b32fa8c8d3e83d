"""The server's contracts without a browser: who is let in, dropped files, hostile names, two apps on one folder."""

from __future__ import annotations

import itertools
import multiprocessing
import random
import sys
import threading
from dataclasses import replace
from multiprocessing.synchronize import Event
from pathlib import Path

import numpy as np
import pytest
from starlette.testclient import TestClient
from tests.representatives import SLOW, few

from sealscope.app.session import HOLD_FIELDS, SessionFolder, SessionMachine
from sealscope.app.site import CHANGES, READERS, make_site
from sealscope.app.tables import MappedTable, mean_rates
from sealscope.errors import InputError

from .conftest import CHANGE, ORIGIN, settle, tell

HOSTILE = (
    "../../etc/passwd", "x\ny", "<script>alert(1)</script>", "x" * 2500, "/etc/shadow", "a/b", "a\\b", "..", ".", "",
    " ", ".hidden", "x\0y", "\u202etxt", "'; DROP TABLE", "%2e%2e%2f", "\ud800".encode("utf-8", "replace").decode(),
)  # fmt: skip


def test_the_token_opens_once(bench, guard) -> None:
    first = TestClient(make_site(bench, guard), base_url=ORIGIN, follow_redirects=False)
    token = guard.token
    assert first.get("/").status_code == 401
    assert first.get("/api/state").status_code == 401
    assert first.get("/start", params={"token": token}).status_code == 303
    assert first.get("/").status_code == 200
    second = TestClient(make_site(bench, guard), base_url=ORIGIN, follow_redirects=False)
    assert second.get("/start", params={"token": token}).status_code == 401
    assert "set-cookie" not in second.get("/start", params={"token": token}).headers
    assert second.get("/api/state").status_code == 401
    second.cookies.set("sealscope-app", "guessed")
    assert second.get("/api/state").status_code == 401


def test_guessed_tokens_must_wait(bench, guard) -> None:
    thief = TestClient(make_site(bench, guard), base_url=ORIGIN, follow_redirects=False)
    statuses = [thief.get("/start", params={"token": f"guess {k}"}).status_code for k in range(8)]
    assert statuses[:5] == [401] * 5 and statuses[-1] == 429


@pytest.mark.parametrize(
    "headers",
    [
        {"Origin": "http://evil.example"},
        {"Origin": "null"},
        {"Origin": "http://127.0.0.1:81"},
        {"Sec-Fetch-Site": "cross-site"},
        {"Sec-Fetch-Site": "same-site"},
        {"X-Sealscope": ""},
        {"Host": "evil.example"},
    ],
    ids=str,
)
def test_a_change_from_elsewhere_is_refused(bench, client, headers: dict[str, str], tmp_path: Path) -> None:
    answer = client.post("/api/open", json={"path": str(tmp_path)}, headers=CHANGE | headers)
    assert answer.status_code in (400, 403)
    answer = client.put("/api/drop?name=a.csv&size=1&offset=0", content=b"x", headers=CHANGE | headers)
    assert answer.status_code in (400, 403)
    assert bench.folder.read().sources == ()


def test_a_form_of_another_site_is_refused(bench, client, tmp_path: Path) -> None:
    form = {"Content-Type": "application/x-www-form-urlencoded", "Origin": "http://evil.example"}
    assert client.post("/api/open", content=f"path={tmp_path}", headers=form).status_code == 403
    assert client.get("/api/state", headers={"Sec-Fetch-Site": "cross-site"}).status_code == 403
    assert client.get("/", headers={"Host": "rebound.example"}).status_code == 400


def test_every_answer_forbids_foreign_scripts(client) -> None:
    for address in ("/", "/main.mjs", "/app.css", "/uPlot.js", "/base.js", "/api/state", "/api/nothing"):
        answer = client.get(address)
        assert "default-src 'none'" in answer.headers["content-security-policy"]
        assert "unsafe" not in answer.headers["content-security-policy"]
        assert answer.headers["x-content-type-options"] == "nosniff"


@pytest.mark.parametrize("text", few(HOSTILE, 4, SLOW), ids=lambda text: repr(text[:12]))
def test_hostile_texts_in_every_field_are_refused_in_a_line(bench, client, text: str) -> None:
    before = sorted(path.name for path in bench.folder.folder.parent.iterdir())
    changes = [
        ("open", {"path": text}), ("close", {"source": text}), ("mend", {"file": text, "layout": {"first_row": text}}),
        ("machine", {"machine": text, "values": {}}), ("mark", {"machine": text, "files": [text], "mark": text}),
        ("commission", {"machine": text}), ("opinion", {"machine": text, "file": text, "opinion": text}),
        ("report", {"machine": text, "file": text}), ("watch", {"machine": text, "folder": text}),
    ]  # fmt: skip
    tell(client, "machine", machine="seven", values={})
    log = bench.folder.folder / "log.csv"
    log.write_text("t [s],p_A [bar]\n" + "".join(f"{k},{k}\n" for k in range(9)), encoding="utf-8")
    tell(client, "open", path=str(log))
    fields = ("name", "rig", "bore", "rod", "rods", "displacement", "limit", "rate")
    changes += [("machine", {"machine": "seven", "values": {field: text}}) for field in fields if text.strip()]
    changes += [("machine", {"machine": "seven", "values": {"map": {"p_A": text, text: "x"}}})]
    changes += [("machine", {"machine": "seven", "values": {field: [text]}}) for field in ("area", "repairs")]
    changes += [("machine", {"machine": "seven", "values": {"hold": {field: text}}}) for field in (*HOLD_FIELDS, text)]
    layout = ("first_row", "heading_row", "time_column", "delimiter", "decimal", "time_format")
    changes += [("mend", {"file": str(log), "layout": {field: text}}) for field in layout if text.strip()]
    changes += [(what, {"machine": text, "file": text}) for what in ("hold-page", "trend-page", "remove")]
    changes += [
        ("judge", {"machine": text, "files": [text]}),
        ("trend", {"machines": [text]}),
        ("cancel", {"kind": text}),
    ]
    assert {what for what, _ in changes} == CHANGES.keys()
    for what, values in changes:
        answer = client.post(f"/api/{what}", json=values, headers=CHANGE)
        assert answer.status_code in (200, 400), (what, answer.status_code)
        if answer.status_code == 400:
            assert "\n" not in answer.json()["error"]
    for what in (*READERS, "nothing"):
        query = {"file": text, "machine": text, "table": text, "columns": text, "from": text, "screen": text}
        query |= {"text": text, "rpm": text, "kind": text, "channels": text, **dict.fromkeys(layout, text)}
        query = query if what != "state" else {"since": text}
        assert client.get(f"/api/{what}", params=query).status_code in ((404,) if what == "nothing" else (200, 400))
        seen = client.get(f"/api/{what}", params=query | {"file": str(log), "machine": "seven"})
        assert seen.status_code in (200, 400, 404)
    for address in ("/report/", "/machine/"):
        assert client.get(address + "..%2f..%2fetc%2fpasswd").status_code == 404
    answer = client.put("/api/drop", params={"name": text, "size": 1, "offset": 0}, content=b"x", headers=CHANGE)
    if answer.status_code == 200:
        assert (bench.folder.folder / "dropped" / text).read_bytes() == b"x"
    assert sorted(path.name for path in bench.folder.folder.parent.iterdir() if path.name != "cache") == [
        name for name in before if name != "cache"
    ]
    SessionFolder(bench.folder.folder).read()  # still a valid session


@pytest.mark.parametrize("seed", range(3))
def test_a_dropped_file_is_resumed_after_breaks(bench, client, seed: int) -> None:
    """Pieces of any sizes, some sent twice or too early, give the same bytes; no wrong piece is taken."""
    draw = random.Random(seed)
    data = draw.randbytes(draw.randrange(1, 40_000))
    query = {"name": f"log {seed}.csv", "size": len(data)}
    while (offset := client.get("/api/drop", params=query).json()["offset"]) < len(data):
        start = offset if draw.random() < 0.7 else max(0, offset + draw.choice((-7, 7)))
        piece = data[start : start + draw.randrange(1, 9000)]
        answer = client.put("/api/drop", params=query | {"offset": start}, content=piece, headers=CHANGE)
        assert answer.status_code == (200 if start == offset else 409)
    assert (bench.folder.folder / "dropped" / f"log {seed}.csv").read_bytes() == data
    assert f"dropped/log {seed}.csv" in bench.folder.read().sources
    settle(bench)


def test_a_piece_that_is_too_large_is_refused(client) -> None:
    query = {"name": "big.csv", "size": 20_000_000, "offset": 0}
    assert client.put("/api/drop", params=query, content=b"0" * 9_000_000, headers=CHANGE).status_code == 400
    assert client.get("/api/drop", params={"name": "big.csv", "size": 20_000_000}).json() == {"offset": 0}


def test_two_apps_on_one_folder_lose_nothing(tmp_path: Path) -> None:
    """Changes of two sessions at once are all in the file."""
    folders = [SessionFolder(tmp_path) for _ in range(2)]
    for folder in folders:
        folder.open()

    def work(folder: SessionFolder, name: str) -> None:
        for k in range(12):
            folder.update(lambda session, k=k: session.with_machine(SessionMachine(name=f"{name} {k}")))

    threads = [threading.Thread(target=work, args=(folder, name)) for folder, name in zip(folders, "ab", strict=True)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    names = {machine.name for machine in SessionFolder(tmp_path).read().machine}
    assert names == {f"{name} {k}" for name in "ab" for k in range(12)}


def save_for_ever(folder: Path, saving: Event) -> None:
    """Save a session again and again, in a process that is killed."""
    session = SessionFolder(folder)
    session.open()
    saving.set()
    for k in itertools.count():
        healthy = tuple(f"log {i}" for i in range(k % 400))
        session.update(lambda known, healthy=healthy: known.with_machine(SessionMachine(name="m", healthy=healthy)))


@pytest.mark.skipif(sys.platform != "linux", reason="processes are forked")
@pytest.mark.parametrize("kills", [3, pytest.param(40, marks=pytest.mark.slow)])
def test_a_session_survives_a_kill_while_it_is_saved(tmp_path: Path, kills: int) -> None:
    folder = SessionFolder(tmp_path)
    folder.open()
    draw, processes = random.Random(7), multiprocessing.get_context("fork")
    for _ in range(kills):
        saving = processes.Event()
        process = processes.Process(target=save_for_ever, args=(tmp_path, saving), daemon=True)
        process.start()
        assert saving.wait(60.0)
        threading.Event().wait(draw.uniform(0.0, 0.15))
        process.kill()
        process.join()
        session = SessionFolder(tmp_path).read()
        assert [machine.name for machine in session.machine] in ([], ["m"])
    folder.update(lambda session: replace(session, sources=("still",)))
    folder.open()  # removes what killed processes have left
    assert not list(tmp_path.glob(".*.part"))


@pytest.mark.parametrize("seed", range(4))
def test_a_window_holds_the_extremes_of_every_pixel(tmp_path: Path, seed: int) -> None:
    """Minimum and maximum of each column are those of the finite samples, whatever the window."""
    draw = np.random.default_rng(seed)
    count = int(draw.integers(1, 5000))
    t = np.cumsum(draw.uniform(0.5, 1.5, count)) * 0.01
    values = draw.normal(size=count)
    values[draw.random(count) < 0.05] = np.nan
    values[draw.random(count) < 0.02] = np.inf
    table = MappedTable(tmp_path)
    for part in np.array_split(np.arange(count), 3):
        table.append(t[part], [values[part], t[part]])
    begin, end = np.sort(draw.uniform(t[0] - 1, t[-1] + 1, 2))
    window = table.window([0, 1], float(begin), float(end), int(draw.integers(2, 300)))
    inside = values[(t >= begin) & (t <= end) & np.isfinite(values)]
    seen = np.asarray(window["lines"][0])
    seen = seen[np.isfinite(seen)]
    if inside.size:
        assert seen.min() <= inside.min() and seen.max() >= inside.max()
    assert np.all(np.isin(seen, values))
    assert len(window["t"]) == len(window["lines"][0]) <= 2 * 300 + 4
    rates = mean_rates(table, [1], None, None, 50, 0.05)
    assert np.allclose(rates["lines"][0], 60.0)  # the time grows by 60 s a minute


def test_a_machine_is_checked_before_it_is_kept() -> None:
    for wrong in (
        {"name": "a/b"},
        {"name": "x", "limit": "5"},
        {"name": "x", "area": ("3 s",)},
        {"name": "x", "rate": -1.0},
    ):
        with pytest.raises(InputError):
            SessionMachine(**wrong).check()
