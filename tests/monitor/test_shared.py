"""Several monitors over one database: what one stores, the other takes over, no block missing or doubled."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import text

from sealscope.monitor.database.sharing import Share
from sealscope.monitor.database.store import MonitorStore
from sealscope.monitor.settings import ActuatorSettings, ShareSettings
from sealscope.monitor.shared import SharedActuators
from sealscope.monitor.sources.source_block import decoded

from .plant import LINES

BLOCKS = [decoded(line) for line in LINES.splitlines()[:24]]
NAMES = ("press 1", "press 2")


@pytest.fixture
def monitors(tmp_path: Path) -> list[SharedActuators]:
    """Two monitors, of which the first holds every actuator."""
    made = []
    for name in ("a", "b"):
        store = MonitorStore(f"sqlite:///{tmp_path / 'monitor.db'}")
        share = Share(store, ShareSettings(name=name, lease_s=3600.0), NAMES)
        made.append(SharedActuators([ActuatorSettings(name=each) for each in NAMES], store, 90.0, share))
    made[0].renew()
    assert (made[0].held, made[1].held) == (frozenset(NAMES), frozenset())
    return made


def stored(monitor: SharedActuators) -> list[tuple[Any, ...]]:
    with monitor.store.engine.connect() as connection:
        return sorted(map(tuple, connection.execute(text("select actuator, identity from blocks"))))


ALL = sorted((block.actuator, block.identity) for block in BLOCKS)


def test_what_came_since_the_other_is_gone_is_taken_over_once(monitors: list[SharedActuators]):
    first, second = monitors
    second.take(BLOCKS)
    first.take(BLOCKS[:10])
    assert len(stored(second)) == 10
    first.share.give_back()
    second.renew()
    assert stored(second) == ALL
    assert second.counters["blocks stored already"] == 10
    second.take(BLOCKS[-2:])
    assert stored(second) == ALL


def test_a_lease_that_has_lapsed_stores_nothing_and_loses_nothing(monitors: list[SharedActuators]):
    first = monitors[0]
    with first.store.writing() as connection:
        connection.execute(text("update leases set until = 0"))
    first.take(BLOCKS)
    assert stored(first) == []
    first.renew()
    assert stored(first) == ALL


def test_a_block_that_raises_an_error_holds_no_takeover_up(monitors: list[SharedActuators]):
    first, second = monitors
    poison: Any = "no samples"
    second.take([replace(BLOCKS[0], identity="poison", samples=poison), *BLOCKS])
    first.share.give_back()
    second.renew()
    assert stored(second) == ALL
    assert second.counters["blocks that raised an error"] == 1
