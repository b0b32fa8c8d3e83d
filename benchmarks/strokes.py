"""Verdicts on real strokes of rotary actuators: false alarms within a session, between specimens, and what is found.

    python benchmarks/strokes.py [FOLDER] [--session NAME]...

FOLDER holds the strokes of the public data set vtnsi/actuator_dataset (MIT licence), one subfolder each:
`session_act_1_healthy` (on which the priors of `rms change` were checked), `session_act_2_healthy` (on which nothing
was chosen) and `act_4_seal_defect`. By default ../shared/data/real/vtnsi_actuator. Intervals are Clopper and Pearson's
at 95 %, as if strokes were independent, which those of one session are not.
"""

from __future__ import annotations

import argparse
import re
import sys
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import sealscope as ss
from sealscope.diagnosis.verdict.diagnosis import Diagnosis
from sealscope.evaluation.binomial import clopper_pearson
from sealscope.recordings.recording import Recording

FOLDER = Path(__file__).resolve().parents[2] / "shared" / "data" / "real" / "vtnsi_actuator"
SESSIONS = ("session_act_1_healthy", "session_act_2_healthy")
DEFECT = "act_4_seal_defect"
#: Strokes that make the baseline of a session.
BASELINE = 20
VERDICTS = ("leak", "cannot tell", "no leak")


def strokes(folder: Path) -> list[Recording]:
    """Read the strokes of a session in the order in which they were made."""
    files = sorted(folder.glob("*.txt"), key=lambda path: int(re.findall(r"_000_(\d+)_", path.name)[0]))
    return [ss.read(path, rate=1000.0, map={"p_A": "PG_1", "p_B": "PG_2"}) for path in files]


def without_times(recordings: Iterable[Recording]) -> list[Recording]:
    """Return the recordings as if nothing told when they were made."""
    return [replace(recording, provenance={}) for recording in recordings]


def row(title: str, diagnoses: Sequence[Diagnosis]) -> None:
    """Print how often each verdict was given."""
    counts, n = Counter(diagnosis.verdict for diagnosis in diagnoses), len(diagnoses)
    cells = []
    for verdict in VERDICTS:
        low, high = clopper_pearson(counts[verdict], n)
        cells.append(f"{counts[verdict]:4d} {100 * counts[verdict] / n:5.1f} % ({100 * low:.1f} to {100 * high:.1f})")
    print(f"{title:58s} {n:4d}  " + "  ".join(f"{cell:28s}" for cell in cells))


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", nargs="?", type=Path, default=FOLDER)
    parser.add_argument("--session", action="append", help="Only these sessions (default: both).")
    arguments = parser.parse_args()
    chosen = arguments.session or list(SESSIONS)
    missing = [name for name in (*chosen, DEFECT) if not (arguments.folder / name).is_dir()]
    if missing:
        print(f"skipped: {', '.join(missing)} not in {arguments.folder}", file=sys.stderr)
        return
    sessions = {name: strokes(arguments.folder / name) for name in chosen}
    defect = strokes(arguments.folder / DEFECT)
    print(f"{'':58s}    n  " + "  ".join(f"{verdict:28s}" for verdict in VERDICTS))
    for name, session in sessions.items():
        within(name, session)
    for name, session in sessions.items():
        for other, judged in sessions.items():
            if other != name:
                row(f"{other} against {name}", [ss.diagnose(stroke, session) for stroke in judged])
                row(
                    f"{other} against the first {BASELINE} of {name}",
                    [ss.diagnose(stroke, session[:BASELINE]) for stroke in judged],
                )
                row(
                    f"{other} against {name}, times unknown",
                    [ss.diagnose(stroke, without_times(session)) for stroke in without_times(judged)],
                )
        row(f"{DEFECT} against {name}", [ss.diagnose(stroke, session) for stroke in defect])
        row(
            f"{DEFECT} against {name}, times unknown",
            [ss.diagnose(stroke, without_times(session)) for stroke in without_times(defect)],
        )


def within(name: str, session: Sequence[Recording]) -> None:
    """Print what is said of later strokes of a session, and of strokes between those of its baseline."""
    first, later = session[:BASELINE], session[BASELINE:]
    verdicts = [ss.diagnose(stroke, first) for stroke in later]
    row(f"{name}, first {BASELINE} as baseline", verdicts)
    quarter = len(later) // 4
    for k in range(4):
        part = verdicts[k * quarter : (k + 1) * quarter if k < 3 else None]
        row(f"  quarter {k + 1} of the later strokes", part)
    row(
        f"{name}, the same, times unknown",
        [ss.diagnose(stroke, without_times(first)) for stroke in without_times(later)],
    )
    halves = [[stroke for k, stroke in enumerate(session) if (k // 2) % 2 == half] for half in (0, 1)]
    for gain in (1.0, 1.05, 1.1, 1.2, 1.3):
        row(
            f"{name}, interleaved, details x {gain:g}",
            [ss.diagnose(louder(stroke, gain), halves[0]) for stroke in halves[1]],
        )
    for gain in (1.1, 1.2, 1.3, 1.5):
        row(
            f"{name}, first {BASELINE} as baseline, details x {gain:g}",
            [ss.diagnose(louder(stroke, gain), first) for stroke in later],
        )


def louder(stroke: Recording, gain: float) -> Recording:
    """Return the stroke with the band of d2 to d4, some 20 to 250 Hz of 1000, scaled by `gain`, in whole counts."""
    import numpy as np
    from scipy.ndimage import gaussian_filter1d

    channels = dict(stroke.channels)
    for name in ("p_A", "p_B"):
        band = gaussian_filter1d(stroke[name], 0.6) - gaussian_filter1d(stroke[name], 8.0)
        channels[name] = np.rint(stroke[name] + (gain - 1.0) * band)
    return replace(stroke, channels=channels)


if __name__ == "__main__":
    main()
