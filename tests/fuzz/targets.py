"""What is fuzzed beside recordings: for each kind of input, a function that draws a hostile one and uses it.

A use returns whether the input was taken. It raises whatever escapes the errors of the house, and AssertionError where
a message is more than a line.
"""

from __future__ import annotations

import json
import os
import random
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from hashlib import sha256
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

import sealscope
from sealscope.campaigns.cases.case import CampaignCase, list_cases
from sealscope.campaigns.cases.recordings import judge_recordings
from sealscope.campaigns.cases.row import CaseRow
from sealscope.campaigns.execution import store
from sealscope.campaigns.execution.run import run
from sealscope.campaigns.plans.model import RecordedPlan, SimulatedPlan
from sealscope.campaigns.plans.reader import load_plan, plan_names
from sealscope.campaigns.results import judge_simulated_campaign, write_result
from sealscope.diagnosis.commissioned.machine import JudgedAlarm
from sealscope.errors import SealscopeError
from sealscope.parameters import load_rig, parse_overrides, rig_names
from sealscope.recordings import split_map_option
from sealscope.recordings.formats.columns import Label, Request, check_request, choose_columns
from sealscope.reporting.campaign.page import PAGE, campaign_text, write_campaign_page
from sealscope.simulation.bench.profile import load_profile
from sealscope.simulation.commands import parse_command
from sealscope.simulation.experiment import Experiment
from sealscope.simulation.faults import parse_fault
from sealscope.simulation.leaks import parse_leak
from sealscope.storage.plain_state import plain_array, restore_array
from sealscope.storage.plain_values import convert_type
from sealscope.storage.rows import LOCK, ROWS, read_rows, store_rows
from sealscope.thesis.engine.build import ItemRow
from sealscope.thesis.engine.products import Claim, Figure, Number, ThesisTable
from sealscope.units import parse_quantity, parse_unit

from .mutations import change_tree, changed_bytes, changed_option, changed_toml, nodes

#: Draws a hostile input and uses it; whether it was taken.
Use = Callable[[random.Random], bool]
_SOURCES = Path(sealscope.__file__).parent


def taken(work: Callable[[], object]) -> bool:
    """Whether the work ends well; False for an error of the house, which must be one line that can be printed."""
    try:
        work()
    except SealscopeError as error:
        assert "\n" not in str(error), str(error)[:300]
        assert 0 < len(str(error)) < 5000, str(error)[:300]
        return False
    return True


COMMANDS = (
    "3 sin(4t)",
    "3 sin(4t + 0.5) - 1",
    "6 periods of 5 sin(2t), 10 periods of 3 sin(4t)",
    "step 5 at 1 s",
    "ramp 5 from 1 s to 3 s",
    "chirp 3 from 0.1 Hz to 5 Hz over 60 s",
    "prbs 2 every 0.5 s seed 1",
)
LEAKS = (
    "0.0042 L/min from 90 s",
    "0.01[L/min] orifice growing from 1 min to 2 min",
    "G = 6.1e-13 from 90 s",
    "C = 2e-10",
)
FAULTS = (
    "pump leak x3 from 90 s",
    "pump leak G = 5e-13",
    "rod seal A 0.01 L/min from 90 s",
    "friction +20 % growing from 60 s to 120 s",
    "air 1 % from 90 s",
    "sensor p_A offset 2 psi from 90 s",
    "sensor p_A gain -1 %",
    "sensor p_A stuck from 90 s to 100 s",
    "duty amplitude x1.5 frequency x0.8 from 90 s",
)
SIZES = ("3 min", "180", "500 Hz", "20[Pa]", "1e-5 s", "2[L/min]", "0.8[ohm]", "50 %", "3 psi")
UNITS = ("Pa", "m^3/(s Pa)", "N m/A", "cm3/rev", "rad/s/V", "kelvin", "bar(a)", "N/(m m)", "µm", "BTU/(ft*h)")
FORMULAS = ("p_A=PG_1*0.0625-0.625 bar", "x=0.5*(#4 - `Pos`/2) mm")
MAPS = ("p_A=PG_1[psi]", "p_B=#3", "x=#4[mm]", "t=Time", "p_A=p (port A)[bar]", *FORMULAS)
SETS = ("V_1=50[cm^3]", "orifices=present", "sensors.p_A.noise=1[psi]", "K_oil=689 MPa", "sample_rate=1 kHz")
LABELS = ("Time", "PG_1", "PG_2 [psi]", "Pos", "p (port A)")
T = np.linspace(0.0, 10.0, 50)


def _command(text: str) -> None:
    command = parse_command(text)
    command.volts(T)
    assert str(parse_command(str(command))) == str(command)


def _leak(text: str) -> None:
    leak = parse_leak(text)
    if leak is not None:
        leak.opening.value_at(T)
        str(leak)


def _fault(text: str) -> None:
    fault = parse_fault(text)
    if fault is not None:
        with np.errstate(all="ignore"):
            fault.change_command(parse_command("3 sin(4t)")).volts(T)
        fault.effects(load_rig("thesis"))
        str(fault)


def _columns(text: str) -> None:
    channel, column = split_map_option(text)
    check_request({channel: column}, None)
    choose_columns([Label.parse(text) for text in LABELS], Request({channel: column}, 500.0))


def _experiment(key: str, text: str) -> None:
    Experiment.of(**{"duration": "2 s", key: text})


def _quantity(text: str) -> None:
    for unit in ("s", "Pa", "m^3/s", "rad", "K", "1"):
        taken(lambda unit=unit: parse_quantity(text, unit))


OPTIONS: dict[str, tuple[tuple[str, ...], Callable[[str], object]]] = {
    "command": (COMMANDS, _command),
    "leak": (LEAKS, _leak),
    "fault": (FAULTS, _fault),
    "quantity": (SIZES, _quantity),
    "unit": (UNITS, parse_unit),
    "map": (MAPS, _columns),
    "set": (SETS, lambda text: load_rig("thesis").with_overrides(parse_overrides([text]))),
    "heading": (("p_A [psi]", "p / bar", "p (N/(m m))"), Label.parse),
    **{key: (SIZES, partial(_experiment, key)) for key in ("duration", "rate", "step", "error", "x_0")},
}


def options(folder: Path) -> Use:
    """Texts of options; they name files of the folder only."""
    os.chdir(folder)

    def use(draw: random.Random) -> bool:
        texts, work = OPTIONS[draw.choice(list(OPTIONS))]
        text = changed_option(draw.choice(texts), draw)
        if text.lower().strip().startswith(("file ", "table ")):
            text = f"{text[:5]} none"
        return taken(lambda: work(text))

    return use


def _toml(texts: list[str], read: Callable[[Path], object], folder: Path) -> Use:
    path = folder / "given.toml"

    def use(draw: random.Random) -> bool:
        path.write_bytes(changed_toml(draw.choice(texts), draw))
        return taken(lambda: read(path))

    return use


def rigs(folder: Path) -> Use:
    """Rigs as TOML files, whole and as extensions of another."""
    whole = [(_SOURCES / "parameters" / "rigs" / f"{name}.toml").read_text() for name in rig_names()]
    small = (
        '[rig]\nname = "mine"\nextends = "thesis"\n[motor]\nR_c = { value = 0.8, unit = "ohm", source = "measured" }\n'
        '[line.orifices]\nvalue = "present"\nsource = "seen"\n'
    )

    def read(path: Path) -> None:
        rig = load_rig(path)
        rig.table()
        json.dumps(rig.as_dict())
        Experiment.of(rig=rig, duration=1.0)

    return _toml([*whole, small, small], read, folder)


_NAN = re.compile(r"\b(nan|inf)\b", re.IGNORECASE)


def altered(taught: bytes, draw: random.Random) -> tuple[bytes, dict[str, str]]:
    """A file of healthy summaries with one of them changed, and the checksums that changed: those before and after."""
    head, *rows = taught.splitlines(keepends=True)
    at = draw.randrange(len(rows))
    before, _, data = rows[at].strip().partition(b" ")
    tree = json.loads(data)
    if draw.random() < 0.5:
        change_tree(tree, draw)
    else:
        arrays = [
            value for value, _ in nodes({"": tree}) if isinstance(value, dict) and value.keys() == {"shape", "f8"}
        ]
        place = draw.choice(arrays)
        values = restore_array(place, "drawn").ravel().copy()
        chosen = slice(None) if draw.random() < 0.5 else draw.randrange(len(values))
        values[chosen] = (
            draw.choice((0.0, -1.0, 1e300, 1e99, np.nan, np.inf, 1e-300))
            if draw.random() < 0.5
            else (values[chosen] * draw.choice((0.0, -1.0, 1e-12, 1e3, 1e30, 1e-200)))
        )
        place["f8"] = plain_array(values)["f8"]
    data = json.dumps(tree).encode()
    after = sha256(data).hexdigest()
    rows[at] = b"%b %b\n" % (after.encode(), data)
    return head + b"".join(rows), {before.decode(): after}


def machines(folder: Path) -> Use:
    """Files of a commissioned machine, changed, or links to folders and pipes; one that is taken judges a recording.

    Its summaries are changed in their bytes, or in their values with the right checksums.
    """
    healthy, path, summaries = folder / "healthy", folder / "given.toml", folder / "given.healthy"
    healthy.mkdir()
    for seed in (1, 2, 3):
        sealscope.write(sealscope.simulate(duration="6 s", seed=seed), healthy / f"run{seed}.nc")
    whole = sealscope.commission(healthy, rig="thesis", limit="5 mL/min")
    alarms = (JudgedAlarm("press 1-1", "valid", 1.7e9, 1.69e9, 0.002), JudgedAlarm("press 1-2", "invalid", 1e9, 1e9))
    bare = replace(whole, rig=None, channel_map={"p_A": "PG_1[bar]"}, alarms=alarms)
    texts = [sealscope.write_machine(own, folder / "whole.toml").read_text() for own in (whole, bare)]
    judged, taught = sealscope.simulate(duration="6 s", seed=4), (folder / "whole.healthy").read_bytes()

    def read() -> None:
        machine = sealscope.read_machine(path)
        texts = [machine.diagnose(judged).reason, str(machine)]
        assert not any(_NAN.search(text) for text in texts), texts
        again = sealscope.read_machine(sealscope.write_machine(machine, folder / "again.toml"))
        assert [own.digest for own in again.healthy] == [own.digest for own in machine.healthy]

    def use(draw: random.Random) -> bool:
        path.unlink(missing_ok=True)
        summaries.write_bytes(taught)
        match draw.randrange(20):
            case 0:
                path.symlink_to(draw.choice((healthy, path)))
            case 1:
                os.mkfifo(path)
            case _:
                text = draw.choice(texts)
                if draw.random() < 0.6:
                    data, checksums = (
                        (changed_bytes(taught, draw), {}) if draw.random() < 0.2 else altered(taught, draw)
                    )
                    summaries.write_bytes(data)
                    for before, after in checksums.items():
                        text = text.replace(before, after)
                path.write_bytes(changed_toml(text, draw) if draw.random() < 0.6 else text.encode())
        with np.errstate(all="ignore"):
            return taken(read)

    return use


def profiles(folder: Path) -> Use:
    """Profiles of nuisances as TOML files; a machine of one is drawn."""
    from sealscope.simulation.bench.machines import draw as draw_machine

    places = sorted((_SOURCES / "simulation" / "bench" / "profiles").glob("*.toml"))

    def read(path: Path) -> None:
        profile = load_profile(path)
        for seed in range(3):
            draw_machine(profile, seed, duration=2.0)

    return _toml([place.read_text() for place in places], read, folder)


def plans(folder: Path) -> Use:
    """Plans of all three kinds as TOML files."""
    empty = folder / "empty"
    empty.mkdir()
    places = [_SOURCES / "campaigns" / "plans" / "packaged" / f"{name}.toml" for name in plan_names()]

    def read(path: Path) -> None:
        plan = load_plan(path)
        if isinstance(plan, SimulatedPlan) and plan.size <= 3000:
            store.collect_row_inputs(plan)
            list_cases(plan)
        if isinstance(plan, RecordedPlan):
            taken(lambda: judge_recordings(plan, empty))

    return _toml([place.read_text() for place in places], read, folder)


PLAN = """
[campaign]
name = "tiny"
duration = "6 s"
onset = "3 s"
false_alarm = 0.2
seed = 3
detectors = ["d3 of p_A changed", "rms change"]

[[records]]
use = "calibrate"
count = 6

[[records]]
count = 3

[[records]]
leak = "0.015 L/min"
count = 3
"""


def _unmade(plan: SimulatedPlan, case: CampaignCase, folder: Path | None) -> CaseRow:
    return CaseRow.from_case(case, error="not carried out")


def campaigns(folder: Path) -> Use:
    """Folders of a campaign: rows, head, lock and the results beside them, changed, replaced or linked."""
    plan_file, whole, given, outside = (folder / name for name in ("plan.toml", "whole", "given", "outside"))
    plan_file.write_text(PLAN)
    plan = load_plan(plan_file)
    assert isinstance(plan, SimulatedPlan)
    assert run(plan, whole, jobs=1).failed == 0
    write_result(judge_simulated_campaign(plan, whole), whole)
    outside.mkdir()
    (outside / "diary.txt").write_text("kept\n")
    names = [ROWS, ROWS, ROWS, store.HEAD, LOCK]

    def change(draw: random.Random) -> None:
        name = draw.choice(names)
        path = given / name
        data = path.read_bytes() if path.is_file() else b"\n"
        match draw.randrange(8):
            case 0:
                path.unlink(missing_ok=True)
                path.symlink_to(outside / draw.choice(("diary.txt", "new.txt")))
            case 1:
                path.unlink(missing_ok=True)
                path.mkdir() if draw.random() < 0.5 else os.mkfifo(path)
            case 2 | 3:
                path.write_bytes(changed_bytes(data or b"\n", draw))
            case _:
                lines = data.splitlines() if name == ROWS else [data]
                at = draw.randrange(len(lines)) if lines else 0
                try:
                    tree = json.loads(lines[at])
                except (ValueError, IndexError):
                    return
                change_tree(tree, draw)
                lines[at] = json.dumps(tree).encode()
                path.write_bytes(b"\n".join(lines) + b"\n" * (draw.random() < 0.9))

    def work() -> None:
        store.read_progress(plan, given)
        with mock.patch("sealscope.campaigns.execution.run.run_case", _unmade):
            run(plan, given, jobs=1)
        result = judge_simulated_campaign(plan, given)
        write_result(result, given)
        campaign_text(result)
        write_campaign_page(result, given / PAGE, [])

    def use(draw: random.Random) -> bool:
        shutil.rmtree(given, ignore_errors=True)
        shutil.copytree(whole, given)
        change(draw)
        done = taken(work)
        assert [path.name for path in outside.iterdir()] == ["diary.txt"]
        assert (outside / "diary.txt").read_text() == "kept\n"
        return done

    return use


def _products() -> tuple[Any, ...]:
    return (
        Figure("fig-1", "A figure", (), (Number("n", 1.0, "s"),), resolved=True),
        ThesisTable("tab-1", "A table", ("a", "b"), ((1, "x"), (None, 2.5))),
        Claim("c-1", "p. 1", "a claim", "sheet", "simulation", "holds", "why"),
    )


def kept(folder: Path) -> Use:
    """The rows of a reproduction, changed in their bytes or in their structure."""
    row = ItemRow("fig-1", "k", _products(), ("figures/a.svg",))
    list(store_rows(folder, (of for of in [row]), "a reproduction"))
    path = folder / ROWS
    whole = path.read_bytes()

    def use(draw: random.Random) -> bool:
        if draw.random() < 0.5:
            path.write_bytes(changed_bytes(whole, draw))
        else:
            tree = json.loads(whole)
            change_tree(tree, draw)
            path.write_text(json.dumps(tree) + "\n")
        return taken(lambda: read_rows(folder, lambda tree: convert_type(ItemRow, tree), "a reproduction", json.loads))

    return use


#: Name -> what makes the use of inputs of that kind, given a folder of its own.
TARGETS: dict[str, Callable[[Path], Use]] = {
    "options": options,
    "rigs": rigs,
    "machines": machines,
    "profiles": profiles,
    "plans": plans,
    "campaign folders": campaigns,
    "kept files": kept,
}
