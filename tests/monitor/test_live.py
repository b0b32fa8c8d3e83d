"""What the page draws of the last seconds: what was sent, however it was cut; kept only while somebody looks."""

from __future__ import annotations

import http.client
import json
from collections.abc import Iterator
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sealscope.monitor.actuators import WatchedActuators
from sealscope.monitor.database.store import MonitorStore
from sealscope.monitor.page.live import MAX_ACTUATORS, MAX_SAMPLES, LiveSamples, describe_rig
from sealscope.monitor.page.site import PageServer
from sealscope.monitor.settings import ActuatorSettings, PageSettings
from sealscope.recordings.recording import Recording
from sealscope.signals.details import details as transform
from sealscope.signals.windows import windowed_rms

from .plant import is_viewed, until

RATE = 500.0
UNITS = {"p_A": "Pa", "p_B": "Pa", "x": "m", "theta": "rad"}


def moving(seconds: float, start: float = 0.0, **changed: np.ndarray | None) -> Recording:
    """A piston at 20 mm sin(4 t), a pump that turns at 3 rad/s, pressures with noise."""
    t = start + np.arange(round(seconds * RATE)) / RATE
    noise = np.random.default_rng(1).normal(0.0, 2e3, (2, t.size))
    channels = {"p_A": 3e5 + 1e5 * np.sin(4.0 * t) + noise[0], "p_B": 3e5 - 1e5 * np.sin(4.0 * t) + noise[1]}
    channels |= {"x": 0.02 * np.sin(4.0 * t), "theta": 3.0 * t, **changed}
    kept = {name: values for name, values in channels.items() if values is not None}
    return Recording(t, kept, {name: UNITS[name] for name in kept}, RATE)


SENT = moving(12.0)


def pictured(*blocks: Recording, **options: str) -> dict[str, object]:
    live = LiveSamples()
    with live.viewing("press"):
        for block in blocks:
            live.push("press", block)
        picture = live.curves("press", **options)
    json.dumps(picture, allow_nan=False)
    return picture


def test_nothing_is_kept_of_what_nobody_looks_at_and_little_of_what_somebody_does():
    live = LiveSamples(lambda name: [SENT])
    live.push("press", SENT)
    assert live.version("press") == 0
    with live.viewing("press") as first, live.viewing("press"):
        assert first and live.version("press") == 1  # what is stored is there at once
        live.push("another", SENT)
        assert live.version("another") == 0
        fast = Recording(
            100.0 + np.arange(10 * MAX_SAMPLES) / 1e5, {"p_A": np.ones(10 * MAX_SAMPLES)}, {"p_A": "Pa"}, 1e5
        )
        live.push("press", fast)
        picture = live.curves("press")
        assert picture["t"] == fast.t[-1] and len(picture["pressures"]["t"]) <= 800
        assert picture["pressures"]["t"][0] == pytest.approx(-MAX_SAMPLES / 1e5, abs=1e-4)
    assert not is_viewed(live, "press")
    watched = [live.viewing(f"press {k}") for k in range(MAX_ACTUATORS + 1)]
    assert [each.__enter__() for each in watched] == [True] * MAX_ACTUATORS + [False]
    for each in watched:
        each.__exit__(None, None, None)
    assert not any(is_viewed(live, f"press {k}") for k in range(MAX_ACTUATORS))


def test_what_is_stored_never_takes_the_place_of_what_comes_meanwhile():
    newer, stored = moving(2.0, start=100.0, x=None), moving(2.0)

    def recall(name: str) -> list[Recording]:
        live.push(name, newer)
        return [stored]

    live = LiveSamples(recall)
    with live.viewing("press"):
        assert live.curves("press")["t"] == newer.t[-1]


@settings(deadline=None, max_examples=8)
@given(st.lists(st.integers(1, len(SENT) - 1), max_size=8))
def test_the_picture_does_not_depend_on_how_samples_are_cut(cuts: list[int]):
    edges = [0, *sorted({*cuts}), len(SENT)]
    blocks = [SENT.samples(slice(low, high)) for low, high in pairwise(edges)]
    assert pictured(*blocks, *blocks[-1:]) == pictured(SENT)  # the last one comes twice


def test_the_picture_is_that_of_the_samples():
    picture = pictured(SENT)
    for name in ("p_A", "p_B"):  # no peak is lost in bins of 15 samples
        drawn = np.array(picture["pressures"][name])
        assert drawn.max() == pytest.approx(SENT[name].max() / 1e5, abs=1e-3)
        assert drawn.min() == pytest.approx(SENT[name].min() / 1e5, abs=1e-3)
    motion = {name: np.array(values) for name, values in picture["motion"].items()}
    at = picture["t"] + motion["t"]
    np.testing.assert_allclose(motion["x"], 20.0 * np.sin(4.0 * at), atol=0.1)  # mm
    np.testing.assert_allclose(motion["v"][1:-1], 80.0 * np.cos(4.0 * at[1:-1]), atol=1.0)  # mm/s
    np.testing.assert_allclose(motion["rpm"], 3.0 * 30.0 / np.pi, atol=0.1)
    windows = windowed_rms(transform(SENT["p_B"]), 1000, 100)
    shown = pictured(SENT, pressure="p_B")["details"]
    np.testing.assert_allclose(shown["t"], SENT.t[windows.ends - 1] - SENT.t[-1], atol=1e-4)
    for level in range(4):
        np.testing.assert_allclose(np.array(shown[f"d{level + 1}"]) * 1e3, windows.rms[level], atol=0.06)
    details = pictured(SENT, detail_form="details")["details"]
    assert max(details["d4"]) == pytest.approx(
        transform(SENT["p_A"])[4][transform(SENT["p_A"]).inside()].max() / 1e3, abs=1e-2
    )


def test_what_is_missing_is_said_and_a_hole_begins_anew():
    hole = SENT["p_A"].copy()
    hole[1000], hole[5000] = np.nan, np.nan
    picture = pictured(moving(12.0, p_A=hole, x=None, theta=None))
    assert "x" not in picture["motion"] and "v" not in picture["motion"] and "rpm" not in picture["motion"]
    assert None in picture["pressures"]["p_A"] and None not in picture["pressures"]["p_B"]
    assert (picture["details"]["t"], picture["details"]["has"]) == ([], 999)
    assert pictured(SENT, moving(5.0, 60.0)) == pictured(moving(5.0, 60.0))
    huge = pictured(moving(12.0, p_A=np.full(6000, 1e308), x=np.full(6000, -1e308)))
    assert huge["motion"]["x"][0] is None and huge["motion"]["p_A"][0] is None  # their means overflow
    assert pictured()["t"] is None


def test_flows_are_those_of_the_rig():
    machine = describe_rig("thesis")
    assert (machine["rods"], machine["stroke"], machine["valve"]) == ("AB", pytest.approx(600.0), False)
    assert machine["area"] * 100.0 == pytest.approx(633e-6 * 0.1 * 6e4)  # L/min at 100 mm/s
    assert describe_rig("servo-valve")["valve"]


@pytest.fixture
def page(tmp_path) -> Iterator[tuple[PageServer, LiveSamples]]:
    store = MonitorStore(str(tmp_path / "monitor.db"))
    actuators = WatchedActuators([ActuatorSettings(name="press <1>")], store)
    live = LiveSamples(store.last_samples)
    server = PageServer(actuators, PageSettings(port=0), live=live)
    yield server, live
    server.close()
    store.engine.dispose()


def test_samples_go_to_who_looks_and_to_nobody_else(page: tuple[PageServer, LiveSamples]):
    server, live = page
    browser = http.client.HTTPConnection("127.0.0.1", server.port, timeout=30)
    for query, status in (("actuator=no", 404), ("pressure=x", 400), ("actuator=press%20%3C1%3E&drawn=x", 400)):
        browser.request("GET", f"/api/changes?{query}")
        answer = browser.getresponse()
        assert (answer.status, "error" in json.loads(answer.read())) == (status, True)
    browser.request("GET", "/api/changes?actuator=press%20%3C1%3E&pressure=p_B")
    lines = browser.getresponse()
    until(lambda: is_viewed(live, "press <1>"))
    live.push("press <1>", SENT)
    pictures = []
    while not pictures or pictures[-1]["t"] != SENT.t[-1]:
        line = lines.readline()
        if line == b"event: live\n":
            pictures.append(json.loads(lines.readline().removeprefix(b"data: ")))
    assert pictures[-1]["details"]["of"] == "p_B"
    browser.close()
    lines.close()
    until(lambda: not is_viewed(live, "press <1>"))
