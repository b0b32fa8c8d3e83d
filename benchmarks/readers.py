"""Time of the readers against the length of what they read, on inputs that are made to be slow.

    python benchmarks/readers.py [--rounds 3]

A line for each kind of input: the exponent b of time = a length^b, and the time of the largest. b is the median over
the last five doublings of the length, of the processor time without Python's collector of garbage, whose passes come in
steps. What is bounded in length is refused in a time that does not grow (b near 0); nothing may grow faster than the
length does (b over 1.1 ends with status 1).
"""

from __future__ import annotations

import argparse
import gc
import json
import math
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path

import numpy as np

from sealscope.campaigns.execution.store import read_rows
from sealscope.errors import InputError
from sealscope.parameters import load_rig, parse_overrides
from sealscope.recordings import read, split_map_option
from sealscope.recordings.formats.headings.labels import Label
from sealscope.recordings.formats.times.timebase import is_stamp
from sealscope.simulation.commands import parse_command
from sealscope.simulation.faults import parse_fault
from sealscope.simulation.leaks import parse_leak
from sealscope.storage.rows import ROWS
from sealscope.units import parse_quantity, parse_unit

HEAD = "t [s],p_A [Pa]\n"
#: Texts by length that are read as logs; a log's layout is looked for in its first 64 KiB.
LOGS: dict[str, Callable[[int], str]] = {
    "rows": lambda n: HEAD + "".join(f"{k},1.5\n" for k in range(n // 10)),
    "a cell of blanks": lambda n: HEAD + "0,1\n1," + " " * n + "x\n2,3\n",
    "cells of blanks": lambda n: HEAD + ("0,1\n1," + " " * 900 + "x\n") * (n // 900),
    "nearly stamps": lambda n: HEAD + ("2024-01-01 " + " " * 50 + ",1\n") * (n // 64),
    "nearly clocks": lambda n: HEAD + ("12:30:00." + "0" * 50 + ",1\n") * (n // 62),
    "a cell of digits": lambda n: HEAD + "0," + "1" * n + "x\n1,2\n",
    "words for numbers": lambda n: HEAD + "".join(f"{k},OVERLOAD\n" for k in range(n // 14)),
    "square brackets": lambda n: "t [s],p_A " + "[" * n + "\n0,1\n1,2\n",
    "round brackets": lambda n: "t [s],p_A " + "(" * (n // 2) + ")" * (n // 2) + "\n0,1\n1,2\n",
    "strokes": lambda n: "t [s],p_A" + " / " * (n // 3) + "x\n0,1\n1,2\n",
    "headings": lambda n: ",".join(["t [s]", "p_A [Pa]", *(f"c{k} [m]" for k in range(n // 12))]) + "\n0,1\n" * 3,
    "headings between blanks": lambda n: "a [a " * (n // 5) + "\n0 1\n1 2\n",
    "unknown units": lambda n: (
        "t,p_A" + ",a" * (n // 8) + "\ns,Pa" + "".join(f",q{k}" for k in range(n // 8)) + "\n1,2\n"
    ),
    "origin of time": lambda n: "t [s since " + " " * n + "x],p_A [Pa]\n0,1\n1,2\n",
    "remarks": lambda n: "a : b = c : \n" * (n // 13) + HEAD + "0,1\n1,2\n",
    "a remark": lambda n: "a " * (n // 2) + ": x\n" + HEAD + "0,1\n1,2\n",
    "delimiters": lambda n: "," * (n // 2) + "\n" + "," * (n // 2),
    "open quotation marks": lambda n: HEAD + '0,"1\n' * (n // 5),
    "quotation marks": lambda n: HEAD + '0,1""""\n' * (n // 8),
    "line ends of old": lambda n: HEAD.replace("\n", "\r") + "0,1\r" * (n // 4),
    "our own first line": lambda n: '# sealscope: {"a": "' + "x" * n + '"}\nt [s],p_A [Pa]\n0,1\n1,2\n',
    "our own nested line": lambda n: "# sealscope: " + "[" * n + "\nt [s],p_A [Pa]\n0,1\n1,2\n",
}
#: Texts of settings, read as the file of a rig.
SETTINGS: dict[str, Callable[[int], str]] = {
    "TOML: a dotted key": lambda n: "a." * (n // 2) + "a = 1\n",
    "TOML: a dotted heading": lambda n: "[" + "a." * (n // 2) + "a]\n",
    "TOML: dotted keys": lambda n: "".join(f"{'a.' * 14}k{k} = 1\n" for k in range(n // 36)),
    "TOML: quoted keys": lambda n: '"a".' * (n // 4) + "a = 1\n",
    "TOML: headings": lambda n: "".join(f"[a{k}]\nb = 1\n" for k in range(n // 14)),
    "TOML: tables of an array": lambda n: "[[a]]\nb = 1\n" * (n // 12),
    "TOML: nested arrays": lambda n: "a = " + "[" * n + "]" * n + "\n",
    "TOML: an inline table": lambda n: "a = {" + ",".join(f"k{k}=1" for k in range(n // 8)) + "}\n",
    "TOML: digits": lambda n: "a = " + "1" * n + "\n",
    "TOML: escapes": lambda n: 'a = "' + "\\n" * (n // 2) + '"\n',
    "TOML: blanks": lambda n: "a" + " " * n + "b\n",
}
#: Texts handed to a function.
TEXTS: dict[str, tuple[Callable[[str], object], Callable[[int], str]]] = {
    "command: digits": (parse_command, lambda n: "3 sin(" + "4" * n),
    "command: blanks": (parse_command, lambda n: "3 sin(4t" + " " * n + "x"),
    "command: duties": (parse_command, lambda n: "1 period of sin(t), " * (n // 20)),
    "leak: digits": (parse_leak, lambda n: "1" * n),
    "leak: letters": (parse_leak, lambda n: "0.01 " + "L" * n),
    "fault: digits": (parse_fault, lambda n: "rod seal A " + "1" * n),
    "map: letters": (split_map_option, lambda n: "p_A" * (n // 3) + "=x"),
    "set: letters": (lambda text: load_rig("thesis").with_overrides(parse_overrides([text])), lambda n: "V" * n + "=1"),
    "quantity: digits": (lambda text: parse_quantity(text, "s"), lambda n: "1" * n + "x"),
    "unit: powers": (parse_unit, lambda n: "(" * (n // 9) + "mPa^9" + ")^9" * (n // 9)),
    "unit: letters": (parse_unit, lambda n: "m" * n),
    "heading: blanks": (Label.parse, lambda n: "p_A" + " " * n + "x"),
    "heading: brackets": (Label.parse, lambda n: "p_A (" + "(" * n + ")"),
    "stamp: blanks": (is_stamp, lambda n: "2024-01-01" + " " * n + "x"),
}


def _seconds(work: Callable[[], object], rounds: int) -> float:
    best = math.inf
    for _ in range(rounds):
        begin = time.process_time()
        with suppress(InputError):
            work()
        best = min(best, time.process_time() - begin)
    return best


def exponent(lengths: list[int], seconds: list[float]) -> float:
    """Return b of seconds = a length^b, the median over the last five doublings; times under 1 ms are 1 ms."""
    slopes = np.diff(np.log(np.maximum(seconds, 1e-3))) / np.diff(np.log(lengths))
    return float(np.median(slopes[-5:]))


def main() -> None:
    words = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    words.add_argument("--rounds", type=int, default=3)
    rounds = words.parse_args().rounds
    cases: dict[str, Callable[[int], Callable[[], object]]] = {}
    steep = 0
    gc.disable()
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)

        def file_of(suffix: str, make: Callable[[int], str], reader: Callable[[Path], object]) -> Callable[..., object]:
            def prepared(length: int) -> Callable[[], object]:
                path = folder / (ROWS if suffix == ".jsonl" else f"given{suffix}")
                path.write_text(make(length))
                return lambda: reader(path)

            return prepared

        for name, make in LOGS.items():
            cases[name] = file_of(".csv", make, read)
        for name, make in SETTINGS.items():
            cases[name] = file_of(".toml", make, load_rig)
        for name, (reader, make) in TEXTS.items():
            cases[name] = lambda length, reader=reader, make=make: partial(reader, make(length))
        row = json.dumps(
            {"id": "a", "use": "judge", "leak_lpm": 0, "fault": "", "levels": {"a": "x" * 400}, "scores": {},
             "error": "e", "replicate": 0}
        )  # fmt: skip
        cases["rows of a campaign"] = file_of(
            ".jsonl", lambda n: f"{row}\n" * (n // 512), lambda path: read_rows(path.parent)
        )
        for name, prepare in cases.items():
            first = 14 if name in LOGS or name == "rows of a campaign" else 13
            lengths = [2**k for k in range(first, first + 7)]
            seconds = []
            for length in lengths:
                seconds.append(_seconds(prepare(length), rounds))
                if seconds[-1] > 10.0:  # it is too steep, and would not end
                    break
            b = exponent(lengths[: len(seconds)], seconds)
            steep += b > 1.1
            mark = "  too steep" if b > 1.1 else ""
            print(
                f"{name:<26} exponent {b:5.2f}  {1e3 * seconds[-1]:9.2f} ms at {lengths[len(seconds) - 1]}{mark}",
                flush=True,
            )
    raise SystemExit(1 if steep else 0)


if __name__ == "__main__":
    main()
