"""The table of events is complete, and speaks of observables that some provider makes."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterator
from dataclasses import replace
from fnmatch import fnmatchcase
from functools import cache
from importlib.resources import files
from itertools import product
from pathlib import Path

import numpy as np
import pytest

import sealscope as ss
from sealscope.diagnosis.detectors.registry import make_observable
from sealscope.diagnosis.inference.changes.charge_pressure import FALL, LOW
from sealscope.diagnosis.inference.changes.features import SENSOR_FEATURES, observe_signals, sensor_features
from sealscope.diagnosis.inference.changes.healthy_levels import DRIFTS, FRICTION, ZEROS
from sealscope.diagnosis.inference.changes.level_changes import PATTERNS
from sealscope.diagnosis.inference.changes.volumes import OUTSIDE, SCALE
from sealscope.diagnosis.inference.equations.balances import circulation, equations, locked
from sealscope.diagnosis.inference.equations.terms import AIR, BIAS, TURNING, delay_name
from sealscope.diagnosis.inference.pressures.reduced_rig import PARAMETERS
from sealscope.diagnosis.inference.sensor_errors import DELAYED
from sealscope.diagnosis.inference.volumes.volume_detector import TURNING_DATA
from sealscope.diagnosis.priors.changes import CHANGES
from sealscope.diagnosis.rms_change.rms_detector import JUDGED
from sealscope.parameters import load_rig
from sealscope.parameters.rig import rig_names
from sealscope.signals.details import QUANTITIES

SOURCE = Path(ss.__file__).parent
OBSERVABLES = Path(__file__).resolve().parents[3] / "docs" / "reference" / "observables.md"
ROWS = tomllib.loads((files("sealscope.diagnosis.decision") / "events.toml").read_text("utf-8"))
CAUSES = tomllib.loads((files("sealscope.diagnosis.verdict") / "states.toml").read_text("utf-8"))["causes"]
KEYS = {"cause", "probability", "moves", "words"}
#: Events that look as any term does.
CATCH_ALL = ("regime", "unsteady motion")
CHANNELS = frozenset({"u", "theta", "omega", "q_pump", "x", "p_1", "p_2", "p_A", "p_B"})
#: Channels of which a recording may have one only, to find what each balance follows.
SOURCES = ({"theta"}, {"omega"}, {"q_pump"}, {"u"}, set())


def volume_names() -> Iterator[str]:
    """Yield what the balances of all packaged rigs follow."""
    yield from (SCALE, OUTSIDE, "zero of the flow")
    for name, source, rest in product(rig_names(), SOURCES, ({"x", "p_1", "p_2"}, {"x"}, set())):
        channels = frozenset({"p_A", "p_B", "u"} | source | rest)
        rig = load_rig(name)
        balances = [*equations(rig, channels), circulation(rig, channels), locked(rig, channels)]
        for term in (term for balance in balances if balance for term in balance.terms):
            if term.name != BIAS and not term.is_compared and not term.name.startswith("motion"):
                yield term.name


@cache
def known_names() -> frozenset[str]:
    """Collect what providers report, as "data: name"."""
    names = {f"volumes: {name}" for name in volume_names()} | {f"response: {name}" for name in PARAMETERS}
    names |= {f"levels: {name}" for name, _ in PATTERNS} | {"levels: what feeds both chambers"}
    names |= {f"{FRICTION}: {FRICTION}"} | {f"drift: {name}" for name in (*DRIFTS, ZEROS, FALL)}
    names |= {f"drift: {LOW.format(side)}" for side in "AB"}
    names |= {f"delays: {delay_name(channel)}" for channel in (*DELAYED, "theta", "omega", "q_pump", "q_supply", "u")}
    names |= {"motion: motion", "sides: filter of p_A", "sides: filter of p_B", f"{TURNING_DATA}: {TURNING}"}
    names.add(f"volumes: {TURNING}")  # behind valves that shut at rest
    names |= {f"rise: {name}" for name in volume_names() if name == AIR or name.startswith("external leak")}
    names |= {f"levels: scale of {chamber}" for chamber in ("p_A", "p_B")}
    names |= {f"hum: hum of {hertz:g} Hz" for hertz in CHANGES.features.mains}
    for way, quantity, chamber in product(("rise", "fall"), QUANTITIES, ("p_A", "p_B")):
        data = "details" if quantity in JUDGED else "noise of details"
        names.add(f"{data}: {way} of {quantity} of {chamber}")
    change = make_observable("stroke time", 0.5)
    names.add(f"{change.data}: {change.name}")
    recording = ss.simulate(command="3 sin(4t)", duration="40 s", seed=1)
    late = recording.t > 20.0
    larger = {name: np.where(late, 1.3, 1.0) * recording[name] for name in ("u", "x")}
    swapped = {
        name: np.where(late, recording[other], recording[name]) for name, other in (("p_A", "p_B"), ("p_B", "p_A"))
    }
    slower = {"x": np.where(late, 0.7, 1.0) * recording["x"]}
    pressures = recording.only(("p_A", "p_B"))
    for part, changed in ((recording, larger), (recording, swapped), (pressures, slower)):
        units = {name: recording.units[name] for name in (*part.channels, *changed)}
        report = observe_signals(replace(part, channels={**part.channels, **changed}, units=units))
        names |= {f"{observable.data}: {observable.name}" for observable in report.observables}
    return frozenset(names)


@pytest.mark.parametrize("name", ROWS)
def test_every_row_is_complete(name: str) -> None:
    row = ROWS[name]
    assert KEYS <= set(row) <= KEYS | {"disturbs", "scales"}
    assert row["cause"] in (*CAUSES, "")
    assert (row["moves"] or row["scales"]) and row["words"]
    assert set(row["probability"]) == {"value", "unit", "source"}
    assert 0.0 < row["probability"]["value"] < 1.0
    assert row["probability"]["unit"] == "1" and row["probability"]["source"]


@pytest.mark.parametrize("name", ROWS)
def test_every_pattern_matches_what_some_provider_makes(name: str) -> None:
    patterns = ROWS[name]["moves"] + ROWS[name].get("disturbs", []) + ROWS[name].get("scales", [])
    dead = [pattern for pattern in patterns if not any(fnmatchcase(known, pattern) for known in known_names())]
    assert dead == []


def test_whatever_a_provider_makes_shows_some_event() -> None:
    """That every coefficient may change in a pause or in unsteady motion does not count."""
    patterns = [pattern for name, row in ROWS.items() if name not in CATCH_ALL for pattern in row["moves"]]
    unexplained = [key for key in known_names() if not any(fnmatchcase(key, pattern) for pattern in patterns)]
    assert sorted(unexplained) == []


def test_every_sensor_feature_is_watched_live_too() -> None:
    random = np.random.default_rng(1)
    blocks = {name: random.standard_normal((2, 1000)) for name in ("p_A", "p_B", "omega")}
    assert {name for name, _ in sensor_features(blocks, 1000.0)} == set(SENSOR_FEATURES)


def test_the_reference_lists_every_observable_and_no_other() -> None:
    rows = [line.split("|") for line in OBSERVABLES.read_text(encoding="utf-8").splitlines() if line[:3] == "| `"]
    patterns = [pattern for row in rows for pattern in re.findall(r"`([^`]+)`", row[1])]
    assert [key for key in sorted(known_names()) if not any(fnmatchcase(key, pattern) for pattern in patterns)] == []
    assert [pattern for pattern in patterns if not any(fnmatchcase(key, pattern) for key in known_names())] == []
    modules = {module for row in rows for module in re.findall(r"`([\w/]+\.py)`", row[4]) if "/" in module}
    assert [module for module in modules if not (SOURCE / "diagnosis" / module).is_file()] == []


def test_what_may_happen_in_a_recording_is_less_than_certain() -> None:
    assert sum(row["probability"]["value"] for row in ROWS.values()) < 1.0
