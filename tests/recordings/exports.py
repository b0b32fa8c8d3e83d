"""Logs as data bases, controllers and instruments export them: JSON, long tables, a clock each, cells with units."""

from __future__ import annotations

import datetime as dt
import json
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

from .dialects import P_A, P_B, RATE, SIGNALS, Dialect, T, Writer, X, log, moments

A, B, POSITION, TIMES = P_A.tolist(), P_B.tolist(), X.tolist(), T.tolist()
NAMED = {"t [s]": TIMES, "p_A [bar]": A, "p_B [bar]": B, "x [mm]": POSITION}
RECORDS = [dict(zip(NAMED, row, strict=True)) for row in zip(*NAMED.values(), strict=True)]


def text(content: str, name: str = "log.csv", encoding: str = "utf-8") -> Writer:
    """Return what writes this text."""

    def write(folder: Path) -> Path:
        (folder / name).write_bytes(content.encode(encoding))
        return folder / name

    return write


def lines(values: Any, **form: Any) -> Writer:
    """Return what writes a JSON value a line."""
    return text("".join(json.dumps(value) + "\n" for value in values), "log.jsonl", **form)


def document(value: Any, **form: Any) -> Writer:
    """Return what writes one JSON document."""
    return text(json.dumps(value, **form), "log.json")


def pandas_json(orient: str, indexed: bool = False, **form: Any) -> Writer:
    """Return what writes a data frame as pandas writes JSON."""

    def write(folder: Path) -> Path:
        import pandas as pd

        frame = pd.DataFrame(NAMED)
        frame = frame.set_index("t [s]") if indexed else frame
        frame.to_json(folder / "log.json", orient=orient, double_precision=15, **form)  # type: ignore[call-overload]
        return folder / "log.json"

    return write


def stamp(seconds: float) -> str:
    return f"2024-05-31T23:59:{59 + seconds:09.6f}Z" if seconds < 1 else f"2024-06-01T00:00:{seconds - 1:09.6f}Z"


ROWS = [list(row) for row in zip(TIMES, A, B, POSITION, strict=True)]
JSONS: dict[str, Dialect] = {
    "JSON lines": Dialect(lines(RECORDS)),
    "JSON lines, UTF-8 with a mark": Dialect(lines(RECORDS, encoding="utf-8-sig")),
    "JSON lines, UTF-16": Dialect(lines(RECORDS, encoding="utf-16")),
    "JSON lines, moments": Dialect(
        lines({"time": stamp(t), "p_A [bar]": a, "p_B [bar]": b, "x [mm]": x} for t, a, b, x in ROWS)
    ),
    "JSON lines, numbers as texts": Dialect(lines({name: repr(cell) for name, cell in row.items()} for row in RECORDS)),
    "JSON lines, names in names": Dialect(
        lines({"timestamp": t, "values": {"p_A [bar]": a, "p_B [bar]": b, "x [mm]": x}} for t, a, b, x in ROWS)
    ),
    "JSON lines, value and unit": Dialect(
        lines(
            {
                "t": t,
                "p_A": {"value": a, "unit": "bar"},
                "p_B": {"value": b, "unit": "bar"},
                "x": {"value": x, "unit": "mm"},
            }
            for t, a, b, x in ROWS
        )
    ),
    "JSON lines, units as suffixes": Dialect(
        lines({"time_s": t, "PA_bar": a, "PB_bar": b, "Weg_mm": x} for t, a, b, x in ROWS), {"map": "auto"}
    ),
    "JSON lines, rows under names": Dialect(lines([list(NAMED), *ROWS])),
    "JSON lines, rows": Dialect(
        lines(ROWS), {"map": {"t": "#1[s]", "p_A": "#2[bar]", "p_B": "#3[bar]", "x": "#4[mm]"}}
    ),
    "JSON lines, a sample each": Dialect(
        lines(
            {"ts": 1717199999900 + 1e3 * t, "name": name, "value": value, "unit": unit}
            for t, a, b, x in ROWS
            for name, value, unit in (("p_A", a, "bar"), ("p_B", b, "bar"), ("x", x, "mm"))
        )
    ),
    "JSON lines, a sample each with its moment": Dialect(
        lines(
            {"topic": f"{name} [{unit}]", "timestamp": stamp(t), "value": repr(value)}
            for t, a, b, x in ROWS
            for name, value, unit in (("p_A", a, "bar"), ("p_B", b, "bar"), ("x", x, "mm"))
        )
    ),
    "JSON lines, blocks": Dialect(
        lines({name: cells[begin : begin + 50] for name, cells in NAMED.items()} for begin in range(0, 200, 50))
    ),
    "JSON lines, vectors": Dialect(
        lines({"t": t, "p": [a, b], "x": x} for t, a, b, x in ROWS),
        {"map": {"p_A": "p(1)[bar]", "p_B": "p(2)[bar]", "x": "x[mm]"}},
    ),
    "JSON, records": Dialect(document(RECORDS)),
    "JSON, records on lines": Dialect(document(RECORDS, indent=2)),
    "JSON, rows under names": Dialect(document([list(NAMED), *ROWS])),
    "JSON, columns": Dialect(document(NAMED)),
    "JSON, columns and a rate": Dialect(
        document({"sample_rate": RATE, **{name: cells for name, cells in NAMED.items() if name != "t [s]"}})
    ),
    "JSON, columns and units": Dialect(
        document(
            {"t": TIMES, "p_A": A, "p_B": B, "x": POSITION, "units": {"t": "s", "p_A": "bar", "p_B": "bar", "x": "mm"}}
        )
    ),
    "JSON, columns beside the time": Dialect(
        document({"time": TIMES, "data": {name: cells for name, cells in NAMED.items() if name != "t [s]"}})
    ),
    "JSON, wrapped records": Dialect(document({"meta": {"operator": "N. N."}, "data": RECORDS})),
    "JSON, signals": Dialect(
        document({name: {"unit": unit, "time": TIMES, "values": values.tolist()} for name, values, unit in SIGNALS})
    ),
    "JSON, array of signals": Dialect(
        document(
            {
                "dt": 1 / RATE,
                "channels": [{"name": name, "unit": unit, "data": values.tolist()} for name, values, unit in SIGNALS],
            }
        )
    ),
    **{f"JSON, pandas {orient}": Dialect(pandas_json(orient)) for orient in ("records", "split")},
    "JSON, pandas lines": Dialect(pandas_json("records", lines=True)),
    "JSON, pandas table": Dialect(pandas_json("table", True)),
}


def table(names: str, times: Iterable[str], join: str = ",", above: str = "", **form: Any) -> Writer:
    """Return what writes `names` of the time and the channels, and the samples under them."""
    head = join.join([*names.split(","), "p_A [bar]", "p_B [bar]", "x [mm]"])
    return log(f"{above}{head}\n", [join.join(time.split(",")) for time in times], join=join, **form)


MIDNIGHT = moments(2024, 5, 31, 23, 59, 59, 900000)
MS = [(moment, moment.microsecond // 1000) for moment in MIDNIGHT]
CLOCKS: dict[str, Dialect] = {
    "time, date and clock and ms": Dialect(table("Date,Time,ms", (f"{m:%d.%m.%Y,%H:%M:%S},{ms}" for m, ms in MS))),
    "time, stamp and ms": Dialect(table("Date&Time,ms", (f"{m:%Y-%m-%d %H:%M:%S},{ms}" for m, ms in MS))),
    "time, minutes and seconds": Dialect(table("Time", (f"{m.minute}:{m:%S}.{ms:03d}" for m, ms in MS))),
    "time, clock and ms": Dialect(table("Uhrzeit,Millisekunden", (f"{m:%H:%M:%S},{ms}" for m, ms in MS))),
    "time, American date, clock and Millitm": Dialect(
        table("Date,Time,Millitm", (f"{m:%m/%d/%Y,%I:%M:%S %p},{ms}" for m, ms in MS))
    ),
    "time, date and us": Dialect(table("Datum,us", (f"{m:%d.%m.%Y %H:%M:%S},{m.microsecond}" for m in MIDNIGHT))),
    "time, ms and us": Dialect(table("Time,ms,us", (f"{m:%H:%M:%S},{ms},{m.microsecond % 1000}" for m, ms in MS))),
    "time, seconds and ms": Dialect(
        table("time,msec", (f"{int(t + 0.3)},{round(1e3 * (t + 0.3)) % 1000}" for t in TIMES))
    ),
    "time, seconds since 1970 and us": Dialect(
        table("timestamp,usec", (f"{1717199999 + int(t + 0.9)},{round(1e6 * (t + 0.9)) % 1000000}" for t in TIMES)),
    ),
    "time, h and m and s": Dialect(
        table("h,m,s", (f"{m.hour},{m.minute},{m.second + m.microsecond / 1e6}" for m in MIDNIGHT))
    ),
    "time, hour, minute, second, ms": Dialect(
        table("Hour,Minute,Second,Millisecond", (f"{m.hour},{m.minute},{m.second},{ms}" for m, ms in MS))
    ),
    "time, date and hours, minutes, seconds": Dialect(
        table("Date,Hours,Minutes,Seconds", (f"{m:%Y-%m-%d},{m.hour},{m.minute},{m:%S.%f}" for m in MIDNIGHT))
    ),
    "time, year to second": Dialect(
        table("Year,Month,Day,Hour,Minute,Second", (f"{m:%Y,%m,%d,%H,%M,%S.%f}" for m in MIDNIGHT))
    ),
    "time, German columns": Dialect(
        table("Stunde,Minute,Sekunde", (f"{m:%H,%M,%S}.{ms:03d}" for m, ms in MS), join=";", comma=True)
    ),
    "time, a date with the time in it": Dialect(table("Datum", (f"{m:%d.%m.%Y %H:%M:%S}.{ms:03d}" for m, ms in MS))),
}


def long(head: str, row: Callable[[str, str, float, float], str], **form: Any) -> Writer:
    """Return what writes a row a sample; `row`: makes it of name, unit, time and value."""
    cells = [(name, unit, t, value) for k, t in enumerate(TIMES) for name, unit, value in samples(k)]
    return text("\n".join([head, *(row(*cell) for cell in cells)]) + "\n", **form)


def samples(k: int) -> list[tuple[str, str, float]]:
    return [("p_A", "bar", A[k]), ("p_B", "bar", B[k]), ("x", "mm", POSITION[k])]


def wincc(name: str, unit: str, t: float, value: float) -> str:
    """Write a row as WinCC's panels log: the moment as text, and in millionths of a day since 1899-12-30."""
    moment = MIDNIGHT[0] + dt.timedelta(seconds=t)
    days = ((moment - dt.datetime(1899, 12, 30)) / dt.timedelta(days=1)) * 1e6
    return f'"{name}";"{moment:%d.%m.%Y %H:%M:%S}";{value:.6f};1;{days:.6f}'.replace(".", ",").replace(",", ".", 2)


def influx(head: str, annotations: bool, tables: bool) -> Writer:
    """Write annotated CSV as InfluxDB's query API does: the samples of a series under each other."""
    notes = "#group,false,false,true,true,false,false,true,true,true\n#datatype,string,long,dateTime:RFC3339,"
    notes += "dateTime:RFC3339,dateTime:RFC3339,double,string,string,string\n#default,_result,,,,,,,,\n"
    above = (notes if annotations else "") + head + "\n"
    parts = []
    for number, (name, values, _) in enumerate(SIGNALS):
        parts.append(
            "".join(
                f",,{number},2024-05-31T00:00:00Z,2024-06-02T00:00:00Z,{stamp(t)},{value!r},{name},rig,3\n"
                for t, value in zip(TIMES, values.tolist(), strict=True)
            )
        )
    return text(above + (f"\n{above}" if tables else "").join(parts))


MAPPED = {"map": {"p_A": "p_A[bar]", "p_B": "p_B[bar]", "x": "x[mm]"}}
INFLUX = ",result,table,_start,_stop,_time,_value,_field,_measurement,host"
LONG: dict[str, Dialect] = {
    "long, WinCC": Dialect(long('"VarName";"TimeString";"VarValue";"Validity";"Time_ms"', wincc), MAPPED),
    "long, historian": Dialect(
        long("TagName,DateTime,Value,Quality", lambda name, unit, t, value: f"{name},{stamp(t)},{value:.6f},Good"),
        MAPPED,
    ),
    "long, historian with units": Dialect(
        long("Time,Name,Value,Unit", lambda name, unit, t, value: f"{stamp(t)},{name},{value:.6f},{unit}")
    ),
    "long, German, seconds": Dialect(
        long(
            "Zeit [s];Kanal;Messwert;Einheit",
            lambda name, unit, t, value: f"{t:.3f};{name};{value:.6f};{unit}".replace(".", ","),
        )
    ),
    "long, ms since 1970": Dialect(
        long("ts\ttopic\tvalue", lambda name, unit, t, value: f"{1717199999900 + 1e3 * t:.0f}\t{name}\t{value:.6f}"),
        MAPPED,
    ),
    "long, units in names": Dialect(
        long("name,timestamp,value", lambda name, unit, t, value: f"{name} [{unit}],{t:.3f},{value:.6f}")
    ),
    "long, one name after the other": Dialect(
        text(
            "Tag,Timestamp,Value\n"
            + "".join(
                f"{name} [{unit}],{stamp(t)},{value:.6f}\n"
                for name, values, unit in SIGNALS
                for t, value in zip(TIMES[::-1], values[::-1], strict=True)
            )
        )
    ),
    "long, InfluxDB's annotated CSV": Dialect(influx(INFLUX, True, False), MAPPED),
    "long, InfluxDB's annotated CSV, tables": Dialect(influx(INFLUX, True, True), MAPPED),
    "long, InfluxDB's CSV": Dialect(influx(INFLUX, False, False), MAPPED),
    "InfluxDB's annotated CSV, pivoted": Dialect(
        text(
            "#group,false,false,false,false,false,false\n#datatype,string,long,dateTime:RFC3339,double,double,double\n"
            "#default,_result,,,,,\n,result,table,_time,p_A,p_B,x\n"
            + "".join(f",,0,{stamp(t)},{a:.6f},{b:.6f},{x:.6f}\n" for t, a, b, x in ROWS)
        ),
        MAPPED,
    ),
}


def twincat(comma: bool = False, single: bool = False, join: str = "\t", every: int = 1, brief: bool = False) -> Writer:
    """Write what TwinCAT Scope exports, in the form of the files that accompany pytcs, with a full header.

    `single`: channels of one clock share a column of times; `every`: the position is sampled so many times slower;
    `brief`: the heading is the row of names alone.
    """
    heads = [
        ("Name", "p_A", "p_B", "x"), ("SymbolComment", "", "", ""), ("Data-Type", "REAL64", "REAL64", "REAL32"),
        ("SampleTime[ms]", "2", "2", "4"), ("VariableSize", "8", "8", "4"), ("SymbolBased", "True", "True", "True"),
        ("IndexGroup", "16448", "16448", "16448"), ("IndexOffset", "385000", "385008", "385016"),
        ("SymbolName", "MAIN.p_A", "MAIN.p_B", "MAIN.x"), ("NetID", *["192.168.178.20.1.1"] * 3),
        ("Port", "851", "851", "851"), ("Offset", "0", "0", "0"), ("ScaleFactor", "1", "1", "1"),
        ("BitMask", *["0xffffffffffffffff"] * 3), ("Unit", "bar (Pressure)", "bar (Pressure)", "mm (Length)"),
        ("Unit ScaleFactor", "1", "1", "1"), ("Unit Offset", "0", "0", "0"),
    ]  # fmt: skip
    lines = ["Name" + join + "rig", "File" + join + "C:\\rig.csv"]
    lines += [f"Starttime of export{join}132959733843760000{join}Montag, 2. Mai 2022{join}15:56:24.376"]
    lines += [f"Endtime of export{join}132959733853750000{join}Montag, 2. Mai 2022{join}15:56:25.375", "", ""]
    heads = heads[:1] if brief else heads
    lines += [join.join([k, a, b, k, x] if single else [k, a, k, b, k, x]) for k, a, b, x in heads] + [""]
    for k, t in enumerate(TIMES):
        at = every * k
        slow = [f"{1e3 * TIMES[at]:g}", f"{POSITION[at]:.6f}"] if at < len(TIMES) else [" ", " "]
        time, a, b = f"{1e3 * t:g}", f"{A[k]:.6f}", f"{B[k]:.6f}"
        lines.append(join.join([time, a, b, *slow] if single else [time, a, time, b, *slow]))
    body = "\n".join(lines[-len(TIMES) :])
    return text("\n".join(lines[: -len(TIMES)]) + "\n" + (body.replace(".", ",") if comma else body) + "\nEOF\n")


def pairs(head: str, width: int = 2, join: str = ",") -> Writer:
    """Return what writes each channel beside its times."""
    rows = [join.join(f"{t:.3f}{join}{value:.6f}" for _, _, value in samples(k)) for k, t in enumerate(TIMES)]
    return text(join.join(head.split(",")) + "\n" + "\n".join(rows) + "\n")


EACH: dict[str, Dialect] = {
    "a clock each, TwinCAT Scope": Dialect(twincat()),
    "a clock each, TwinCAT Scope, decimal comma": Dialect(twincat(comma=True)),
    "a clock each, TwinCAT Scope, shared clocks": Dialect(twincat(single=True)),
    "a clock each, TwinCAT Scope, names alone": Dialect(twincat(single=True, brief=True), MAPPED),
    "a clock each, TwinCAT Scope, semicolon": Dialect(twincat(comma=True, join=";")),
    "a clock each, two called t": Dialect(pairs("t,p_A [bar],t,p_B [bar],t,x [mm]")),
    "a clock each, with units": Dialect(pairs("t [s],p_A [bar],t [s],p_B [bar],t [s],x [mm]", join=";")),
    "a clock each, LabVIEW": Dialect(pairs("X_Value,p_A [bar],X_Value,p_B [bar],X_Value,x [mm]", join="\t")),
    "a clock each, numbered": Dialect(pairs("Time,p_A [bar],Time.1,p_B [bar],Time.2,x [mm]", join="\t")),
    "a clock each, X": Dialect(pairs("X [s];p_A [bar];X [s];p_B [bar];X [s];x [mm]".replace(";", ","), join=";")),
    "a clock each, X and Y": Dialect(pairs("p_A X,p_A Y [bar],p_B X,p_B Y [bar],x X,x Y [mm]")),
    "a clock each, German": Dialect(
        pairs("Zeit 1 - Standard [s],Druck A [bar],Zeit 2 - schnell [s],Druck B [bar],Zeit 3 [s],Weg [mm]"),
        {"map": "auto"},
    ),
}


def bench(
    head: str,
    row: Callable[[int, dt.datetime, int], str],
    options: Mapping[str, Any] = MAPPED,
    end: str = "",
    join: str = ",",
    form: str = ".6f",
) -> Dialect:
    """Return an instrument's export: `row` makes what stands before the samples, of number, moment and milliseconds."""
    lines = [
        join.join([row(k, moment, ms), *(f"{value:{form}}" for _, _, value in samples(k))])
        for k, (moment, ms) in enumerate(MS)
    ]
    return Dialect(text(head + "\n" + "\n".join(line + end for line in lines) + "\n"), options)


def graphtec(alarms: bool, names: bool) -> Dialect:
    """A GL's CSV: settings, a table of channels, a row of names and one of units under it."""
    typed = [name if names else f" CH {number}" for number, (name, _, _) in enumerate(SIGNALS, start=1)]
    table = [f'CH{n}, "{typed[n - 1]}",DC,10V,Off,100.000000,0.000000,{SIGNALS[n - 1][2]}' for n in (1, 2, 3)]
    head = "Vendor,GRAPHTEC Corporation\nModel,GL840-M\nVersion,1.00\nSampling interval,2ms\nTotal data points,200\n"
    head += "Start time,2024-05-31,23:59:59\nEnd time,2024-06-01,00:00:00\nTrigger time,2024-05-31,23:59:59\n"
    head += "AMP settings\nCH,Signal name,Input,Range,Filter,Span\n" + "\n".join(table) + "\nLogic/Pulse,Off\nData\n"
    head += "Number,Date&Time,ms,CH1,CH2,CH3" + (",Alarm1-10,Alarm11-20,AlarmOut" if alarms else "") + "\n"
    head += "NO.,Time,ms,bar,bar,mm" + (",A1234567890,A1234567890,A1234" if alarms else "")
    options = {} if names else {"map": {"p_A": "CH1", "p_B": "CH2", "x": "CH3"}}
    tail = ",LLLLLLLLLL,LLLLLLLLLL,LLLL" if alarms else ""
    return bench(head, lambda k, moment, ms: f"{k + 1},{moment:%Y-%m-%d %H:%M:%S},{ms:03d}", options, tail, form="+.6f")


HIOKI = """"File name","WAVE0001.CSV","V 1.00"
"Title comment",""
"Trigger Time","'24-05-31 23:59:59"
"Ch","Mode","Range","Comment","Scaling","Ratio","Offset"
"CH-1","Voltage","10V","p_A","On","2.50000E+01","0.00000E+00"
"CH-2","Voltage","10V","p_B","On","2.50000E+01","0.00000E+00"
"CH-3","Voltage","10V","x","On","1.00000E+01","0.00000E+00"
"ALM","Alarm","","",
"Time","CH-1[bar]","CH-2[bar]","CH-3[mm]","ALM-CH1","Event","""
TEKTRONIX = """Model,MDO3024
Firmware Version,1.26
,
Waveform Type,ANALOG,,,
Point Format,Y,,,
Horizontal Units,S,,,
Horizontal Scale,4e-02,,,
Horizontal Delay,0,,,
Sample Interval,0.002,,,
Record Length,200,,,
Gating,0.0% to 100.0%,,,
Probe Attenuation,1,1,1
Vertical Units,V,V,V
Vertical Offset,0,0,0
Vertical Scale,1,1,1
Label,{}
TIME,CH1,CH2,CH3"""
YOKOGAWA = """YREC
Manual Sample Data Version 1.02.00
Model\tDX2000
Language Code\tshift-JIS
File Status\tComplete
Serial No.\tS5H000001
File Header\t
Ch\tCH001\tCH002\tCH003
Tag\tp_A\tp_B\tx
Unit\tbar\tbar\tmm"""
NUMBERED = {"map": {"p_A": "CH1[bar]", "p_B": "CH2[bar]", "x": "CH3[mm]"}}
INSTRUMENTS: dict[str, Dialect] = {
    "Graphtec GL": graphtec(True, True),
    "Graphtec GL, no alarms": graphtec(False, True),
    "Graphtec GL, channels by number": graphtec(True, False),
    "Hioki": bench(HIOKI, lambda k, moment, ms: f"{TIMES[k]:.9E}", {}, ",0,0,"),
    "Hioki, channels by number": bench(
        HIOKI,
        lambda k, moment, ms: f"{TIMES[k]:.9E}",
        {"map": {"p_A": "CH-1", "p_B": "CH-2[bar]", "x": "CH-3"}},
        ",0,0,",
    ),
    "Tektronix, labels": bench(
        TEKTRONIX.format("p_A [bar],p_B [bar],x [mm]"), lambda k, moment, ms: f"{TIMES[k] - 0.2:.6e}", {}
    ),
    "Tektronix, labels and their units by a map": bench(
        TEKTRONIX.format("p_A,p_B,x"), lambda k, moment, ms: f"{TIMES[k] - 0.2:.6e}"
    ),
    "Tektronix, no labels": bench(TEKTRONIX.format(",,"), lambda k, moment, ms: f"{TIMES[k] - 0.2:.6e}", NUMBERED),
    "Keysight InfiniiVision": bench(
        "x-axis,1,2,3\nsecond,Volt,Volt,Volt",
        lambda k, moment, ms: f"{TIMES[k] - 0.1:+.6E}",
        {"map": {"p_A": "1[bar]", "p_B": "2[bar]", "x": "3[mm]"}},
    ),
    "Keysight 34972A": bench(
        "Sweep #,Time,Chan 201 (BAR),Chan 202 (BAR),Chan 203 (MM)",
        lambda k, moment, ms: f"{k + 1},{moment:%m/%d/%Y %H:%M:%S}:{ms:03d}",
        {"map": {"p_A": "Chan 201 (BAR)", "p_B": "Chan 202", "x": "Chan 203"}},
    ),
    "Keysight BenchLink": Dialect(
        text(
            "Scan,Time,101 <p_A> (BAR),Alarm 101,102 <p_B> (BAR),Alarm 102,103 <x> (MM),Alarm 103\n"
            + "".join(
                f"{k + 1},{moment:%m/%d/%Y %H:%M:%S}:{ms:03d},{A[k]:.6f},0,{B[k]:.6f},0,{POSITION[k]:.6f},0\n"
                for k, (moment, ms) in enumerate(MS)
            ),
            encoding="utf-16",
        )
    ),
    "PicoScope": bench(
        "Time,Channel A,Channel B,Channel C\n(ms),(bar),(bar),(mm)\n",
        lambda k, moment, ms: f"{1e3 * TIMES[k]:.8f}",
        {"map": {"p_A": "Channel A", "p_B": "Channel B", "x": "Channel C"}},
    ),
    "Yokogawa WT": bench(
        "Store No.,Date,Time,Millisecond,p_A,p_B,x",
        lambda k, moment, ms: f"{k + 1},{moment:%Y/%m/%d},{moment:%H:%M:%S},{ms}",
    ),
    "Yokogawa DX": bench(YOKOGAWA, lambda k, moment, ms: f"{moment:%Y/%m/%d %H:%M:%S}.{ms:03d}", {}, join="\t"),
    "FactoryTalk": Dialect(
        text(
            "Date,Time,Millitm,Tagname,Value,Status,Marker\n"
            + "".join(
                f"{moment:%m/%d/%Y},{moment:%I:%M:%S %p},{ms},{name} [{unit}],{value:.6f},,\n"
                for k, (moment, ms) in enumerate(MS)
                for name, unit, value in samples(k)
            )
        )
    ),
}


def quantities(
    head: str, join: str = ";", comma: bool = True, quote: str = "", gap: str = " ", time: str = " s"
) -> Writer:
    """Return what writes the unit behind each number."""
    cells = [
        [f"{t:.3f}{time}", *(f"{value:.6f}{gap}{unit}" for _, unit, value in samples(k))] for k, t in enumerate(TIMES)
    ]
    rows = [join.join(f"{quote}{cell}{quote}" for cell in row) for row in cells]
    return text(f"{head}\n" + "\n".join(rows).replace(".", "," if comma else ".") + "\n")


QUANTITIES: dict[str, Dialect] = {
    "units in cells": Dialect(quantities("t;p_A;p_B;x")),
    "units in cells, no blank": Dialect(quantities("t;p_A;p_B;x", gap="", time="s")),
    "units in cells, not behind the time": Dialect(quantities("t [s];p_A;p_B;x", time="")),
    "units in cells and headings": Dialect(quantities("t [s]\tp_A [bar]\tp_B\tx [mm]", join="\t", comma=False)),
    "units in cells, comma": Dialect(quantities("t,p_A,p_B,x", join=",", comma=False)),
    "units in cells, quoted decimal commas": Dialect(quantities('"t","p_A","p_B","x"', join=",", quote='"')),
    "units in cells, preamble": Dialect(
        quantities("Operator;N. N.\nOil temperature;41 degC\nSupply;200 bar\nZeit;Druck A;Druck B;Weg"),
        {"map": "auto"},
    ),
}
TEXTS = {**CLOCKS, **LONG, **EACH, **INSTRUMENTS, **QUANTITIES}
EXPORTS: dict[str, Dialect] = {**JSONS, **{name: own._replace(digit=1e-6) for name, own in TEXTS.items()}}
