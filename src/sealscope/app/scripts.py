"""The commands and the lines of Python that do what a screen of the workbench does, to be copied."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from sealscope.app.session import HOLD_FIELDS, REPORTS, SessionMachine
from sealscope.app.workbench import Workbench
from sealscope.recordings.formats.columns import GROUP, REST, find_missing_entries
from sealscope.recordings.formats.headings.labels import Label

_IMPORT = "import sealscope as ss"
#: Functions in the lines of Python that are not of `sealscope` itself, and their packages.
_PACKAGES = {
    "build_stated_rig": "sealscope.diagnosis.verdict.machine_sizes",
    "check_channels": "sealscope.diagnosis.channel_checks",
    "hold_text": "sealscope.reporting.hold",
    "trend_text": "sealscope.reporting.trend.text",
}


def write_script(workbench: Workbench, screen: str, name: str, key: str) -> dict[str, str]:
    """Write the command and the Python lines of a screen, for a machine and a log if they are chosen.

    `screen`: "logs", "channels", "healthy", "verdict", "trend" or "hold". Both run in the folder of the session.
    """
    session = workbench.folder.read()
    machine = next((m for m in session.machine if m.name == name), SessionMachine(name="machine"))
    paths = {log: workbench.folder.path_of(log) for log in workbench.folder.list_keys()[0]}
    chosen = [paths[key]] if key in paths else list(paths.values())[:1]
    if key in paths and (screen in ("hold", "channels") or not machine.commissioned):
        machine = _fit_map(workbench, machine, key)
    if screen == "healthy":
        files = [path for log, path in paths.items() if log in machine.healthy]
        target = f"{machine.name}.toml"
        command: list[str | Path] = ["sealscope", "commission", *files, *_options(machine), "-o", target]
        python = [
            f"machine = ss.commission({_list(workbench, files)}, {_keywords(machine)}name={machine.name!r})",
            f"ss.write_machine(machine, {target!r})",
            "print(machine)",
        ]
    elif screen == "verdict":
        judged = [paths[v.file] for v in machine.verdicts if v.file in paths] or chosen
        judged = chosen if key in paths else judged
        if machine.commissioned:
            command = ["sealscope", "diagnose", *judged, "--machine", f"{machine.name}.toml"]
            read = [
                f"machine = ss.read_machine({machine.name + '.toml'!r})",
                f"for file in {_list(workbench, judged)}:",
            ]
            python = [*read, "    print(machine.diagnose(file))"]
        else:
            command = ["sealscope", "diagnose", *judged, *_options(machine)]
            rig = f"rig={_rig(machine)}, " if _rig(machine) else ""
            limit = f"limit={machine.limit!r}, " if machine.limit else ""
            python = [
                f"for file in {_list(workbench, judged)}:",
                f"    recording = ss.read(file, map={machine.channel_map!r}{_rate(machine)})",
                f"    print(ss.diagnose(recording, {rig}{limit}file=file))",
            ]
    elif screen == "trend":
        used = {*machine.healthy, *machine.suspect, *(v.file for v in machine.verdicts)} - {*machine.rejected}
        files = [path for log, path in paths.items() if log in used] or chosen
        if machine.commissioned:
            command = ["sealscope", "trend", *files, "--machine", f"{machine.name}.toml"]
        else:
            command = ["sealscope", "trend", *files, *_options(machine), "--healthy", str(max(1, len(machine.healthy)))]
        rig = f"rig={_rig(machine)}, " if _rig(machine) else ""
        limit = f", limit={machine.limit!r}" if machine.limit else ""
        reading = f"ss.read(file, map={machine.channel_map!r}{_rate(machine)})"
        python = [
            f"days = [{reading} for file in {_list(workbench, files)}]",
            f"print(trend_text(ss.trend(days, {rig}healthy={max(1, len(machine.healthy))}{limit})))",
        ]
    elif screen == "hold":
        areas = [text for area in machine.area for text in ("--area", area)]
        stated = [text for name, value in machine.hold.items() for text in (HOLD_FIELDS[name], value)]
        is_log = not machine.hold.get("collected") or key in paths
        command = ["sealscope", "hold", *(chosen if is_log else []), *(_map_options(machine) if is_log else [])]
        command += [*areas, *stated]
        settings = "".join(f", {name}={value!r}" for name, value in machine.hold.items())
        area = f"area={list(machine.area)!r}" if machine.area else "area=None"
        python = [
            f"for file in {_list(workbench, chosen)}:",
            f"    recording = ss.read(file, map={machine.channel_map!r}{_rate(machine)})",
            f"    print(*map(hold_text, ss.hold_test(recording, {area}{settings}, file=file)), sep='\\n')",
        ]
        if not is_log:
            python = [f"print(*map(hold_text, ss.hold_test({area}{settings})), sep='\\n')"]
    elif screen == "channels":
        command = ["sealscope", "inspect", *chosen, *_map_options(machine)]
        rig = f", {_rig(machine)}" if _rig(machine) else ""
        python = [
            f"for file in {_list(workbench, chosen)}:",
            f"    recording = ss.read(file, map={machine.channel_map!r}{_rate(machine)})",
            "    print(recording, *ss.inspect(recording), sep='\\n')",
            f"    print(*(check.text for check in check_channels(recording{rig})), sep='\\n')",
        ]
    else:
        mended = [log for log in session.mended if log.file == key]
        command = ["sealscope", "inspect", *chosen]
        python = [f"for file in {_list(workbench, chosen)}:", "    print(ss.read(file, map='auto'))"]
        if mended:
            values = {n: v for n, v in vars(mended[0]).items() if n not in ("file", "target") and v is not None}
            options = [str(text) for n, v in values.items() for text in (f"--{n.replace('_', '-')}", v)]
            command = ["sealscope", "mend", mended[0].file, mended[0].target, *options]
            arguments = "".join(f", {n}={v!r}" for n, v in values.items())
            python = [
                "from sealscope.recordings import mend",
                f"mend({mended[0].file!r}, {mended[0].target!r}{arguments})",
            ]
    words = [_short(workbench, word) if isinstance(word, Path) else str(word) for word in command]
    helpers = [name for name in _PACKAGES if any(name in line for line in python)]
    imports = [_IMPORT, *(f"from {_PACKAGES[name]} import {name}" for name in helpers)]
    lines = "\n".join([*imports, *python])
    return {"command": shlex.join(words), "python": lines, "folder": str(workbench.folder.folder)}


def _fit_map(workbench: Workbench, machine: SessionMachine, key: str) -> SessionMachine:
    """Leave the entries out of a machine's map whose columns a log lacks, as its reading does (`read_by_map`)."""
    labels = [Label.parse(name) for name in workbench.table("columns", key, stated_time="").names]
    entries = {name: text for name, text in machine.map.items() if name not in (GROUP, REST, "t")}
    missing = set(find_missing_entries(entries, labels)) if labels else set[str]()
    return replace(machine, map={name: text for name, text in machine.map.items() if name not in missing})


def write_watch(workbench: Workbench, name: str, folder: str) -> str:
    """Write the settings with which `sealscope monitor` watches a folder for a commissioned machine; return the file.

    Raises InputError if the machine is not commissioned, or there are settings already.
    """
    from sealscope.errors import InputError
    from sealscope.monitor.settings import read_settings
    from sealscope.storage.atomic import atomic_write
    from sealscope.storage.toml_file import format_tables

    machine = workbench.folder.read().find_machine(name)
    if not machine.commissioned:
        raise InputError("a machine must be commissioned before a folder is watched for it")
    place = workbench.folder.folder / folder
    if not place.is_dir():
        raise InputError(f"a folder to watch must exist, got none there ({place})")
    target = workbench.folder.folder / f"monitor {name}.toml"
    tree: dict[str, Any] = {"database": f"monitor {name}.db"}
    tree["actuator"] = [{"name": name, "machine": f"{name}.toml", "folder": folder}]
    with atomic_write(target) as temporary:
        temporary.write_text("# Settings of `sealscope monitor`.\n" + "\n".join(format_tables(tree)) + "\n", "utf-8")
        read_settings(temporary)
    return target.name


def write_report_command(workbench: Workbench, name: str, key: str) -> str:
    """Write the command that writes the page of a verdict."""
    machine = workbench.folder.read().find_machine(name)
    path = workbench.find_log(key)
    options = ["--machine", f"{name}.toml"] if machine.commissioned else _options(machine)
    return shlex.join(["sealscope", "report", _short(workbench, path), *options, "-o", f"{REPORTS}/{path.stem}.html"])


def _short(workbench: Workbench, path: Path) -> str:
    text = workbench.folder.key_of(path)
    return f"./{text}" if text.startswith("-") else text


def _list(workbench: Workbench, paths: Sequence[Path]) -> str:
    return repr([_short(workbench, path) for path in paths])


def _map_options(machine: SessionMachine) -> list[str]:
    columns = machine.channel_map
    if isinstance(columns, str):
        options = ["--map", columns]
    else:
        options = [text for channel, column in columns.items() for text in _map_words(channel, column)]
    return [*options, *(["--rate", f"{machine.rate:g}"] if machine.rate else [])]


def _map_words(channel: str, column: str) -> tuple[str, str]:
    """Return an entry of a map as an option of the command line."""
    if channel == GROUP:
        return "--group", column
    return "--map", column if channel == REST else f"{channel}={column}"


def _options(machine: SessionMachine) -> list[str]:
    """List the options of the command line that state a machine."""
    options = _map_options(machine)
    for option, values in (
        ("--rig", [machine.rig]),
        ("--area", machine.area),
        ("--displacement", [machine.displacement]),
        ("--limit", [machine.limit]),
    ):
        options += [text for value in values if value for text in (option, value)]
    return options


def _rate(machine: SessionMachine) -> str:
    return f", rate={machine.rate!r}" if machine.rate else ""


def _rig(machine: SessionMachine) -> str:
    """Write the expression that builds the rig that is stated of a machine, "" if nothing is."""
    if not machine.area and not machine.displacement:
        return repr(machine.rig) if machine.rig else ""
    arguments = f"{machine.rig!r}, {list(machine.area)!r}, {machine.displacement!r}"
    return f"build_stated_rig({arguments})"


def _keywords(machine: SessionMachine) -> str:
    """Write the keywords of `commission` that state a machine."""
    rig = _rig(machine)
    words = [f"rig={rig}"] if rig else []
    words.append(f"map={machine.channel_map!r}")
    words += [f"rate={machine.rate!r}"] if machine.rate else []
    words += [f"limit={machine.limit!r}"] if machine.limit else []
    return ", ".join(words) + ", "
