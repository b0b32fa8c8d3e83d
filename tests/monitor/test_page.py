"""The page: what it serves, whom it serves, what a person can say on it; driven in a browser."""

from __future__ import annotations

import io
import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import pytest
from prometheus_client.parser import text_string_to_metric_families
from starlette.testclient import TestClient

from sealscope.diagnosis.verdict.severity import state_of
from sealscope.errors import InputError
from sealscope.monitor.alarms import rank_actuators
from sealscope.monitor.page.live import LiveSamples
from sealscope.monitor.page.site import PageServer, site
from sealscope.monitor.service import Service
from sealscope.monitor.settings import MonitorSettings, PageSettings
from sealscope.recordings.recording import Recording

from ..refusals import refusal
from .plant import HEALTHY, WORN, is_viewed, lines_of, until

HOSTILE = '<img src=x onerror="document.title=1">\\ \n&amp;'
#: A browser that draws two frames a second, as where many look at many pages.
SLOW_FRAMES = (
    "requestAnimationFrame = (drawn) => setTimeout(() => drawn(performance.now()), 500);"
    "cancelAnimationFrame = clearTimeout;"
)
PAGES = (
    "/",
    "/page.js",
    "/live.js",
    "/twin.js",
    "/page.css",
    "/uPlot.js",
    "/uPlot.css",
    "/metrics",
    "/api/fleet",
    "/login",
)


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    """A monitor that has seen a leak in an actuator whose name is markup."""
    settings = MonitorSettings.model_validate(
        {
            "database": str(tmp_path_factory.mktemp("page") / "monitor.db"),
            "lines": True,
            "defaults": {"learn_hours": 0.02, "warning_lpm": 0.0005},
            "actuator": [{"name": "a healthy one"}, {"name": HOSTILE}],
        }
    )
    lines = lines_of({HOSTILE: WORN, "a healthy one": HEALTHY}, 500)
    service = Service(settings, once=True, stdin=io.BytesIO(lines), stdout=io.StringIO())
    service.run()
    return service


@pytest.fixture
def page(service: Service) -> TestClient:
    return TestClient(site(service.actuators, PageSettings(), None), base_url="http://localhost")


def of(name: str) -> str:
    from urllib.parse import quote

    return f"/api/actuator?name={quote(name, safe='')}"


def mark_of(name: str) -> str:
    return of(name).replace("actuator", "mark", 1)


def test_everything_is_served_and_nothing_comes_from_elsewhere(page: TestClient):
    for address in PAGES:
        answer = page.get(address)
        assert answer.status_code == 200
        assert answer.headers["content-security-policy"].startswith("default-src 'none'; script-src 'self'")
        if address in ("/", "/page.js", "/live.js", "/twin.js", "/page.css"):
            assert "http://" not in answer.text and "https://" not in answer.text
            assert "innerHTML" not in answer.text and "style=" not in answer.text


def test_the_leaking_one_comes_first_with_its_life(page: TestClient):
    rows = page.get("/api/fleet").json()["actuators"]
    assert [row["name"] for row in rows] == [HOSTILE, "a healthy one"]
    assert rows[0]["alarm"]["level"] == "warning"
    life = page.get(of(HOSTILE)).json()
    assert life["name"] == HOSTILE
    assert life["events"][-1]["event"] == "raised"
    assert len(life["course"]) == 44
    assert 0 < len(page.get(of(HOSTILE) + "&hours=0.01").json()["course"]) < 20
    assert page.get(of("no such")).status_code == 404


def test_a_course_of_many_blocks_is_means(service: Service):
    whole = service.store.history("a healthy one")
    few = service.store.history("a healthy one", max_rows=10)
    assert len(few) <= 11
    assert few[5]["total_lpm"] == pytest.approx(sum(row["total_lpm"] for row in whole[24:29]) / 5, rel=0.05)


def test_a_mark_needs_the_page_and_an_alarm(page: TestClient):
    address, header = mark_of("a healthy one"), {"X-Sealscope": "mark"}
    assert page.post(address, json={"mark": "acknowledged"}).status_code == 403
    answer = page.post(address, json={"mark": "acknowledged"}, headers=header)
    assert (answer.status_code, answer.json()) == (
        400,
        {"error": "a healthy one must have an open alarm for the mark acknowledged, got none"},
    )
    for body in (b"{", b"[]", b'{"mark": 3}', b'{"mark": "' + b"x" * 20_000 + b'"}', b'{"mark": "away"}'):
        assert page.post(address, content=body, headers=header).status_code == 400
    for text in ("a\0b", "\ud800"):
        unstorable = page.post(mark_of(HOSTILE), content=json.dumps({"mark": "comment", "text": text}), headers=header)
        assert (unstorable.status_code, unstorable.json()["error"][:24]) == (400, "a comment must be text, ")
    comment = {"mark": "comment", "text": "<script>alert(1)</script>", "by": "Ada"}
    assert page.post(mark_of(HOSTILE), json=comment, headers=header).status_code == 200
    assert page.get(of(HOSTILE)).json()["events"][0]["text"] == comment["text"]


def test_other_sites_names_for_this_machine_are_refused(page: TestClient):
    assert page.get("/api/fleet", headers={"Host": "evil.example"}).status_code == 400


def test_beyond_this_machine_a_token_opens(service: Service, tmp_path: Path):
    page = TestClient(
        site(service.actuators, PageSettings(host="0.0.0.0", token_file=tmp_path), "s3cret"),
        base_url="http://localhost",
    )
    for address in ("/api/fleet", "/metrics", "/page.js", of(HOSTILE)):
        assert page.get(address).status_code == 401
    assert page.get("/", follow_redirects=False).headers["location"] == "/login"
    assert page.get("/api/fleet", headers={"Authorization": "Bearer s3cret"}).status_code == 200
    assert page.get("/api/fleet", headers={"Authorization": "Bearer s3cres"}).status_code == 401
    assert page.post("/login", data={"token": "guess"}).status_code == 401
    answer = page.post("/login", data={"token": "s3cret"}, follow_redirects=False)
    cookie = answer.headers["set-cookie"]
    assert answer.status_code == 303
    assert "HttpOnly" in cookie and "SameSite=strict" in cookie and "s3cret" not in cookie
    assert page.get("/api/fleet").status_code == 200


def test_prometheus_reads_the_metrics(page: TestClient):
    answer = page.get("/metrics")
    assert answer.headers["content-type"].startswith("text/plain; version=0.0.4")
    families = {family.name: family for family in text_string_to_metric_families(answer.text)}
    leaks = {sample.labels["actuator"]: sample.value for sample in families["sealscope_leak_lpm"].samples}
    assert leaks[HOSTILE] == pytest.approx(0.00195, rel=0.1)
    words = {sample.labels["actuator"]: sample.value for sample in families["sealscope_status_word"].samples}
    assert words == {HOSTILE: 5.0, "a healthy one": 0.0}
    assert families["sealscope_blocks"].type == "counter"


def test_the_order_is_severity_new_then_evidence_then_the_sure_leak():
    def row(condition: str, word: int, low: float) -> dict[str, object]:
        own = {"status_word": word, "leak_interval_lpm": [low, 1.0], "leak_lpm": 0.5}
        return {**own, "state": state_of(condition).as_dict()}

    leaks = {"less": row("leak", 1, 0.1), "more": row("leak", 1, 0.2), "bad": row("leak over the limit", 2, 0.0)}
    others = {"quiet": row("watched", 0, 0.0), "gone": row("watched", 4, 0), "silent": row("no data", 0, 0.0)}
    names = [each["name"] for each in rank_actuators({**others, **leaks}, [])]
    assert names == ["bad", "more", "less", "silent", "gone", "quiet"]
    alarms = [{"actuator": "less", "by_chance_per_1000_h": 1e-6}, {"actuator": "more", "by_chance_per_1000_h": 1e-3}]
    names = [each["name"] for each in rank_actuators({**others, **leaks}, alarms)]
    assert names == ["bad", "less", "more", "silent", "gone", "quiet"]


def test_a_port_in_use_is_one_line(service: Service):
    first = PageServer(service.actuators, PageSettings(port=0))
    with refusal("page.port", "127.0.0.1"):
        PageServer(service.actuators, PageSettings(port=first.port))
    first.close()
    service.actuators.closed = False


def test_the_address_of_an_ipv6_host_names_its_host_and_port(service: Service):
    try:
        server = PageServer(service.actuators, PageSettings(host="::1", port=0))
    except InputError:
        pytest.skip("this computer has no IPv6")
    parts = urlsplit(server.address)
    assert (parts.hostname, parts.port) == ("::1", server.port)
    with refusal("page.port", f"[::1]:{server.port}"):
        PageServer(service.actuators, PageSettings(host="::1", port=server.port))
    server.close()
    service.actuators.closed = False


def look_at_the_live_part(view: Any, live: LiveSamples) -> None:
    """Pressures, details and the drawing show what comes, say what does not, and stop while nobody looks."""

    def shown(samples: Recording, place: str, words: str) -> bool:
        # a page that has just asked for another stream does not see what comes between the two; repeated is ignored
        live.push(HOSTILE, samples)
        return words in (view.text_content(place) or "")

    until(lambda: shown(WORN.between(0.0, 60.0), "#live-says", "As of 00:00:59, 50 Hz"))
    view.locator("#pressures canvas").wait_for()
    view.locator("#details canvas").wait_for()
    assert (view.text_content("#twin-leak-text") or "").startswith("leak 0.00")
    assert view.locator("#twin-leak").is_visible() and not view.locator("#twin-valve").is_visible()
    view.locator("#twin-x", has_text=" mm").wait_for()
    away = "() => document.querySelector('#twin-moving').getAttribute('transform') != 'translate(200.00 0)'"
    view.wait_for_function(away)
    view.locator("[data-drawn=details]").focus()
    view.keyboard.press("Enter")
    until(lambda: shown(WORN.between(60.0, 70.0), "#details-title", "Details d1 to d4"))
    until(lambda: view.locator("#details canvas").is_visible())
    pressures = WORN.between(70.0, 74.0).only(("p_A", "p_B"))
    until(lambda: shown(pressures, "#twin-missing", "No position is recorded"))
    # the drawing changes with what is said of it, not a frame later
    assert view.get_attribute("#twin-moving", "transform") == "translate(200.00 0)"
    view.locator("#pause").click()
    until(lambda: not is_viewed(live, HOSTILE))  # nothing is sent any more
    view.locator("#pause").click()
    until(lambda: is_viewed(live, HOSTILE))


@pytest.mark.slow
def test_the_page_in_a_browser(service: Service, tmp_path: Path):
    """The alarm appears, the hostile name stays text, the alarm is acknowledged by keyboard, at both widths."""
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    browser_path = shutil.which("chromium")
    if browser_path is None:
        pytest.skip("chromium is not installed")
    live = LiveSamples(service.store.last_samples)
    server = PageServer(service.actuators, PageSettings(port=0), live=live)
    try:
        with playwright.sync_playwright() as player:
            browser = player.chromium.launch(executable_path=browser_path, args=["--no-sandbox"])
            for width in (400, 1280):
                view = browser.new_page(viewport={"width": width, "height": 900})
                view.add_init_script(SLOW_FRAMES)
                errors: list[str] = []
                view.on("pageerror", lambda error, observed=errors: observed.append(str(error)))
                view.on(
                    "console",
                    lambda line, observed=errors: observed.append(line.text) if line.type == "error" else None,
                )
                view.goto(server.address)
                view.wait_for_selector("#alarm:not([hidden])")
                assert view.text_content("#life-title") == HOSTILE
                assert view.title() == "Sealscope monitor"
                assert view.locator("img").count() == 0
                assert view.evaluate("document.documentElement.scrollWidth") <= width
                assert view.locator("#chart canvas").count() == 1
                # what is wrong, how much, its limit and what to do stand in the first screen
                assert view.locator("#fleet .badge").all_text_contents() == ["Mmaintenance required", "Ngood"]
                line = view.text_content("#state") or ""
                assert "maintenance required" in line and "L/min since" in line and "hold a load" in line
                assert "limit 0.0005 L/min" in line
                for part in ("#fleet", "#overall", "#state", *(() if width == 400 else ("#chart",))):
                    box = view.locator(part).bounding_box()
                    assert box is not None and box["y"] + box["height"] <= 900
                image = view.screenshot(path=tmp_path / f"monitor-{width}.png")
                assert len(image) > 10_000
                if width == 400:
                    view.keyboard.press("Tab")
                    assert view.evaluate("document.activeElement.dataset.name") == HOSTILE
                    view.locator("#marks button[value=acknowledged]").focus()
                    view.keyboard.press("Enter")
                    view.locator("#mark-answer", has_text="acknowledged").wait_for()
                    view.locator("#alarm-title", has_text="acknowledged").wait_for()
                assert "acknowledged" in (view.text_content("#alarm-title") or "")
                assert view.locator("#workflow [aria-current=step]").text_content() == "acknowledged"
                assert view.locator("#marks button[value=acknowledged]").is_disabled()
                view.locator("#marks button[value=invalid]").click()
                view.locator("#mark-answer", has_text="reason").wait_for()
                assert view.locator("#alarm").is_visible()
                look_at_the_live_part(view, live)
                assert errors == []
                service.supervisor.part("broker").begin_outage("<b>gone</b>")
                view.locator("#outages", has_text="The broker is not reached").wait_for()
                assert "<b>gone</b>" in (view.text_content("#outages") or "")
                assert view.evaluate("document.documentElement.scrollWidth") <= width
                service.supervisor.part("broker").end_outage()
                view.locator("#outages").wait_for(state="hidden")
                view.close()
            browser.close()
    finally:
        server.close()
        service.actuators.closed = False
    assert service.store.alarms(actuator=HOSTILE)[0]["state"] == "acknowledged"


def test_an_alarm_goes_through_its_life_and_survives_a_restart(tmp_path: Path):
    """New, acknowledged, valid, closed by a repair; the next one invalid for a reason: as the database has it."""
    settings = MonitorSettings.model_validate(
        {
            "database": str(tmp_path / "monitor.db"),
            "lines": True,
            "defaults": {"learn_hours": 0.02, "warning_lpm": 0.0005},
            "actuator": [{"name": "press"}],
        }
    )
    lines = lines_of({"press": WORN}, 500)

    def restarted(taken: bytes = b"", **said: str) -> tuple[dict[str, Any], dict[str, Any]]:
        service = Service(settings, once=True, stdin=io.BytesIO(taken), stdout=io.StringIO())
        service.run()
        view = TestClient(site(service.actuators, PageSettings(), None), base_url="http://localhost")
        if said:
            assert view.post(mark_of("press"), json=said, headers={"X-Sealscope": "mark"}).status_code == 200
        life = view.get(of("press")).json()
        service.store.engine.dispose()
        return life["alarms"][0], life["summary"]["state"]

    alarm, state = restarted(lines)
    assert (alarm["state"], state["name"], state["condition"]) == ("new", "maintenance required", "leak")
    assert state == alarm["machine_state"]
    assert restarted(mark="acknowledged")[0]["state"] == "acknowledged"
    assert restarted(mark="valid", by="Ada")[0]["state"] == "valid"
    assert restarted()[1]["name"] == "maintenance required"
    alarm, state = restarted(mark="repaired")
    assert (alarm["state"], alarm["mark"], state["condition"]) == ("closed", "repaired", "learning")
    assert (state["name"], state["since_s"]) == ("check function", alarm["updated_s"])
    assert restarted()[0]["state"] == "closed"


@pytest.mark.slow
def test_silence_and_a_duty_that_is_not_known_have_delays_of_their_own(tmp_path: Path):
    def state(name: str, samples: Any, **delays: float) -> dict[str, Any]:
        database = str(tmp_path / f"{name}.db")
        defaults = {"learn_hours": 0.02, **delays}
        settings = {"database": database, "lines": True, "defaults": defaults, "actuator": [{"name": "a"}]}
        lines = io.BytesIO(lines_of({"a": samples}, 500))
        service = Service(MonitorSettings.model_validate(settings), once=True, stdin=lines, stdout=io.StringIO())
        service.run()
        return service.summaries()["a"]["state"]

    t, other = HEALTHY.t, HEALTHY.t > 90.0
    channels = {name: np.where(other, HEALTHY[name][0], HEALTHY[name]) for name in HEALTHY.channels}
    resting = Recording(t, channels, HEALTHY.units, HEALTHY.rate)  # from 90 s on it stands still
    assert state("healthy", HEALTHY)["condition"] == "watched"
    assert state("patient", resting, not_comparable_s=1e4)["condition"] == "watched"
    own = state("impatient", resting, not_comparable_s=20.0)
    assert (own["condition"], own["name"]) == ("not comparable", "out of specification")
    assert own["since_s"] == pytest.approx(90.0, abs=4.0)
    silent = state("silent", HEALTHY, no_data_s=1e-6)
    assert (silent["condition"], silent["name"], silent["since_s"] > 120.0) == ("no data", "check function", True)
    assert state("leaking", WORN, no_data_s=1e-6)["condition"] == "leak"  # which silence does not take back
