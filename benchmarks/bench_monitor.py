"""What watching costs: processor time a block, actuators a core, bytes of state, and time from message to store.

    python benchmarks/bench_monitor.py [--seconds 600] [--actuators 20] [--paced 0] [--in-phase] [--by volumes]
        [--gateway 0]

Simulated actuators (p_A, p_B, x, theta, or `--by pressures` p_A, p_B, u, at 500 Hz, blocks of about 3 s in messages of
1 s) are watched by the library alone, then by a service on one core, from the bytes of the messages (JSON, then CBOR)
to the database in a temporary folder with full synchronisation, restored from a database in which each has learned. Its
threads are fed as fast as they take; with `--paced N` N actuators then send a message each second for a minute, and the
time from the instant when a message is due to its being stored is what an alarm waits. They begin to send one after
another within three seconds, as machines do that nobody started at one instant; with `--in-phase` all begin together,
and every third second or so all blocks of the detectors are complete at once. Where mosquitto is installed, JSON comes
from a broker as well, which holds all messages at first, and alarms go out by it. The load of the machine is printed
beside the times. With `--gateway N` alone resident memory and processor of services of one and of N actuators are
measured, each in a process of its own, and what each further actuator takes.
"""

from __future__ import annotations

import argparse
import ctypes
import gc
import io
import json
import os
import sys
import tempfile
import threading
import time
from contextlib import suppress
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path

import cbor2
import numpy as np
from paho.mqtt.client import Client
from paho.mqtt.enums import CallbackAPIVersion, MQTTProtocolVersion
from sqlalchemy import func, select

import sealscope as ss
from sealscope.monitor.actuators import WatchedActuators
from sealscope.monitor.database import tables
from sealscope.monitor.database.store import MonitorStore
from sealscope.monitor.service import Service
from sealscope.monitor.settings import ActuatorSettings, MonitorSettings
from sealscope.monitor.sources.source_block import decode_message

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from tests.monitor.servers import MOSQUITTO, Broker

CHANNELS = {"volumes": ("p_A", "p_B", "x", "theta"), "pressures": ("p_A", "p_B", "u")}
LEARN_H = 100.0 / 3600.0
#: Messages until the baseline is learned, after the response has settled, and how long the paced ones are
#: measured [s].
LEARNED, PACED_S = {"volumes": 180, "pressures": 330}, 60.0
#: Seconds within which the paced ones begin.
PHASES = 3


def pieces(seconds: float, by: str) -> list[ss.Recording]:
    """Messages of 1 s."""
    recording = ss.simulate(command="3 sin(4t)", duration=seconds, seed=0).only(CHANNELS[by])
    return [recording.samples(slice(k, k + 500)) for k in range(0, len(recording), 500)]


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=600.0, help="simulated time of each actuator")
    parser.add_argument("--actuators", type=int, default=20, help="actuators in the service")
    parser.add_argument("--paced", type=int, default=0, help="actuators that send at their own pace")
    parser.add_argument("--by", choices=tuple(CHANNELS), default="volumes", help="what they are watched by")
    parser.add_argument("--gateway", type=int, default=0, help="actuators for memory and processor of each")
    parser.add_argument("--in-phase", action="store_true", help="all of them begin at one instant")
    chosen = parser.parse_args()

    messages = pieces(chosen.seconds, chosen.by)
    if chosen.gateway:
        measure_gateway(messages, chosen.gateway, LEARNED[chosen.by])
        return
    watch = ss.watch("thesis", learn_hours=LEARN_H)
    warm = LEARNED[chosen.by] + 20
    for samples in messages[:warm]:
        watch.update(samples)
    blocks, start = watch.blocks, time.process_time()
    for samples in messages[warm:]:
        watch.update(samples)
    spent, blocks = time.process_time() - start, watch.blocks - blocks
    state = json.dumps(watch.state())
    print(f"library: {1e3 * spent / blocks:.2f} ms a block of {(len(messages) - warm) / blocks:.2f} s", end="; ")
    print(f"{blocks / spent:.0f} blocks/s, {(len(messages) - warm) / spent:.0f} actuators a core", end="; ")
    print(f"state {len(state)} bytes as JSON")

    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    forms = {
        "JSON": lambda values: json.dumps(values).encode(),
        "CBOR": cbor2.dumps,
        "CBOR, typed arrays": encode_typed_arrays,
    }
    for form, dumps in forms.items():
        payloads = [dumps(message(samples)) for samples in messages]
        spent, took, _, _ = served(payloads, chosen.actuators, 0.0, LEARNED[chosen.by], 1)
        print(
            f"service, {form} of {len(payloads[-1])} bytes: {1e3 * spent:.2f} ms of processor a message of 1 s",
            end="; ",
        )
        print(f"{1.0 / spent:.0f} actuators a core; as fast as it takes {1.0 / took:.0f} messages/s", flush=True)
    if MOSQUITTO is not None and chosen.by == "volumes":
        whole = ss.simulate(command="3 sin(4t)", duration=chosen.seconds, seed=0, leak="0.05 L/min from 282 s")
        leaking = whole.only(CHANNELS["volumes"])
        parts = [leaking.samples(slice(k, k + 500)) for k in range(0, len(leaking), 500)]
        texts, leaks = ([forms["JSON"](message(part)) for part in of] for of in (messages, parts))
        rate, waits = by_mqtt(texts, leaks, chosen.actuators)
        shown = ", ".join(f"{1e3 * wait:.0f}" for wait in waits)
        print(f"service, JSON over MQTT: {rate:.0f} messages/s; publication to alarm {shown} ms", flush=True)
    if chosen.paced:
        phases = 1 if chosen.in_phase else PHASES
        spent, _, waits, memory = served(payloads, chosen.paced, PACED_S, LEARNED[chosen.by], phases)
        median, rare = np.percentile(waits, [50, 99])
        print(f"{chosen.paced} actuators, {form}, a message each second for {PACED_S:.0f} s:", end=" ")
        print(
            f"{100.0 * spent * chosen.paced:.0f} % of a core; message to stored: median {1e3 * median:.0f} ms", end=", "
        )
        print(f"p99 {1e3 * rare:.0f} ms, most {max(waits):.2f} s; resident {memory / 1e6:.0f} MB", end="; ")
        print(f"load of the machine {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")


def by_mqtt(payloads: list[bytes], leaking: list[bytes], count: int) -> tuple[float, list[float]]:
    """Return messages a second from a broker that holds them, and times from publication to the alarm [s].

    `leaking`: messages of a machine that begins to leak; one is published each half second, to one actuator after the
    other, and the alarm that is heard belongs to the last one. The broker is mosquitto.
    """
    with tempfile.TemporaryDirectory() as folder:
        broker, names = Broker(Path(folder)), [f"press {k}" for k in range(count)]
        learned = LEARNED["volumes"]
        values = {
            "database": str(Path(folder) / "monitor.db"),
            "defaults": {"learn_hours": LEARN_H},
            "mqtt": {"host": "127.0.0.1", "port": broker.port},
            "actuator": [{"name": name, "topic": f"plant/{name}"} for name in names],
        }
        settings = MonitorSettings.model_validate(values)
        learn(settings, payloads, learned, 1)
        broker.open_session("sealscope-monitor", [f"plant/{name}" for name in names])
        client = Client(CallbackAPIVersion.VERSION2, "plant", protocol=MQTTProtocolVersion.MQTTv5)
        client.max_inflight_messages_set(1000)
        heard, alarm = threading.Event(), threading.Event()
        client.on_message = lambda *_: alarm.set()
        client.on_subscribe = lambda *_: heard.set()
        client.connect("127.0.0.1", broker.port)
        client.subscribe("sealscope/+/alarm", qos=1)
        client.loop_start()
        heard.wait(60.0)
        rest = payloads[learned : learned + 100]
        for payload in rest:
            last = [client.publish(f"plant/{name}", payload, qos=1) for name in names]
        for each in last:
            each.wait_for_publish(60.0)
        service = Service(settings, stdout=io.StringIO())
        thread = threading.Thread(target=service.run)
        stored = select(func.count()).select_from(tables.blocks)
        thread.start()
        while not (before := service.store._value(stored)):
            time.sleep(0.01)
        began = time.perf_counter()
        while (after := service.store._value(stored)) < len(rest) * count:
            time.sleep(0.01)
        rate, waits = (after - before) / (time.perf_counter() - began), list[float]()
        for name in names[: min(count, 5)]:
            alarm.clear()
            for payload in leaking[learned + 100 :]:
                published = time.perf_counter()
                client.publish(f"plant/{name}", payload, qos=1)
                if alarm.wait(0.5):
                    waits.append(time.perf_counter() - published)
                    break
        service.stop()
        thread.join()
        service.store.engine.dispose()
        client.loop_stop()
        broker.stop()
    return rate, waits


def message(samples: ss.Recording) -> dict[str, object]:
    """Samples as a message of 9 digits."""
    channels = {name: [float(f"{value:.9g}") for value in samples[name]] for name in samples.channels}
    return {"t": float(samples.t[0]), "rate": samples.rate, **channels}


def encode_typed_arrays(values: dict[str, object]) -> bytes:
    """A message as CBOR with its channels as arrays of floats (RFC 8746)."""
    arrays = {
        name: cbor2.CBORTag(86, np.array(value, "<f8").tobytes())
        for name, value in values.items()
        if isinstance(value, list)
    }
    return cbor2.dumps({**values, **arrays})


def resident() -> int:
    """Resident bytes of this process."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def learn(settings: MonitorSettings, payloads: list[bytes], learned: int, phases: int) -> None:
    """Write a database in which all actuators have learned: the rows of some that have, under the names of all."""
    store = MonitorStore(settings.database)
    teachers = [ActuatorSettings(name=f"teacher {k}", learn_hours=LEARN_H) for k in range(phases)]
    watched = WatchedActuators(teachers, store)
    for k, teacher in enumerate(teachers):
        for payload in payloads[k:learned]:
            watched.process_blocks([decode_message(payload, teacher.name)])
    with store.writing() as connection:
        for table in (tables.actuators, tables.pending):
            rows = [dict(row._mapping) for row in connection.execute(select(table))]
            connection.execute(table.delete())
            for n, actuator in enumerate(settings.actuator):
                of = [row for row in rows if row["actuator"] == teachers[n % phases].name]
                if of:
                    connection.execute(table.insert(), [{**row, "actuator": actuator.name} for row in of])
        for table in (tables.blocks, tables.estimates):
            connection.execute(table.delete())
    store.engine.dispose()


def served(
    payloads: list[bytes], count: int, paced: float, learned: int, phases: int
) -> tuple[float, float, list[float], int]:
    """Return processor time and time a message [s] of a service that has learned, times of each, and resident bytes.

    `paced`: each actuator sends a message a second for so long [s]; 0: as fast as the service takes them; `phases`: the
    actuators begin with the first message, the second, and so on up to so many.
    """
    names = [f"press {k}" for k in range(count)]
    waits: list[float] = []
    measured: list[float] = []

    def source(service: object) -> None:
        done = [0]

        def send(name: str, payload: bytes, due: float) -> None:
            def stored() -> None:
                done[0] += 1
                waits.append(time.perf_counter() - due)

            service.submit(replace(decode_message(payload, name), done=stored))  # type: ignore[attr-defined]

        def wait_for_blocks(number: int) -> None:
            while done[0] < number:
                time.sleep(0.01)

        rounds = int(paced) or min(100, len(payloads) - learned)
        began, clock = time.process_time(), time.perf_counter()
        for k in range(rounds):
            for n, name in enumerate(names):
                due = clock + k + n / count if paced else time.perf_counter()
                if (early := due - time.perf_counter()) > 0.0:
                    time.sleep(early)
                send(name, payloads[learned + k], due)  # a service that falls behind makes the sender late, too
        wait_for_blocks(rounds * count)
        total = rounds * count
        measured.extend([(time.process_time() - began) / total, (time.perf_counter() - clock) / total, resident()])

    with tempfile.TemporaryDirectory() as folder:
        settings = MonitorSettings.model_validate(
            {
                "database": str(Path(folder) / "monitor.db"),
                "defaults": {"learn_hours": LEARN_H},
                "actuator": [{"name": name} for name in names],
            }
        )
        learn(settings, payloads, learned, phases)
        gc.collect()
        with suppress(OSError, AttributeError):
            ctypes.CDLL(None).malloc_trim(0)  # of glibc: what learning took is given back
        service = Service(settings, stdout=io.StringIO(), sources=[source])
        service.run()
        service.store.engine.dispose()
    return measured[0], measured[1], waits, int(measured[2])


def measure_gateway(messages: list[ss.Recording], count: int, learned: int) -> None:
    """Print memory and processor of services of one and of `count` actuators."""
    payloads = [json.dumps(message(samples)).encode() for samples in messages]
    figures = []
    for number in (1, count):
        with get_context("fork").Pool(1) as pool:
            figures.append(pool.apply(served, (payloads, number, 0.0, learned, 1)))
    (_, _, _, single), (spent, _, _, several) = figures
    each = (several - single) / max(count - 1, 1)
    print(
        f"service of one actuator: {single / 1e6:.0f} MB; of {count}: {several / 1e6:.0f} MB, {each / 1e6:.2f} MB each",
        end="; ",
    )
    print(f"{100.0 * spent:.2f} % of a core each, for {len(payloads[-1])} bytes of JSON a second")


if __name__ == "__main__":
    main()
