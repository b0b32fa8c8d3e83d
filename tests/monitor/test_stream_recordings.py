"""The stream of a commissioned machine, or without a position, is judged in recordings, as files of a folder are."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import sealscope as ss
from sealscope.diagnosis.verdict.severity import state_of
from sealscope.monitor.alarms import AlarmJudge
from sealscope.monitor.outputs.prometheus import format_metrics
from sealscope.monitor.service import Service
from sealscope.monitor.settings import WatchSettings, read_settings
from sealscope.monitor.sources.source_block import decode_message
from sealscope.monitor.sources.stream_recordings import StreamRecorder
from sealscope.monitor.verdicts import RecordingVerdict
from sealscope.recordings.recording import CHANNEL_UNITS, Recording

from ..diagnosis.balance_machine import machine, step
from ..refusals import refusal
from .plant import CHANNELS, lines_of, moved, rows_of, served

LEAK = 3.0e-12
APRIL = 1.775e9
FULL_S = 60.0


def settings_of(folder: Path, machine_file: Path, more: str = "", recording_s: float = FULL_S, rate: float = 20.0):
    """Settings of one machine whose samples come as lines, in recordings of a minute."""
    file = folder / "watch.toml"
    file.write_text(
        f'database = "monitor.db"\nlines = true\n[[actuator]]\nname = "press"\nmachine = "{machine_file}"\n'
        f"recording_s = {recording_s}\nfalse_alarms_per_1000_h = {rate}\n{more}",
        encoding="utf-8",
    )
    return read_settings(file)


def stream(seed: int, start: float, *, leaks: bool) -> Recording:
    """Three minutes of the machine, which leaks from the first sample on or never."""
    leak = step(0.0, LEAK, at=0.0) if leaks else None
    options = {} if leak is None else {"G": leak}
    return moved(machine(seed, rate=100.0, duration=190.0, **options).only(CHANNELS), APRIL + start)


def lines_in(recordings: Sequence[Recording]) -> bytes:
    return b"".join(lines_of({"press": recording}, 100) for recording in recordings)


@pytest.fixture(scope="module")
def leak_lines() -> bytes:
    return lines_in([stream(9, 0.0, leaks=True)])


@pytest.mark.slow
def test_a_leak_from_the_first_sample_on_is_what_diagnose_says(commissioned, tmp_path, leak_lines):
    service, out = served(settings_of(tmp_path, commissioned), leak_lines)
    samples = [json.loads(line) for line in leak_lines.splitlines()][:61]
    channels = {name: np.concatenate([block[name] for block in samples]) for name in CHANNELS}
    units = {name: ss.read_machine(commissioned).healthy[0].units[name] for name in CHANNELS}
    first = Recording(np.arange(len(channels["x"])) / 100.0, channels, units, 100.0)
    diagnosis = ss.read_machine(commissioned).diagnose(first)
    assert (diagnosis.verdict, diagnosis.onset_s) == ("leak", None)
    assert [json.loads(line)["event"] for line in out.splitlines()] == ["raised"]
    (alarm,) = service.store.alarms(open_only=True)
    assert alarm["evidence"].startswith("stream from 2026-03-31 23:3")
    assert alarm["leak_lpm"] == pytest.approx(diagnosis.leak_lpm, rel=0.1)
    summary = service.summaries()["press"]
    assert (summary["recording"]["verdict"], summary["state"]["condition"]) == ("leak", "leak")


def test_the_chance_of_a_block_s_alarm_is_by_the_blocks_part_of_the_false_alarms(commissioned, tmp_path, leak_lines):
    """Beside recordings, of which none ends here, the blocks have half the rate: as if it were stated without any."""
    lines, chances = b"".join(leak_lines.splitlines(keepends=True)[:80]), []
    for recording_s, rate in ((600.0, 20.0), (0.0, 10.0)):
        (folder := tmp_path / f"{rate:g}").mkdir()
        service, _ = served(settings_of(folder, commissioned, "", recording_s, rate), lines)
        (alarm,) = service.store.alarms()
        chances.append(alarm["by_chance_per_1000_h"])
    assert chances[0] == pytest.approx(chances[1])


@pytest.mark.slow
def test_the_verdict_on_a_healthy_recording_ends_the_alarm(commissioned, tmp_path, leak_lines):
    settings = settings_of(tmp_path, commissioned)
    _, out = served(settings, leak_lines + lines_in([stream(12, 1000.0, leaks=False)]))
    assert [json.loads(line)["event"] for line in out.splitlines()] == ["raised", "returned"]


@pytest.mark.slow
@pytest.mark.parametrize("n_lines", [40, 130])
def test_a_monitor_that_restarts_within_a_recording_has_the_rows_of_one_that_did_not(
    commissioned, tmp_path, leak_lines, n_lines
):
    (tmp_path / "other").mkdir()
    whole, halves = settings_of(tmp_path, commissioned), settings_of(tmp_path / "other", commissioned)
    served(whole, leak_lines)
    lines = leak_lines.splitlines(keepends=True)
    served(halves, b"".join(lines[:n_lines]))
    served(halves, b"".join(lines[n_lines:]))
    expected, rows = rows_of(whole.database), rows_of(halves.database)
    assert len(expected["alarms"]) == 1
    for table in ("estimates", "alarms", "events", "summaries", "pending"):
        assert rows[table] == expected[table], table


def rig_settings(folder: Path):
    """Settings of a machine of which only the rig is known."""
    file = folder / "watch.toml"
    text = 'database = "monitor.db"\nlines = true\n[[actuator]]\nname = "press"\nrig = "thesis"\nrecording_s = 60\n'
    file.write_text(text, encoding="utf-8")
    return read_settings(file)


@pytest.mark.slow
def test_a_stream_without_a_position_is_judged_as_diagnose_judges_its_recordings(tmp_path):
    """No block shows anything; the summary has the verdict on the last recording, whatever the restarts."""
    worn = ss.simulate(command="5 sin(2t)", duration=100.0, seed=1, leak="0.015 L/min from 25 s")
    worn = worn.only(("p_A", "p_B", "u"))
    lines = lines_of({"press": worn}, 500).splitlines(keepends=True)
    service, _ = served(rig_settings(tmp_path), b"".join(lines))
    summary = service.summaries()["press"]
    stated = summary["recording"]
    recorder = StreamRecorder("press", 60.0)
    blocks = [worn.samples(slice(k, k + 500)) for k in range(0, len(worn), 500)]
    (recording,) = recordings_of(recorder, blocks)
    diagnosis = ss.diagnose(replace(recording, t=recording.t - recording.t[0]), rig="thesis")
    assert (stated["verdict"], summary["by"]) == (diagnosis.verdict, "recordings") == ("leak", "recordings")
    assert summary["leak_lpm"] == pytest.approx(diagnosis.leak_lpm, rel=0.01)  # lines have fewer digits
    assert summary["state"]["condition"].startswith("leak")
    assert 'sealscope_watched{actuator="press",by="recordings"} 1.0' in format_metrics(service.summaries(), {})
    assert rows_of(service.settings.database)["estimates"] == []
    (tmp_path / "halves").mkdir()
    halves = rig_settings(tmp_path / "halves")
    for part in (lines[:30], lines[30:]):
        served(halves, b"".join(part))
    assert rows_of(halves.database)["summaries"] == rows_of(service.settings.database)["summaries"]


def test_of_a_rig_alone_a_stream_with_a_position_is_judged_by_its_blocks(tmp_path, leak_lines):
    service, _ = served(rig_settings(tmp_path), b"".join(leak_lines.splitlines(keepends=True)[:70]))
    actuator = service.actuators._actuator("press")
    assert actuator.recorder is not None and actuator.recorder.blocks == []
    assert service.summaries()["press"]["recording"] is None
    assert actuator.watch.blocks > 10


@pytest.mark.parametrize(
    ("rig", "names"),
    [
        ("thesis", ("p_A", "p_B", "u")),
        ("single-rod-eha", ("p_A", "p_B", "theta")),
        ("servo-valve", ("p_A", "p_B", "u")),
    ],
)
def test_channels_that_do_not_suffice_for_blocks_are_refused_with_those_that_do(rig: str, names: tuple[str, ...]):
    t = np.arange(0.0, 100.0, 0.002)
    units = {name: CHANNEL_UNITS[name] for name in names}
    watch = ss.watch(rig)
    samples = Recording(t, {name: np.sin(t) for name in names}, units, 500.0)
    assert watch.lacks_channels(samples)
    assert watch.update(samples) == []
    ((reason, number),) = watch.counters.items()
    assert number == len(t)
    assert reason.startswith("samples without p_A, p_B")
    assert watch.evidence.verdict == "cannot tell" and reason in watch.evidence.reason


def test_only_the_samples_of_a_recording_that_has_not_ended_are_stored(commissioned, tmp_path):
    lines = lines_in([stream(12, 0.0, leaks=False)]).splitlines(keepends=True)
    service, _ = served(settings_of(tmp_path, commissioned), b"".join(lines[:70]))
    recorder = service.actuators._actuator("press").recorder
    assert recorder is not None
    numbers = [block.number for block in service.store.pending("press")]
    assert numbers == list(range(numbers[0], 71))
    assert sum(map(len, recorder.blocks)) < 7000
    again = Service(service.settings, once=True)
    again.close()
    restored = again.actuators._actuator("press").recorder
    assert restored.state() == recorder.state()
    assert [len(block) for block in restored.blocks] == [len(block) for block in recorder.blocks]


def test_a_mark_that_ends_an_alarm_forgets_the_samples_before_it(commissioned, tmp_path):
    lines = lines_in([stream(12, 0.0, leaks=False)]).splitlines(keepends=True)
    service, _ = served(settings_of(tmp_path, commissioned), b"".join(lines[:20]))
    actuator = service.actuators._actuator("press")
    assert actuator.recorder.blocks
    leak = {"start_s": 0.0, "end_s": 60.0, "chance": None}
    actuator.judge.update_from_verdict(verdict("leak", **leak), None, 1, WatchSettings())
    service.actuators.apply_mark("press", "repaired")
    assert (actuator.recorder.blocks, actuator.recorder.first) == ([], 0)
    assert service.store.pending("press") == []


def pieces(duration: float, start: float = 0.0, rate: float = 10.0) -> list[Recording]:
    """Blocks of 5 s, as long as `duration` together."""
    t = start + np.arange(round(duration * rate)) / rate
    whole = Recording(t, {"p_A": t, "p_B": t}, {"p_A": "Pa", "p_B": "Pa"}, rate)
    size = round(5.0 * rate)
    return [whole.samples(slice(k, k + size)) for k in range(0, len(t), size)]


def recordings_of(recorder: StreamRecorder, blocks: Sequence[Recording]) -> list[Recording]:
    taken = (recorder.take(number, block) for number, block in enumerate(blocks, 1))
    return [recording for recording in taken if recording is not None]


def test_recordings_follow_each_other_without_loss_and_the_first_is_shorter():
    blocks = pieces(1000.0)
    recordings = recordings_of(StreamRecorder("press", 180.0), blocks)
    durations = [recording.duration for recording in recordings]
    assert 90.0 <= durations[0] <= 185.0
    assert all(abs(duration - 180.0) < 6.0 for duration in durations[1:])
    joined = np.concatenate([recording.t for recording in recordings])
    assert np.array_equal(joined, np.concatenate([block.t for block in blocks])[: len(joined)])
    others = {recordings_of(StreamRecorder(f"press {k}", 180.0), blocks)[0].duration for k in range(20)}
    assert len(others) > 8  # many machines do not end their recordings at once


@pytest.mark.parametrize("pause", [-500.0, 11.0, 3600.0])
def test_a_gap_or_a_clock_set_back_ends_a_recording(pause):
    before = pieces(80.0)
    after = pieces(40.0, start=80.0 + pause)
    ended = recordings_of(StreamRecorder("press", 600.0), before + after)
    assert [recording.duration for recording in ended] == pytest.approx([80.0], abs=0.2)
    assert not recordings_of(StreamRecorder("press", 600.0), before[:8] + after)  # 40 s are too short


def test_a_pause_of_some_seconds_stays_within_a_recording():
    ended = recordings_of(StreamRecorder("press", 60.0), pieces(40.0) + pieces(40.0, start=45.0))
    assert len(ended) == 1 and np.diff(ended[0].t).max() == pytest.approx(5.1)


def test_another_rate_or_channel_ends_a_recording():
    other_rate = pieces(20.0, start=80.0, rate=20.0)
    assert len(recordings_of(StreamRecorder("press", 600.0), pieces(80.0) + other_rate)) == 1
    fewer_channels = [block.only(["p_A"]) for block in pieces(20.0, start=80.0)]
    assert len(recordings_of(StreamRecorder("press", 600.0), pieces(80.0) + fewer_channels)) == 1


def test_a_recorder_holds_no_more_samples_than_it_may(monkeypatch):
    monkeypatch.setattr("sealscope.monitor.sources.stream_recordings._MAX_BYTES", 20_000)
    recorder = StreamRecorder("press", 600.0)
    for number, block in enumerate(pieces(2000.0), 1):
        recorder.take(number, block)
        assert sum(8 * 3 * len(held) for held in recorder.blocks) < 20_000


def verdict(word: str = "leak", chance: float | None = 1e-3, **more) -> RecordingVerdict:
    state = state_of(word, "piston leak" if word == "leak" else None).as_dict()
    words = {"file": "stream", "summary": word, "size": "", "reason": "", "cause": ""}
    return RecordingVerdict(
        verdict=word, state=state, chance=chance, **words, **{"start_s": 0.0, "end_s": 180.0, **more}
    )


def alarms_of(judge: AlarmJudge, verdicts: Sequence[RecordingVerdict], rate: float = 1.0) -> list[int]:
    """Numbers of the recordings that raise an alarm, which is withdrawn at once."""
    raised = []
    for number, each in enumerate(verdicts, 1):
        judge.add_evidence(each)
        settings = WatchSettings(false_alarms_per_1000_h=rate)
        if judge.update_from_verdict(each, None, 1, settings, is_stream=True) is not None:
            raised.append(number)
            judge.apply_mark("invalid", 0.0, reason="none")
    return raised


def test_an_alarm_of_a_stream_needs_several_recordings():
    """At one false alarm in 1000 h, half of it for recordings, one of 3 min has 2.5e-5: less than a chance is known."""
    sure, likely, cleared, unknown = (
        verdict(chance=1e-9),
        verdict(chance=9e-3),
        verdict("no leak"),
        verdict("cannot tell"),
    )
    assert alarms_of(AlarmJudge("press"), [sure, sure, sure]) == [3]
    assert alarms_of(AlarmJudge("press"), [sure, unknown, sure, sure]) == [4]
    assert alarms_of(AlarmJudge("press"), [sure, cleared, sure]) == []
    assert alarms_of(AlarmJudge("press"), [likely] * 8) == [7]
    assert alarms_of(AlarmJudge("press"), [likely, cleared, cleared, cleared] * 50) == []
    assert alarms_of(AlarmJudge("press"), [sure, sure], rate=20.0) == [2]


def test_the_alarms_of_leak_free_streams_keep_the_stated_rate():
    """Of recordings that are `leak` at 1 % by chance, in 2 000 h, the alarms are no more than the rate allows."""
    rng, rate, hours = np.random.default_rng(7), 100.0, 2000.0
    chances = rng.random(round(hours * 20.0))  # 20 recordings an hour
    verdicts = [verdict(chance=p) if p < 0.01 else verdict("no leak") for p in chances]
    raised = alarms_of(AlarmJudge("press"), verdicts, rate=rate)
    assert len(raised) <= rate * hours / 1000.0
    assert raised  # the threshold is not out of reach


@pytest.mark.parametrize(("bound", "ends"), [(0.001, True), (0.02, False), (None, True)])
def test_no_leak_ends_only_the_alarm_of_a_leak_that_it_excludes(commissioned, tmp_path, bound, ends):
    """Three minutes show a leak above the bound only: the detector has found a smaller one over hours."""
    service, _ = served(settings_of(tmp_path, commissioned))
    actuator = service.actuators._actuator("press")
    settings = WatchSettings(false_alarms_per_1000_h=20.0)
    actuator.judge.update_from_verdict(verdict(chance=None, leak_lpm=0.01), None, 1, settings)
    block = Recording([], {}, {}, 100.0)
    cleared = verdict("no leak", bound_lpm=bound)
    _, events = actuator.judge_samples(block, follows=True, settings=settings, verdict=cleared)
    assert [event for _, event, _ in events] == (["returned"] if ends else [])
    assert actuator.judge.alarm is None or actuator.judge.alarm.active != ends


def test_the_length_of_a_recording_is_none_or_a_minute_to_ten(commissioned, tmp_path):
    for seconds in ("30", "601", "nan"):
        with refusal("recording_s", seconds):
            settings_of(tmp_path, commissioned, f"[defaults]\nrecording_s = {seconds}\n")


def test_a_boom_without_a_pump_is_watched_by_its_recordings(commissioned, tmp_path):
    """No balance of blocks has a flow meter; the recordings of a stream have."""
    nodes = ", ".join(f'{name} = "ns=2;s={name}"' for name in ("p_A", "p_B", "x", "q_pump"))
    opcua = '[opcua]\nurl = "opc.tcp://localhost:4840"\n'
    (actuator,) = settings_of(tmp_path, commissioned, f"rate = 100.0\nnodes = {{ {nodes} }}\n{opcua}").actuator
    assert "q_pump" in actuator.nodes
    with refusal("nodes", "theta"):
        settings_of(tmp_path, commissioned, f"rate = 100.0\nnodes = {{ {nodes} }}\n{opcua}", recording_s=0.0)
    block = decode_message(b'{"t": 0.0, "rate": 10.0, "p_A": [1, 2], "p_B": [1, 2], "q_pump": [0, 0]}', "press")
    assert block.samples is not None and "q_pump" in block.samples


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_outputs_and_metrics_state_one_leak(seed: int, commissioned, tmp_path):
    """A leak from the first sample on that grows: the open alarm has the leak of the summary after each message.

    The last event states it, too, within the 95 % intervals.
    """
    random = np.random.default_rng(seed)
    conductance, growth, start = (
        10.0 ** random.uniform(-11.8, -11.0),
        random.uniform(4.0, 6.0),
        random.uniform(100, 160),
    )

    def leak(t: np.ndarray) -> np.ndarray:
        return conductance * (1.0 + growth * (t > start))

    samples = moved(machine(20 + seed, rate=100.0, duration=240.0, G=leak).only(CHANNELS), APRIL)
    service = Service(settings_of(tmp_path, commissioned), once=True)
    n_alarms, n_updates, announced = 0, 0, None
    for line in lines_in([samples]).splitlines():
        service.actuators.process_blocks([decode_message(line)])
        summary = service.summaries()["press"]
        events = service.store.last_events("press")
        n_updates = sum(event["event"] == "updated" for event in events)
        for alarm in service.store.alarms(open_only=True):
            n_alarms += 1
            if summary["leak_lpm"] is not None and alarm["updated_s"] == summary["t"]:
                assert alarm["leak_lpm"] == pytest.approx(summary["leak_lpm"])
            announced = events[0]["alarm"]
            low, high = announced["leak_interval_lpm"]
            assert low <= alarm["leak_lpm"] <= high
            assert alarm["leak_interval_lpm"][0] <= announced["leak_lpm"] <= alarm["leak_interval_lpm"][1]
    assert n_alarms > 50
    assert n_updates <= 0.2 * n_alarms
    service.close()


def test_a_leak_that_leaves_its_stated_interval_is_stated_anew():
    """For any course of leaks and intervals, what was announced and what is known lie within each other's interval."""
    random = np.random.default_rng(5)
    for _ in range(50):
        judge, kinds = AlarmJudge("press"), []
        judge.update_from_verdict(verdict("leak", chance=None), None, 1, WatchSettings())
        event = "raised"
        for _ in range(30):
            leak = float(10.0 ** random.uniform(-2.0, 0.0))
            interval = (leak * random.uniform(0.3, 1.0), leak * random.uniform(1.0, 3.0))
            alarm, event = judge.restate_leak(judge.alarm, event, leak, interval)
            kinds.append(event)
            assert (alarm.leak_lpm, alarm.leak_interval_lpm) == (leak, interval) == (judge.alarm.leak_lpm, interval)
            low, high = judge.announced_interval_lpm
            assert low <= leak <= high
            assert interval[0] <= judge.announced_lpm <= interval[1]
            event = ""
        assert {"raised", "updated", ""} >= {*kinds} and "updated" in kinds
        alarm, event = judge.restate_leak(judge.alarm, "", None, None)  # no other leak is known
        assert (alarm.leak_lpm, event) == (leak, "")
