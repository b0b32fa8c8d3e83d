"""The service: sources hand over blocks, each is stored before it is acknowledged, alarms go out."""

from __future__ import annotations

import logging
import sys
import threading
import time
from collections.abc import Callable, Iterable
from contextlib import ExitStack, suppress
from functools import partial
from pathlib import Path
from typing import BinaryIO, TextIO

from threadpoolctl import threadpool_limits

from sealscope.errors import InputError
from sealscope.monitor.actuators import WatchedActuators
from sealscope.monitor.memory.sharing import Share
from sealscope.monitor.memory.store import MonitorStore, away
from sealscope.monitor.outages import DATABASE, WEBHOOK
from sealscope.monitor.outputs.lines import EventLines
from sealscope.monitor.outputs.webhook import Webhook
from sealscope.monitor.page.live import LiveSamples
from sealscope.monitor.page.site import PageServer
from sealscope.monitor.settings import MonitorSettings, secret_of
from sealscope.monitor.sources.folder import WatchedFolder
from sealscope.monitor.sources.lines import blocks_of_lines
from sealscope.monitor.sources.source_block import BlockReceiver, RefusedMessage, SourceBlock, bytes_of
from sealscope.monitor.waiting import Waiting
from sealscope.storage.folders import locked

_log = logging.getLogger(__name__)
#: Blocks that wait to be stored and their bytes, at most; sources wait beyond.
_WAITING, _WAITING_BYTES = 512, 256_000_000
#: How often folders are looked at [s], the longest pause after an error of the database, and how long a post that is
#: under way at the end is waited for.
_LOOK_S, _LONGEST_PAUSE_S, _POST_S = 0.5, 5.0, 30.0
#: Blocks that are stored in one transaction, at most, and how long the first one waits for others [s].
_TOGETHER, _GATHER_S = 256, 0.02
#: What a block is counted under that raised an error.
_DROPPED = "blocks that raised an error"
#: A source that waits for longer [s] is a line in the log.
_LONG_WAIT_S = 5.0
#: Lines in the log about the same trouble before only each power of two gets one.
_FIRST_LINES = 3

#: A source: hands blocks, or errors of messages, over until it has none or the receiver stops.
Source = Callable[[BlockReceiver], None]


class Service:
    """A running monitor.

    Parameters
    ----------
    settings : MonitorSettings
    once : bool
        End when standard input has ended and the folders hold nothing new.
    stdin, stdout : optional
        Where lines come from and go to.
    sources : iterable of Source
        More sources, such as a simulated rig.
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
        self.stopping = threading.Event()
        self._queue: Waiting[SourceBlock | None] = Waiting(_WAITING, _WAITING_BYTES)
        self._stdin, self._stdout = stdin or sys.stdin.buffer, stdout or sys.stdout
        self._sources = [*sources]
        self._refused = self._waits = 0
        self._hold = ExitStack()
        if "://" not in settings.database:
            if not Path(settings.database).parent.is_dir():
                raise InputError(f"the monitor's database must be in a folder that exists, got {settings.database}")
            busy = f"the database must belong to one monitor, got another at work ({settings.database})"
            self._hold.enter_context(locked(Path(settings.database + ".lock"), busy))
        try:
            self.store = MonitorStore(settings.database)
            self._share = None
            if (part := settings.share) is not None:
                names = [actuator.name for actuator in settings.actuator]
                self._share = Share(self.store, part.name, names, part.lease_s)
            self.actuators = WatchedActuators(settings.actuator, self.store, settings.keep_days, self._share)
            self.outages = self.actuators.outages
            self.outages.expect(DATABASE)
            if self._share is not None:
                self.actuators.renew()
        except BaseException:
            self._hold.close()
            raise
        self._live = LiveSamples(self.store.last_samples)
        self._lines = EventLines(self.store, self._stdout)
        self.page: PageServer | None = None
        if settings.page is not None and not once:
            try:
                self.page = PageServer(self.actuators, settings.page, self.waits, self._live)
            except BaseException:
                self._hold.close()
                raise

    def hand(self, block: SourceBlock | RefusedMessage) -> None:
        """Give the service a block, or the error of a message that holds none; waits while too many wait."""
        if isinstance(block, RefusedMessage):
            self.actuators.count(block.reason)
            self._refused += 1
            if _worth_a_line(self._refused):
                _log.warning("%s (message %d without a block)", block, self._refused)
            return
        self._live.take(block.actuator, block.samples)
        size = bytes_of(block.samples)
        if self._queue.put(block, size):
            return
        self._waits += 1
        began, said = time.monotonic(), False
        while not self.stopping.is_set() and not self._queue.put(block, size, 0.5):
            if not said and time.monotonic() - began > _LONG_WAIT_S:
                said = True
                blocks, waiting, _ = self.waits()
                _log.warning("a source waits: %d blocks are to be stored, %.1f MB", blocks, waiting / 1e6)

    def count(self, reason: str) -> None:
        """Count something that was dropped."""
        self.actuators.count(reason)

    def waits(self) -> tuple[int, int, int]:
        """Return how many blocks are not stored yet, their bytes, and how often a source had to wait for them."""
        return *self._queue.unsettled(), self._waits

    def run(self) -> None:
        """Take blocks until the sources have ended and there is no page, or `stop` is called.

        Meanwhile linear algebra has one thread: the matrices are small, and threads that wait for each other take many
        times as long on a machine with other work.
        """
        self._hold.enter_context(threadpool_limits(limits=1))
        sources = [*self._sources]
        if self.settings.lines:
            sources.append(_lines_of(self._stdin))
        if any(actuator.folder is not None for actuator in self.settings.actuator):
            sources.append(partial(_folders_of, once=self.once))
        if self.settings.mqtt is not None:
            from sealscope.monitor.sources.broker import broker_of

            sources.append(broker_of(self.settings.mqtt))
        if self.settings.opcua is not None:
            from sealscope.monitor.sources.opcua import opcua_of

            sources.append(opcua_of(self.settings.opcua))
        threads = [threading.Thread(target=self._guarded, args=(source,), daemon=True) for source in sources]
        if self._share is not None:
            threading.Thread(target=self._keep_share, args=(self._share,), daemon=True).start()
        ending = []
        if (node := self.settings.sparkplug) is not None and (broker := self.settings.mqtt) is not None:
            from sealscope.monitor.outputs.sparkplug_node import SparkplugNode

            password = secret_of(broker.password_file, "mqtt.password_file")
            alarms = SparkplugNode(self.store, self.actuators.plain, self.count, broker, node, password)
            ending.append(threading.Thread(target=alarms.run, args=(self.stopping,), daemon=True))
        if (hook := self.settings.webhook) is not None:
            token = secret_of(hook.token_file, "webhook.token_file")
            self.outages.expect(WEBHOOK)
            webhook = Webhook(self.store, hook.url, token, hook.timeout_s, self.outages)
            ending.append(threading.Thread(target=webhook.run, args=(self.stopping,), daemon=True))
        try:
            for thread in [*threads, *ending]:
                thread.start()
            left = len(threads)
            while left and not self.stopping.is_set():
                waiting = self._queue.take(_TOGETHER, 0.2)
                if 0 < len(waiting) < _TOGETHER and None not in waiting:
                    self.stopping.wait(_GATHER_S)
                    waiting += self._queue.take(_TOGETHER - len(waiting), 0.0)
                left -= waiting.count(None)
                self._store([block for block in waiting if block is not None])
                self._queue.settle()
                if not len(self._queue):
                    self._pass_on()
            self._pass_on()
            while self.page is not None and not self.stopping.wait(0.5):
                self._pass_on()
        finally:
            self.stop()
            for thread in ending:
                if thread.is_alive():
                    thread.join(_POST_S)
            from sqlalchemy.exc import SQLAlchemyError

            if self._share is not None:
                with suppress(SQLAlchemyError):
                    self._share.give_back()
            if self.page is not None:
                self.page.close()
            self._hold.close()

    def stop(self) -> None:
        """End `run` after the block at hand."""
        self.stopping.set()

    def _keep_share(self, share: Share) -> None:
        """Renew the share in the actuators four times a lease; where the database does not answer, the lease lapses."""
        while not self.stopping.wait(share.lease_s / 4.0):
            try:
                self.actuators.renew()
            except Exception as error:
                self._away(error)

    def _guarded(self, source: Source) -> None:
        try:
            source(self)
        except Exception:  # a source that fails must not take the others along
            _log.exception("a source has ended")
        self._queue.put(None, 0, always=True)

    def _away(self, error: Exception) -> None:
        """Note that the database is away; raises the error where it is of another kind."""
        reason = away(error)
        if reason is None:
            raise error
        self.outages.lost(DATABASE, reason)

    def _store(self, blocks: list[SourceBlock]) -> None:
        """Take blocks in one transaction, again and again while the database is locked, full or away; acknowledge them.

        Where something else fails they are taken one by one, and the one that fails is dropped, for it would fail
        again: the others must not wait for it.
        """
        pause = 0.1
        while blocks and not self.stopping.is_set():
            try:
                self.actuators.take(blocks)
            except Exception as error:
                reason = away(error)
                if reason is not None:
                    self.count("waits for the database")
                    self.outages.lost(DATABASE, reason)
                    self.stopping.wait(pause)
                    pause = min(2.0 * pause, _LONGEST_PAUSE_S)
                    continue
                if len(blocks) > 1:
                    for block in blocks:
                        self._store([block])
                    return
                self.count(_DROPPED)
                if _worth_a_line(self.actuators.counters[_DROPPED]):
                    _log.exception("a block of %s is dropped", blocks[0].actuator[:60])
            else:
                self.outages.back(DATABASE)
            for block in blocks:
                block.done()
            return

    def _pass_on(self) -> None:
        try:
            self._lines.pass_on()
        except Exception as error:
            self._away(error)
        else:
            self.outages.back(DATABASE)


def _worth_a_line(number: int) -> bool:
    """Return whether the log gets a line about the same trouble for this time: the first ones, then powers of two."""
    return number <= _FIRST_LINES or number & (number - 1) == 0


def _lines_of(stream: BinaryIO) -> Source:
    def hand_lines(service: BlockReceiver) -> None:
        for block in blocks_of_lines(stream):
            service.hand(block)
            if service.stopping.is_set():
                return

    return hand_lines


def _folders_of(service: BlockReceiver, *, once: bool) -> None:
    settle = 0.0 if once else service.settings.settle_s
    folders = [
        WatchedFolder(
            actuator.name, actuator.folder, actuator.pattern, settle, service.store.is_known, actuator.map or None
        )
        for actuator in service.settings.actuator
        if actuator.folder is not None
    ]
    while not service.stopping.is_set():
        try:
            for folder in folders:
                for block in folder.blocks():
                    service.hand(block)
                    if service.stopping.is_set():
                        return
        except Exception as error:  # what is stored already is asked of the database
            if (reason := away(error)) is None:
                raise
            service.outages.lost(DATABASE, reason)
        else:
            if once:
                return
        time.sleep(_LOOK_S)
