"""Actuators that several monitors over one database share: each hears all, and stores those whose lease it holds.

The last blocks of the others are kept in memory. When a monitor is gone, the one that gets its actuators takes these
blocks; the database knows which of them were stored.
"""

from __future__ import annotations

import logging
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import replace

from sqlalchemy import Connection

from sealscope.monitor.actuators import DROPPED, WatchedActuators
from sealscope.monitor.database.sharing import Share
from sealscope.monitor.database.store import MonitorStore, away
from sealscope.monitor.settings import ActuatorSettings
from sealscope.monitor.sources.source_block import SourceBlock, nothing

_log = logging.getLogger(__name__)
#: How long blocks of others' actuators are kept, in leases: until a takeover, with time to spare.
_KEPT_LEASES = 4.0


class SharedActuators(WatchedActuators):
    """The actuators of a monitor that watches its `share` of them, none before it is renewed."""

    def __init__(self, settings: list[ActuatorSettings], store: MonitorStore, keep_days: float, share: Share) -> None:
        self.share = share
        super().__init__(settings, store, keep_days)
        self._elsewhere = {name: deque[tuple[float, SourceBlock]]() for name in self.settings}  # when each came [s]

    @property
    def held(self) -> frozenset[str]:
        """The actuators that this monitor watches: its share of them."""
        return self.share.held & frozenset(self.settings)

    def renew(self) -> None:
        """Renew the share; of an actuator that is taken over the blocks since then are taken at once.

        Raises what the database raises.
        """
        with self._lock:
            gained, lost = self.share.renew()
            for name in gained | lost:
                self._actuators.pop(name, None)  # the database knows better
            for name in sorted(self.held):
                self._take_over(name)

    def _take_over(self, name: str) -> None:
        """Take the blocks that came while another monitor watched an actuator; those it stored are passed over."""
        waiting, self._elsewhere[name] = self._elsewhere[name], deque()
        while waiting:
            try:
                self._take_held([waiting[0][1]])
            except Exception as error:
                if away(error) is not None:
                    self._elsewhere[name].extendleft(reversed(waiting))
                    raise
                self.count(DROPPED)  # it would fail again
                _log.exception("a block of %s is dropped", name)
            waiting.popleft()

    def _take(self, blocks: Sequence[SourceBlock]) -> None:
        held = self.held
        for name in {block.actuator for block in blocks} & held:
            self._take_over(name)
        self._take_held([block for block in blocks if block.actuator in held])
        for block in blocks:
            if block.actuator not in held:
                self._keep_elsewhere(block)

    def _take_held(self, blocks: Sequence[SourceBlock]) -> None:
        """Take blocks of actuators that are held, as far as is known; those whose lease has lapsed are kept."""
        self._lost = set[str]()
        super()._take(blocks)
        for block in blocks:
            if block.actuator in self._lost:
                self._actuators.pop(block.actuator, None)
                self._keep_elsewhere(block)

    def _own(self, blocks: Sequence[SourceBlock], connection: Connection) -> Sequence[SourceBlock]:
        names = sorted({block.actuator for block in blocks})
        self._lost = {name for name in names if not self.share.holds(connection, name)}
        return [block for block in blocks if block.actuator not in self._lost]

    def _keep_elsewhere(self, block: SourceBlock) -> None:
        """Keep a block of another monitor's actuator for as long as its takeover may last."""
        self.count("blocks of another monitor's actuator")
        waiting, now = self._elsewhere[block.actuator], time.monotonic()
        waiting.append((now, replace(block, done=nothing)))
        while waiting[0][0] < now - _KEPT_LEASES * self.share.lease_s:
            waiting.popleft()
