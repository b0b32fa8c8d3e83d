"""The service: sources hand over blocks, each is stored before it is acknowledged, alarms go out."""

from __future__ import annotations

import logging
import queue
import sys
import threading
import time
from collections.abc import Callable, Iterable
from contextlib import ExitStack, suppress
from functools import partial
from pathlib import Path
from typing import BinaryIO, TextIO

from sealscope.errors import InputError
from sealscope.monitor.actuators import WatchedActuators
from sealscope.monitor.memory.sharing import Share
from sealscope.monitor.memory.store import MonitorStore
from sealscope.monitor.outputs.lines import EventLines
from sealscope.monitor.outputs.webhook import Webhook
from sealscope.monitor.page.site import PageServer
from sealscope.monitor.settings import MonitorSettings, secret_of
from sealscope.monitor.sources.folder import WatchedFolder
from sealscope.monitor.sources.lines import blocks_of_lines
from sealscope.monitor.sources.source_block import BlockReceiver, SourceBlock
from sealscope.storage.folders import locked

_log = logging.getLogger(__name__)
#: Blocks that wait to be stored, at most; sources wait beyond.
_WAITING = 128
#: How often folders are looked at [s], and the longest pause after an error of the database.
_LOOK_S, _LONGEST_PAUSE_S = 0.5, 30.0
#: Lines about the same trouble: the first ones, then each power of two.
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
        self._queue: queue.Queue[SourceBlock | None] = queue.Queue(_WAITING)
        self._stdin, self._stdout = stdin or sys.stdin.buffer, stdout or sys.stdout
        self._sources = [*sources]
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
            if self._share is not None:
                self.actuators.renew()
        except BaseException:
            self._hold.close()
            raise
        self._lines = EventLines(self.store, self._stdout)
        self.page: PageServer | None = None
        if settings.page is not None and not once:
            try:
                self.page = PageServer(self.actuators, settings.page)
            except BaseException:
                self._hold.close()
                raise

    def hand(self, block: SourceBlock | InputError) -> None:
        """Give the service a block, or the error of a message that holds none; waits while too many wait."""
        if isinstance(block, InputError):
            self.actuators.count("messages that hold no block")
            self._complain(str(block), self.actuators.counters["messages that hold no block"])
            return
        while not self.stopping.is_set():
            try:
                self._queue.put(block, timeout=0.5)
                return
            except queue.Full:
                continue

    def run(self) -> None:
        """Take blocks until the sources have ended and there is no page, or `stop` is called."""
        from sqlalchemy.exc import DBAPIError

        sources = [*self._sources]
        if self.settings.lines:
            sources.append(_lines_of(self._stdin))
        if any(actuator.folder is not None for actuator in self.settings.actuator):
            sources.append(partial(_folders_of, once=self.once))
        if self.settings.mqtt is not None:
            from sealscope.monitor.sources.broker import broker_of

            sources.append(broker_of(self.settings.mqtt))
        threads = [threading.Thread(target=self._guarded, args=(source,), daemon=True) for source in sources]
        if self._share is not None:
            threading.Thread(target=self._keep_share, args=(self._share,), daemon=True).start()
        posting = None
        if (hook := self.settings.webhook) is not None:
            webhook = Webhook(self.store, hook.url, secret_of(hook.token_file, "webhook.token_file"), hook.timeout_s)
            posting = threading.Thread(target=webhook.run, args=(self.stopping,), daemon=True)
        try:
            for thread in threads if posting is None else [*threads, posting]:
                thread.start()
            left = len(threads)
            while left and not self.stopping.is_set():
                try:
                    block = self._queue.get(timeout=0.2)
                except queue.Empty:
                    self._pass_on()
                    continue
                if block is None:
                    left -= 1
                else:
                    self._stored(block)
                    if self._queue.empty():
                        self._pass_on()
            self._pass_on()
            while self.page is not None and not self.stopping.wait(0.5):
                self._pass_on()
        finally:
            self.stop()
            if posting is not None and posting.is_alive():
                posting.join(_LONGEST_PAUSE_S)
            if self._share is not None:
                with suppress(DBAPIError):
                    self._share.give_back()
            if self.page is not None:
                self.page.close()
            self._hold.close()

    def stop(self) -> None:
        """End `run` after the block at hand."""
        self.stopping.set()

    def _keep_share(self, share: Share) -> None:
        """Renew the share in the actuators four times a lease; where the database does not answer, the lease lapses."""
        from sqlalchemy.exc import DBAPIError

        while not self.stopping.wait(share.lease_s / 4.0):
            try:
                self.actuators.renew()
            except DBAPIError as error:
                _log.error("the share in the actuators is not renewed: %s", str(error.orig).splitlines()[0])

    def _guarded(self, source: Source) -> None:
        try:
            source(self)
        except Exception:  # a source that fails must not take the others along
            _log.exception("a source has ended")
        while not self.stopping.is_set():
            try:
                self._queue.put(None, timeout=0.5)
                return
            except queue.Full:
                continue

    def _stored(self, block: SourceBlock) -> None:
        """Take a block, again and again while the database is locked, full or away; then acknowledge it."""
        from sqlalchemy.exc import DBAPIError

        pause = 0.1
        while not self.stopping.is_set():
            try:
                self.actuators.take(block)
                block.done()
                return
            except DBAPIError as error:
                reason = str(error.orig).splitlines()[0]
                self.actuators.count("waits for the database")
                _log.error("the database does not take a block, tried again in %.1f s: %s", pause, reason)
                self.stopping.wait(pause)
                pause = min(2.0 * pause, _LONGEST_PAUSE_S)

    def _pass_on(self) -> None:
        from sqlalchemy.exc import DBAPIError

        try:
            self._lines.pass_on()
        except DBAPIError as error:
            _log.error("the database does not answer: %s", str(error.orig).splitlines()[0])

    @staticmethod
    def _complain(text: str, number: int) -> None:
        if number <= _FIRST_LINES or number & (number - 1) == 0:
            _log.warning("%s (message %d without a block)", text, number)


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
        for folder in folders:
            for block in folder.blocks():
                service.hand(block)
                if service.stopping.is_set():
                    return
        if once:
            return
        time.sleep(_LOOK_S)
