"""What goes out beside lines and messages: posted events, Grafana's dashboard, labelled data."""

from __future__ import annotations

import csv
import json
import logging
import re
import threading
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path

import pytest

from sealscope.monitor.database.export import ESTIMATE_COLUMNS, export_labels
from sealscope.monitor.outputs.events import Webhook
from sealscope.monitor.outputs.grafana import dashboard
from sealscope.monitor.outputs.prometheus import format_metrics
from sealscope.monitor.settings import template
from sealscope.monitor.supervisor import PartAway

from ..refusals import refusal
from .plant import WORN, lines_of, served, settings_in

LINES = lines_of({"press 1": WORN}, 150)
ROOT = Path(__file__).resolve().parents[2]


class Receiver:
    """A server that answers posts with the given statuses in turn, then with 204, and keeps what it got."""

    def __init__(self, statuses=(), location=None):
        self.got, answers = [], list(statuses)
        got = self.got

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self):
                body = self.rfile.read(int(self.headers["Content-Length"]))
                got.append((dict(self.headers), json.loads(body)))
                self.send_response(answers.pop(0) if answers else 204)
                if location:
                    self.send_header("Location", location)
                self.end_headers()

            def log_message(self, *_):
                pass

        self.server = HTTPServer(("127.0.0.1", 0), Handler)
        self.url = f"http://127.0.0.1:{self.server.server_port}/alarms"
        threading.Thread(target=self.server.serve_forever, daemon=True).start()


@pytest.fixture(scope="module")
def watched(tmp_path_factory):
    folder = tmp_path_factory.mktemp("watched")
    service, _ = served(settings_in(folder), LINES)
    service.actuators.apply_mark("press 1", "comment", by_whom="ann", text="=looks real")
    service.actuators.apply_mark("press 1", "repaired", by_whom="ann", text="seal changed")
    return service


def test_events_are_posted_in_order_until_they_are_taken(watched, caplog):
    receiver = Receiver([500, 503])
    hook = Webhook(watched.store, receiver.url, "secret token")
    with caplog.at_level(logging.DEBUG, "sealscope"):
        for _ in range(4):
            watched.supervisor.part("webhook").attempt(hook.deliver, at_once=True)
    posted = [(headers["Idempotency-Key"], body["event"]) for headers, body in receiver.got]
    events = watched.store.events_since(0)
    first = (str(events[0][0]), events[0][1]["event"])
    assert posted == [first, first, *((str(number), event["event"]) for number, event in events)]
    assert [event for _, event in posted[2:]] == ["raised", "comment", "repaired"]
    assert receiver.got[0][0]["Authorization"] == "Bearer secret token"
    assert receiver.got[-1][1] == events[-1][1]
    assert "status 500" in caplog.text
    assert "secret" not in caplog.text
    Webhook(watched.store, receiver.url).deliver()  # after a restart nothing comes twice
    assert len(receiver.got) == len(posted)


def test_a_redirect_is_not_followed_and_carries_no_token(watched):
    elsewhere = Receiver()
    receiver = Receiver([307, 307], location=elsewhere.url)
    watched.store.write_position("webhook", 0)
    with refusal("307", error=PartAway):
        Webhook(watched.store, receiver.url, "secret").deliver()
    assert len(receiver.got) == 1
    assert elsewhere.got == []
    assert watched.store.position("webhook") == 0  # it waits


@pytest.mark.slow
def test_the_service_posts_what_is_left_when_it_ends(tmp_path):
    receiver = Receiver()
    (tmp_path / "token.txt").write_text("hook\n")
    hook = f'[webhook]\nurl = "{receiver.url}"\ntoken_file = "token.txt"\n'
    served(settings_in(tmp_path, hook), LINES)
    assert [body["event"] for _, body in receiver.got] == ["raised"]
    assert receiver.got[0][0]["Authorization"] == "Bearer hook"


@pytest.mark.parametrize("name", ["sparkplug", "webhook"])
def test_an_output_has_lines_in_the_template_and_on_the_page(name):
    assert f"# [{name}]" in template()
    assert re.search(rf"^\|.*`\[{name}\]`", (ROOT / "docs" / "monitor.md").read_text(encoding="utf-8"), re.MULTILINE)


def test_the_dashboard_asks_for_metrics_that_there_are(watched):
    text = format_metrics(watched.actuators.summaries(), {"oversized messages": 2}, {"broker": (True, 1, 2.5)})
    summary = {name: dict(values, counters={"gap": 1}) for name, values in watched.actuators.summaries().items()}
    families = set(re.findall(r"^# TYPE (\S+)", text + format_metrics(summary, {}), re.MULTILINE))
    board = json.loads(json.dumps(dashboard()))
    asked = {name for panel in board["panels"] for name in re.findall(r"sealscope_\w+", panel["targets"][0]["expr"])}
    assert asked <= families
    assert {"sealscope_leak_lpm", "sealscope_severity", "sealscope_total_lpm"} <= asked
    places = [panel["gridPos"] for panel in board["panels"]]
    cells = [(x, y) for p in places for x in range(p["x"], p["x"] + p["w"]) for y in range(p["y"], p["y"] + p["h"])]
    assert len(cells) == len(set(cells))  # no panel lies over another
    assert max(x for x, _ in cells) < 24


def test_what_a_person_said_labels_the_estimates(watched, tmp_path):
    counts = export_labels(watched.store, tmp_path)
    alarms = list(csv.DictReader((tmp_path / "alarms.csv").open()))
    estimates = list(csv.DictReader((tmp_path / "estimates.csv").open()))
    assert counts == (len(alarms), len(estimates)) == (1, 44)
    assert alarms[0]["mark"] == "repaired"
    assert alarms[0]["marked_by"] == "ann"
    assert alarms[0]["comments"] == "ann: =looks real; ann: seal changed"
    assert tuple(estimates[0]) == ESTIMATE_COLUMNS
    low = float(alarms[0]["onset_low_s"])
    for row in estimates:
        assert row["label"] == ("leak" if float(row["t"]) >= low else "")
    assert {row["alarm"] for row in estimates if row["label"]} == {alarms[0]["id"]}
