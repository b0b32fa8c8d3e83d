"""The service of a monitor: sources submit blocks of samples, which it stores, and outputs send the alarms."""

from __future__ import annotations

import logging
import os
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import BinaryIO, TextIO, TypeVar

from threadpoolctl import threadpool_limits

from sealscope.errors import InputError
from sealscope.monitor.actuators import DROPPED, WatchedActuators
from sealscope.monitor.bounded_queue import BoundedQueue, QueueLoad
from sealscope.monitor.database.store import MonitorStore, outage_reason
from sealscope.monitor.outputs.events import EventLines, Webhook
from sealscope.monitor.outputs.sparkplug_node import SparkplugNode
from sealscope.monitor.page.live import LiveSamples
from sealscope.monitor.page.site import PageServer
from sealscope.monitor.settings import MonitorSettings, read_secret
from sealscope.monitor.sources.broker import broker_source
from sealscope.monitor.sources.folder import watch_folders
from sealscope.monitor.sources.lines import line_source
from sealscope.monitor.sources.opcua import opcua_source
from sealscope.monitor.sources.source_block import UNREADABLE_FILE, BlockReceiver, RefusedMessage, SourceBlock
from sealscope.monitor.supervisor import DATABASE
from sealscope.storage.folders import lock_file

_log = logging.getLogger(__name__)
#: Blocks in the queue and their bytes, at most; a source that waits longer than this [s] is logged.
_QUEUE_BLOCKS, _QUEUE_BYTES, _LONG_WAIT_S = 512, 256_000_000, 5.0
#: How often outputs look for events [s], and how long `run` waits at its end for all threads together [s].
_POLL_S, _END_S = 0.05, 2.5
#: Blocks in one transaction, at most, and how long the first one waits for others [s].
_MAX_TRANSACTION_BLOCKS, _GATHER_S = 256, 0.02
#: Number of first occurrences of a problem that are all logged; later ones are logged at powers of two.
_FIRST_LINES = 3
#: The name of the source of lines.
_LINES = "standard input"
#: A source: submits blocks and refused messages until it has no more or the receiver stops.
Source = Callable[[BlockReceiver], None]
_Storable = TypeVar("_Storable", SourceBlock, RefusedMessage)


class Service:
    """A running monitor: it takes blocks of samples from its sources, stores them, and sends the events of alarms.

    `once`: True to end when standard input has ended and all files of the folders are stored; `stdin`, `stdout`:
    streams of incoming blocks and of outgoing events; `sources`: additional sources, such as a simulated rig.
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
        """Lock and open the database, restore the actuators from it, and start the page; `run` starts all else.

        Raises InputError if another monitor has locked the database, or if it or the page cannot be opened.
        """
        self.settings, self.once = settings, once
        self._queue: BoundedQueue[SourceBlock | RefusedMessage | None] = BoundedQueue(_QUEUE_BLOCKS, _QUEUE_BYTES)
        self._unstored: list[SourceBlock | RefusedMessage | None] = []  # of the present transaction
        self._stdin = stdin or (sys.stdin.buffer if sys.stdin is not None else BytesIO())
        self._extra_sources = [*sources]
        self._refused = self._n_waits = self._n_sources = 0
        self._is_database_blocked = False  # True while the database refuses blocks
        with ExitStack() as resources:  # released after an error
            if "://" not in settings.database:  # a file; the database of a server is not locked
                if not Path(settings.database).parent.is_dir():
                    raise InputError(f"the monitor's database must be in a folder that exists, got {settings.database}")
                busy = f"the database must belong to one monitor, but another one is running ({settings.database})"
                resources.enter_context(lock_file(Path(settings.database + ".lock"), busy))
            self.store = MonitorStore(settings.database)
            with threadpool_limits(limits=1):  # as in `run`: the number of threads changes rounding
                actuators = WatchedActuators(settings.actuator, self.store, settings.keep_days)
            self.actuators = actuators
            self.supervisor, self.count, self.summaries = actuators.supervisor, actuators.count, actuators.summaries
            self.stopping, self._database = self.supervisor.stopping, self.supervisor.part(DATABASE)
            self._live = LiveSamples(self.store.last_samples)
            self._lines = EventLines(self.store, stdout or _copy_standard_output())
            self.page: PageServer | None = None
            if settings.page is not None and not once:
                self.page = PageServer(actuators, settings.page, self.queue_load, self._live)
            self._resources = resources.pop_all()

    def submit(self, block: SourceBlock | RefusedMessage) -> None:
        """Queue a block or a refused message for storage; wait while the queue is full.

        A refused message is also counted and, unless there are many (`_is_logged`), logged. The web page draws the
        samples of a block before they are stored. If the service stops meanwhile, the block is neither stored nor
        acknowledged to its sender.
        """
        if isinstance(block, RefusedMessage):
            self.count(block.reason)
            self._refused += 1
            if block.reason == UNREADABLE_FILE:
                _log.warning("%s", block)
            elif _is_logged(self._refused):
                _log.warning("%s (message %d without a block)", block, self._refused)
        else:  # an error of the drawing, which `attempt` catches, must not prevent the storage
            self.supervisor.part("picture of samples").attempt(partial(self._live.push, block.actuator, block.samples))
        if self._queue.put(block, block.bytes):
            return
        self._n_waits += 1
        start, is_logged = time.monotonic(), False
        while not self.stopping.is_set() and not self._queue.put(block, block.bytes, timeout=0.5):
            if not is_logged and time.monotonic() - start > _LONG_WAIT_S:
                is_logged = True
                load = self.queue_load()
                _log.warning("a source waits: %d blocks are to be stored, %.1f MB", load.n_blocks, load.n_bytes / 1e6)

    def queue_load(self) -> QueueLoad:
        """Count the blocks and bytes in the queue and in the present transaction, and the waits of sources so far."""
        unstored = [*self._unstored]  # a copy, as another thread changes the list
        n_blocks, n_bytes = self._queue.size()
        n_bytes += sum(block.bytes for block in unstored if block is not None)
        return QueueLoad(n_blocks + len(unstored), n_bytes, self._n_waits)

    def run(self) -> None:
        """Start outputs and sources, and store blocks until `stop` is called or, without a page, all sources end.

        Linear algebra runs in one thread: the matrices are small, and several threads would mostly wait.
        """
        self._resources.enter_context(threadpool_limits(limits=1))
        sources, threads = self._all_sources(), list[threading.Thread]()
        storing = self.supervisor.part("storage")
        put_end = partial(self._queue.put, None, size=0, always=True)  # None in the queue: a source has ended
        self._n_sources = len(sources)
        try:
            repeat, write_events = self.supervisor.repeat, self._write_events
            threads.append(repeat("standard output", write_events, every_s=_POLL_S, last=write_events))
            for output in self._outputs():
                threads.append(repeat(output.part, output.deliver, every_s=_POLL_S, last=output.end))
            for name, source in sources:
                work = partial(source, self)
                threads.append(self.supervisor.start(name, work, restart=not self.once, on_end=put_end))
            while (self._n_sources or self.page is not None) and not self.stopping.is_set():
                if not storing.attempt(self._store_queued):
                    self.stopping.wait(storing.pause_s)
        finally:
            self.stop()
            if self.page is not None:
                self.page.leave()
            deadline = time.monotonic() + _END_S
            for thread in threads:
                if thread.name != _LINES:  # the source of lines may wait for ever
                    thread.join(max(0.0, deadline - time.monotonic()))
            if self.page is not None:
                self.page.close()
            self.close()

    def _all_sources(self) -> list[tuple[str, Source]]:
        """List all sources with their names, the additional ones first; raise InputError if a secret cannot be read."""
        sources = [(f"source {number}", source) for number, source in enumerate(self._extra_sources, 1)]
        if self.settings.lines:
            sources.append((_LINES, line_source(self._stdin)))
        if any(actuator.folder is not None for actuator in self.settings.actuator):
            sources.append(("folders", partial(watch_folders, once=self.once)))
        if self.settings.mqtt is not None:
            sources.append(("MQTT client", broker_source(self.settings.mqtt)))
        if self.settings.opcua is not None:
            sources.append(("OPC UA source", opcua_source(self.settings.opcua)))
        return sources

    def _outputs(self) -> Iterator[Webhook | SparkplugNode]:
        """Yield the outputs of alarms in the settings; raise InputError if a secret cannot be read.

        `deliver` of an output is called again and again, and `end` once; `part` is the name for its outages.
        """
        webhook, node, broker = self.settings.webhook, self.settings.sparkplug, self.settings.mqtt
        if webhook is not None:
            token = read_secret(webhook.token_file, "webhook.token_file")
            yield Webhook(self.store, webhook.url, token, webhook.timeout_s)
        if node is not None and broker is not None:  # never without a broker: the settings are checked
            yield SparkplugNode(self.actuators, broker, node)

    def _store_queued(self) -> None:
        """Store the next blocks of the queue; after an error the next call tries the same blocks again."""
        if not self._unstored:
            self._unstored = self._queue.pop(_MAX_TRANSACTION_BLOCKS, timeout=0.2)
            if 0 < len(self._unstored) < _MAX_TRANSACTION_BLOCKS and None not in self._unstored:
                self.stopping.wait(_GATHER_S)  # other blocks may arrive, to be stored in the same transaction
                self._unstored += self._queue.pop(_MAX_TRANSACTION_BLOCKS - len(self._unstored), timeout=0.0)
        blocks = [block for block in self._unstored if isinstance(block, SourceBlock)]
        self._store(blocks, self.actuators.process_blocks)
        refusals = [block for block in self._unstored if isinstance(block, RefusedMessage)]
        self._store(refusals, lambda messages: self.store.write_refused([message.row() for message in messages]))
        self._n_sources -= self._unstored.count(None)  # a source that ends queues None
        self._unstored = []

    def stop(self) -> None:
        """Tell `run` to end after the present transaction."""
        self.stopping.set()

    def close(self) -> None:
        """Release the lock of the database, which another monitor can then open."""
        self._resources.close()

    def _store(self, blocks: list[_Storable], write: Callable[[list[_Storable]], object]) -> None:
        """Store blocks, or refused messages, in one transaction by the function `write`, and acknowledge them.

        The error of an outage of the database is raised. After any other error the blocks are stored one by one, and a
        block that fails alone is counted, dropped and acknowledged: it would fail again and hold up later blocks.
        """
        if not blocks:
            return
        try:
            write(blocks)
        except Exception as error:
            if outage_reason(error) is not None:
                self.count("waits for the database")
                self._is_database_blocked = True
                raise
            if len(blocks) > 1:
                for block in blocks:
                    self._store([block], write)
                return
            self.count(DROPPED)
            if _is_logged(self.actuators.counters[DROPPED]):  # a refused message has no actuator: log its text
                _log.exception("a block is dropped: %s", str(getattr(blocks[0], "actuator", blocks[0]))[:60])
        else:
            self._is_database_blocked = False
            self._database.end_outage()
        finished_blocks = {*blocks}  # stored or dropped; each block equals only itself
        self._unstored = [block for block in self._unstored if block not in finished_blocks]
        for block in blocks:
            self.supervisor.part("acknowledgements").attempt(block.done, at_once=True)

    def _write_events(self) -> None:
        """Write new events of alarms to the output stream."""
        self._lines.deliver()
        if not self._is_database_blocked:  # the events were read, and nothing waits to be written
            self._database.end_outage()


def _copy_standard_output() -> TextIO:
    """Open another stream on the standard output, which a plug-in's call, that must not print there, leaves alone."""
    try:
        return os.fdopen(os.dup(sys.stdout.fileno()), "w", encoding=sys.stdout.encoding, errors=sys.stdout.errors)
    except (AttributeError, OSError, ValueError):  # there is none, or it is no file
        return sys.stdout


def _is_logged(number: int) -> bool:
    """Return True if occurrence `number` of a problem is logged: one of the first `_FIRST_LINES`, or a power of two."""
    return number <= _FIRST_LINES or number.bit_count() == 1
