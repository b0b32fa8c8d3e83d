"""The service: sources hand over blocks, each is stored before it is acknowledged, alarms go out."""

from __future__ import annotations

import logging
import sys
import threading
import time
from collections.abc import Callable, Iterable
from contextlib import ExitStack
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import BinaryIO, TextIO, TypeVar

from threadpoolctl import threadpool_limits

from sealscope.errors import InputError
from sealscope.monitor.actuators import DROPPED, WatchedActuators
from sealscope.monitor.database.store import MonitorStore, outage_reason
from sealscope.monitor.outputs.events import EventLines, Webhook
from sealscope.monitor.outputs.sparkplug_node import SparkplugNode
from sealscope.monitor.page.live import LiveSamples
from sealscope.monitor.page.site import PageServer
from sealscope.monitor.settings import MonitorSettings, secret_of
from sealscope.monitor.sources.broker import broker_of
from sealscope.monitor.sources.folder import folders_of
from sealscope.monitor.sources.lines import lines_of
from sealscope.monitor.sources.opcua import opcua_of
from sealscope.monitor.sources.source_block import UNREADABLE_FILE, BlockReceiver, RefusedMessage, SourceBlock
from sealscope.monitor.supervisor import DATABASE, WEBHOOK
from sealscope.monitor.waiting import Waiting
from sealscope.storage.folders import locked

_log = logging.getLogger(__name__)
#: Blocks that wait to be stored and their bytes, at most; a source that waits longer [s] is a line in the log.
_WAITING, _WAITING_BYTES, _LONG_WAIT_S = 512, 256_000_000, 5.0
#: How often outputs look for events [s], and how long what is under way at the end is waited for, all together.
_LOOK_S, _END_S = 0.05, 2.5
#: Blocks that are stored in one transaction, at most, and how long the first one waits for others [s].
_TOGETHER, _GATHER_S = 256, 0.02
#: Lines in the log about the same trouble before only each power of two gets one.
_FIRST_LINES = 3

#: The name of the source of lines.
_LINES = "standard input"
#: A source: hands blocks, or errors of messages, over until it has none or the receiver stops.
Source = Callable[[BlockReceiver], None]
_Kept = TypeVar("_Kept", SourceBlock, RefusedMessage)


class Service:
    """A running monitor.

    `once`: it ends when standard input has ended and the folders hold nothing new; `stdin`, `stdout`: where lines come
    from and go to; `sources`: more sources, such as a simulated rig.
    """

    def __init__(
        self,
        settings: MonitorSettings,
        *,
        once: bool = False,
        stdin: BinaryIO | None = None,
        stdout: TextIO | None = None,
        sources: Iterable[Source] = (),
    ) -> None:
        self.settings, self.once = settings, once
        self._queue: Waiting[SourceBlock | RefusedMessage | None] = Waiting(_WAITING, _WAITING_BYTES)
        self._at_hand: list[SourceBlock | RefusedMessage | None] = []
        self._stdin = stdin or (sys.stdin.buffer if sys.stdin is not None else BytesIO())
        self._more_sources = [*sources]
        self._refused = self._waits = self._left = 0
        self._blocked = False  # the database does not take what is at hand
        self._hold = ExitStack()
        if "://" not in settings.database:
            if not Path(settings.database).parent.is_dir():
                raise InputError(f"the monitor's database must be in a folder that exists, got {settings.database}")
            busy = f"the database must belong to one monitor, got another at work ({settings.database})"
            self._hold.enter_context(locked(Path(settings.database + ".lock"), busy))
        try:
            self.store = MonitorStore(settings.database)
            watched = settings.actuator, self.store, settings.keep_days
            with threadpool_limits(limits=1):  # as in `run`: sums in another order end in other digits
                self.actuators = WatchedActuators(*watched)
            actuators = self.actuators
            self.supervisor, self.count, self.plain = actuators.supervisor, actuators.count, actuators.plain
            self.stopping, self._database = self.supervisor.stopping, self.supervisor.part(DATABASE)
            self._live = LiveSamples(self.store.last_samples)
            self._lines = EventLines(self.store, stdout or sys.stdout)
            self.page: PageServer | None = None
            if settings.page is not None and not once:
                self.page = PageServer(self.actuators, settings.page, self.waits, self._live)
        except BaseException:
            self._hold.close()
            raise

    def hand(self, block: SourceBlock | RefusedMessage) -> None:
        """Give the service a block, or the error of a message that holds none; waits while too many wait."""
        if isinstance(block, RefusedMessage):
            self.count(block.reason)
            self._refused += 1
            if block.reason == UNREADABLE_FILE:
                _log.warning("%s", block)
            elif _worth_a_line(self._refused):
                _log.warning("%s (message %d without a block)", block, self._refused)
        else:
            self.supervisor.part("picture of samples").attempt(partial(self._live.take, block.actuator, block.samples))
        if self._queue.put(block, block.bytes):
            return
        self._waits += 1
        began, logged = time.monotonic(), False
        while not self.stopping.is_set() and not self._queue.put(block, block.bytes, 0.5):
            if not logged and time.monotonic() - began > _LONG_WAIT_S:
                logged = True
                blocks, waiting, _ = self.waits()
                _log.warning("a source waits: %d blocks are to be stored, %.1f MB", blocks, waiting / 1e6)

    def waits(self) -> tuple[int, int, int]:
        """Count the blocks not stored yet, their bytes, and the waits of sources for them."""
        at_hand = [*self._at_hand]
        blocks, size = self._queue.waiting()
        return blocks + len(at_hand), size + sum(block.bytes for block in at_hand if block is not None), self._waits

    def run(self) -> None:
        """Take blocks until the sources have ended and there is no page, or `stop` is called.

        Meanwhile linear algebra has one thread: the matrices are small, and threads that wait for each other take many
        times as long on a machine with other work.
        """
        self._hold.enter_context(threadpool_limits(limits=1))
        sources, ending = self._all_sources(), list[threading.Thread]()
        storing, start = self.supervisor.part("storage"), self.supervisor.start
        ended = partial(self._queue.put, None, 0, always=True)
        self._left = len(sources)
        try:
            ending += self._outputs()
            for name, source in sources:
                ending.append(start(name, partial(source, self), again=not self.once, ended=ended))
            while (self._left or self.page is not None) and not self.stopping.is_set():
                if not storing.attempt(self._store_next):
                    self.stopping.wait(storing.pause_s)
        finally:
            self.stop()
            if self.page is not None:
                self.page.leave()
            deadline = time.monotonic() + _END_S
            for thread in ending:
                if thread.name != _LINES:  # which may wait for a line for ever
                    thread.join(max(0.0, deadline - time.monotonic()))
            if self.page is not None:
                self.page.close()
            self.close()

    def _all_sources(self) -> list[tuple[str, Source]]:
        """Return the sources of the settings by name; raises InputError for a secret that cannot be read."""
        sources = [(f"source {number}", source) for number, source in enumerate(self._more_sources, 1)]
        if self.settings.lines:
            sources.append((_LINES, lines_of(self._stdin)))
        if any(actuator.folder is not None for actuator in self.settings.actuator):
            sources.append(("folders", partial(folders_of, once=self.once)))
        if self.settings.mqtt is not None:
            sources.append(("MQTT client", broker_of(self.settings.mqtt)))
        if self.settings.opcua is not None:
            sources.append(("OPC UA source", opcua_of(self.settings.opcua)))
        return sources

    def _outputs(self) -> list[threading.Thread]:
        """Start the threads that send events and states."""
        repeat = self.supervisor.repeat
        threads = [repeat("standard output", self._pass_on, _LOOK_S, last=self._pass_on)]
        if (settings := self.settings.sparkplug) is not None and (broker := self.settings.mqtt) is not None:
            password = secret_of(broker.password_file, "mqtt.password_file")
            node = SparkplugNode(self.store, self.plain, self.count, broker, settings, password)
            threads.append(repeat("Sparkplug node", node.pass_on, _LOOK_S, last=node.end))
        if (hook := self.settings.webhook) is not None:
            token = secret_of(hook.token_file, "webhook.token_file")
            webhook = Webhook(self.store, hook.url, token, hook.timeout_s)
            threads.append(repeat(WEBHOOK, webhook.pass_on, _LOOK_S, last=webhook.pass_on))
        return threads

    def _store_next(self) -> None:
        """Store the next blocks; after an error they are still at hand."""
        if not self._at_hand:
            self._at_hand = self._queue.take(_TOGETHER, 0.2)
            if 0 < len(self._at_hand) < _TOGETHER and None not in self._at_hand:
                self.stopping.wait(_GATHER_S)
                self._at_hand += self._queue.take(_TOGETHER - len(self._at_hand), 0.0)
        self._store([block for block in self._at_hand if isinstance(block, SourceBlock)], self.actuators.take)
        refused = [block for block in self._at_hand if isinstance(block, RefusedMessage)]
        self._store(refused, lambda rows: self.store.keep_refused([row.row() for row in rows]))
        self._left -= self._at_hand.count(None)
        self._at_hand = []

    def stop(self) -> None:
        """End `run` after the block at hand."""
        self.stopping.set()

    def close(self) -> None:
        """Leave the database to another monitor, as `run` does at its end."""
        self._hold.close()

    def _store(self, blocks: list[_Kept], write: Callable[[list[_Kept]], object]) -> None:
        """Keep blocks in one transaction and acknowledge them; raises where the database is locked, full or away.

        Where something else fails they are kept one by one, and the one that fails is dropped, for it would fail
        again: the others must not wait for it.
        """
        if not blocks:
            return
        try:
            write(blocks)
        except Exception as error:
            if outage_reason(error) is not None:
                self.count("waits for the database")
                self._blocked = True
                raise
            if len(blocks) > 1:
                for block in blocks:
                    self._store([block], write)
                return
            self.count(DROPPED)
            if _worth_a_line(self.actuators.counters[DROPPED]):
                _log.exception("a block is dropped: %s", str(getattr(blocks[0], "actuator", blocks[0]))[:60])
        else:
            self._blocked = False
            self._database.end_outage()
        stored = set(map(id, blocks))
        self._at_hand = [block for block in self._at_hand if id(block) not in stored]
        for block in blocks:
            self.supervisor.part("acknowledgements").attempt(block.done, at_once=True)

    def _pass_on(self) -> None:
        self._lines.pass_on()
        if not self._blocked:  # what can be read may still refuse to be written
            self._database.end_outage()


def _worth_a_line(number: int) -> bool:
    """Test whether repeat `number` of a trouble is logged: the first ones, then powers of two."""
    return number <= _FIRST_LINES or number & (number - 1) == 0
