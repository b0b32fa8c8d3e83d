"""Run the workbench: its server on this computer, its page in the browser, and a session replayed without either."""

from __future__ import annotations

import logging
import os
import threading
import webbrowser
from collections.abc import Callable
from dataclasses import replace

import uvicorn

from sealscope.app.session import SessionFolder
from sealscope.app.site import LaunchGuard, make_site
from sealscope.app.workbench import Workbench
from sealscope.diagnosis.commissioned.machine import commission
from sealscope.diagnosis.diagnose import diagnose
from sealscope.errors import InputError, SealscopeError
from sealscope.reporting.messages import table_line
from sealscope.storage.plain_values import to_plain
from sealscope.web.serving import format_place, make_server, open_socket

_HOST = "127.0.0.1"


class AppServer:
    """The server of the workbench of a session's folder, in a thread of its own until `close`.

    `address` opens the page once: it holds the launch token.
    """

    def __init__(self, folder: str | os.PathLike[str], port: int = 0) -> None:
        self.workbench = Workbench(SessionFolder(folder))
        self.guard = LaunchGuard()
        self._socket = open_socket(_HOST, port, "--port")
        self.port = int(self._socket.getsockname()[1])
        self.page = f"http://{format_place(_HOST, self.port)}/"
        self.address = f"{self.page}start?token={self.guard.token}"
        self._server: uvicorn.Server = make_server(make_site(self.workbench, self.guard))
        self._thread = threading.Thread(target=self._serve, name="app", daemon=True)
        self._thread.start()

    def _serve(self) -> None:
        self._server.run(sockets=[self._socket])

    def wait(self) -> None:
        """Wait until the server ends."""
        while self._thread.is_alive():
            self._thread.join(timeout=0.5)

    def close(self) -> None:
        """End the server and the work in the background."""
        self._server.should_exit = True
        self._thread.join(timeout=3.0)
        self._socket.close()
        self.workbench.close()


def run_app(folder: str | os.PathLike[str], port: int, *, browser: bool, say: Callable[[str], None]) -> None:
    """Serve the workbench of a folder until Ctrl-C; `browser`: open its page; `say` prints a line."""
    logging.getLogger("uvicorn").setLevel(logging.ERROR)
    server = AppServer(folder, port)
    try:
        say(f"workbench of {server.workbench.folder.folder}: {server.address}")
        say("the address opens the page once; Ctrl-C ends the workbench")
        if browser and not webbrowser.open(server.address):
            say("no browser could be opened: open the address yourself")
        server.wait()
    finally:
        server.close()


def replay_session(folder: str | os.PathLike[str], say: Callable[[str], None]) -> bool:
    """Judge the recordings of a session anew, without a browser; return True if all verdicts are as it says.

    Each machine is commissioned from its healthy logs, as the session did, and each log that has a verdict is judged.
    """
    session_folder = SessionFolder(folder)
    if not session_folder.file.exists():
        raise InputError(f"a session to replay must hold session.toml, got none ({session_folder.folder})")
    is_equal, count = True, 0
    keys, _ = session_folder.list_keys()
    for stated in session_folder.read().machine:
        rig, machine = stated.build_rig(), None
        if stated.commissioned:
            paths = [session_folder.path_of(key) for key in keys if key in stated.healthy]
            machine = commission(
                paths, rig=rig, map=stated.channel_map, rate=stated.rate, limit=stated.limit, name=stated.name
            )
        for reached in stated.verdicts:
            path = session_folder.path_of(reached.file)
            try:
                if machine is not None:
                    diagnosis = replace(machine.diagnose(machine.read(path)), file=str(path))
                else:
                    from sealscope.app.logs import read_for

                    diagnosis = diagnose(read_for(stated, path), rig=rig, limit=stated.limit, file=path)
            except SealscopeError as error:
                say(f"{stated.name}: {error}")
                is_equal = False
                continue
            count += 1
            found = (diagnosis.verdict, diagnosis.summary, to_plain(diagnosis.leak_lpm), to_plain(diagnosis.bound_lpm))
            kept = (reached.verdict, reached.summary, reached.leak_lpm, reached.bound_lpm)
            say(table_line(diagnosis))
            if found != kept:
                say(f"  the session says: {', '.join(str(value) for value in kept if value is not None)}")
                is_equal = False
    say(f"{count} verdicts, {'equal to those of the session' if is_equal else 'not all as the session says'}")
    return is_equal
