"""How fast the workbench shows logs: first table, first trace, a pan, memory, and the first sight of a long file.

    python benchmarks/bench_workbench.py [--files 200] [--rows 3600000] [--folder FOLDER]

Each figure is asked of the server as the page asks for it, over HTTP, while logs are read in the background.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import statistics
import subprocess
import sys
import time
import urllib.request
from http.cookiejar import CookieJar
from pathlib import Path
from tempfile import TemporaryDirectory
from urllib.parse import urlencode

import numpy as np

from sealscope.app.tables import cache_folder

SERVING = """
import sys
from sealscope.app.server import AppServer
server = AppServer(sys.argv[1])
print(server.address, flush=True)
server.wait()
"""
CHANNELS = ("p_A [bar]", "p_B [bar]", "x [mm]", "omega [rpm]", "u [V]", "T_oil [degC]")


def write_rows(path: Path, rows: int, names: list[str], seed: int) -> None:
    """Write a log with a row for each sample; the same noise is repeated, so that writing is fast."""
    noise = np.random.default_rng(seed).normal(size=(5000, len(names)))
    body = ["," + ",".join(f"{value:.5f}" for value in row) + "\n" for row in noise]
    with path.open("w", encoding="utf-8") as file:
        file.write(",".join(["t [s]", *names]) + "\n")
        for start in range(0, rows, len(body)):
            count = min(len(body), rows - start)
            file.write("".join(f"{(start + k) / 1000:.3f}{body[k]}" for k in range(count)))


class Client:
    """A visitor of the workbench of a folder, in a process of its own."""

    def __init__(self, folder: Path) -> None:
        self.process = subprocess.Popen([sys.executable, "-c", SERVING, folder], stdout=subprocess.PIPE, text=True)
        assert self.process.stdout is not None
        address = self.process.stdout.readline().strip()
        self.page = address.split("start?")[0]
        self.opener = urllib.request.build_opener(urllib.request.HTTPCookieProcessor(CookieJar()))
        self.opener.open(address).read()

    def ask(self, what: str, **query: object) -> dict:
        return json.load(self.opener.open(f"{self.page}api/{what}?{urlencode(query)}"))

    def tell(self, what: str, **values: object) -> None:
        headers = {"X-Sealscope": "app", "Origin": self.page.rstrip("/"), "Content-Type": "application/json"}
        request = urllib.request.Request(f"{self.page}api/{what}", json.dumps(values).encode(), headers)
        self.opener.open(request).read()

    def memory_mb(self) -> float:
        """Most memory of the server so far that is not of mapped files [MB]."""
        status = Path(f"/proc/{self.process.pid}/status").read_text()
        fields = dict(line.split(":", 1) for line in status.splitlines())
        return int(fields["RssAnon"].split()[0]) / 1e3

    def close(self) -> None:
        self.process.terminate()
        self.process.wait()


def see(client: Client, key: str, seconds: float = 0.0) -> tuple[float, int]:
    """Return the time [s] until the first trace of a log is drawn, and the number of its rows then."""
    start = time.perf_counter()
    while True:
        head = client.ask("window", table="columns", file=key, columns="", pixels=10)
        if head["names"]:
            columns = ",".join(str(k) for k in range(len(head["names"])))
            data = client.ask("window", table="columns", file=key, columns=columns, pixels=1200)
            return time.perf_counter() - start, data["count"]
        time.sleep(0.02)


def measure(folder: Path, files: int, rows: int) -> None:
    logs = folder / "logs"
    logs.mkdir(exist_ok=True)
    for k in range(files):
        if not (logs / f"day_{k:03d}.csv").exists():
            write_rows(logs / f"day_{k:03d}.csv", 240_000, list(CHANNELS), k)
    size = (logs / "day_000.csv").stat().st_size / 1e6
    shutil.rmtree(folder / "session", ignore_errors=True)
    shutil.rmtree(cache_folder(), ignore_errors=True)
    client = Client(folder / "session")
    start = time.perf_counter()
    client.tell("open", path=str(logs))
    state = client.ask("state")
    print(f"{files} files of {size:.1f} MB: table of {len(state['keys'])} logs in {time.perf_counter() - start:.2f} s")
    keys = state["keys"]
    seconds, count = see(client, keys[files // 2])
    print(f"first trace in {seconds:.2f} s ({count} rows by then)")
    while not client.ask("window", table="columns", file=keys[files // 2], columns="", pixels=10)["complete"]:
        time.sleep(0.05)
    pans, seen = [], {"table": "columns", "file": keys[files // 2], "columns": "0,1,2", "pixels": 1200}
    for k in range(60):
        begin = 3.0 * k
        start = time.perf_counter()
        client.ask("window", **seen, **{"from": begin, "to": begin + 60.0})
        pans.append(time.perf_counter() - start)
    slow, usual = 1e3 * sorted(pans)[56], 1e3 * statistics.median(pans)
    print(f"a pan while logs are read: median {usual:.0f} ms, 95 % {slow:.0f} ms")
    most, start = 0.0, time.perf_counter()
    while any(job["state"] in ("running", "waiting") for job in client.ask("state", since=10**9)["jobs"]):
        most = max(most, client.memory_mb())
        time.sleep(0.2)
    print(
        f"all logs read {time.perf_counter() - start:.0f} s later; most memory {max(most, client.memory_mb()):.0f} MB"
    )
    client.close()
    long = folder / "long"
    long.mkdir(exist_ok=True)
    if not (long / "long.csv").exists():
        write_rows(long / "long.csv", rows, [f"c{k} [bar]" for k in range(12)], 1)
    size = (long / "long.csv").stat().st_size / 1e6
    client = Client(folder / "session")
    client.tell("open", path=str(long / "long.csv"))
    seconds, count = see(client, str(long / "long.csv"))
    print(f"{rows} rows and 12 columns ({size:.0f} MB): first seen in {seconds:.2f} s ({count} rows by then)")
    start = time.perf_counter()
    most = 0.0
    query = {"table": "columns", "file": str(long / "long.csv"), "pixels": 1200}
    while not (data := client.ask("window", columns="0", **query))["complete"]:
        most = max(most, client.memory_mb())
        if data["error"]:
            raise SystemExit(data["error"])
        time.sleep(0.05)
    print(f"whole {time.perf_counter() - start:.1f} s later, most memory {most:.0f} MB")
    start = time.perf_counter()
    client.ask("window", columns=",".join(map(str, range(12))), **query)
    print(f"the whole of it, 12 columns, in {1e3 * (time.perf_counter() - start):.0f} ms")
    client.close()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--files", type=int, default=200)
    parser.add_argument("--rows", type=int, default=3_600_000)
    parser.add_argument("--folder", type=Path)
    arguments = parser.parse_args()
    with TemporaryDirectory() as temporary:
        place = arguments.folder or Path(temporary)
        os.environ.setdefault("SEALSCOPE_CACHE_DIR", str(place / "cache"))
        measure(place, arguments.files, arguments.rows)
