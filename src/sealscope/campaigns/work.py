"""One case's work: simulate, record, let every detector score; the row it leaves."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from sealscope.campaigns.cases import Case
from sealscope.campaigns.plan import Plan
from sealscope.campaigns.statement import Statement
from sealscope.errors import InputError, SealscopeError

#: Channels that are looked through for findings: those that can spoil a verdict.
INSPECTED = ("u", "x", "p_A", "p_B")
#: detector -> (score, None where it cannot tell; onset [s], None where it finds none)
Scores = Mapping[str, tuple[float | None, float | None]]


@dataclass(frozen=True)
class Row:
    """What is kept of a case: its inputs, where the record was made, the scores; or the `error` it failed with.

    `flow_lpm`: mean leak [L/min] while open, as the run really had it; `place`: operating point and length of the
    record, plain values; `scores` by the plan's name of a detector, `statements` by `Entry.key`; `seconds`: processor
    time, of no account to the result and not in the final table.
    """

    id: str
    use: str
    leak_lpm: float
    fault: str
    levels: Mapping[str, str | float]
    replicate: int
    flow_lpm: float | None = None
    place: Mapping[str, Any] = field(default_factory=dict)
    scores: Scores = field(default_factory=dict)
    error: str | None = None
    seconds: float = 0.0
    statements: Mapping[str, Statement] = field(default_factory=dict)

    def as_dict(self) -> dict[str, Any]:
        """The row as plain JSON values."""
        return asdict(self)

    @classmethod
    def from_dict(cls, tree: Mapping[str, Any]) -> Row:
        """The row of such values; raises TypeError, KeyError or ValueError where they are none."""
        scores = {str(name): (_number(pair[0]), _number(pair[1])) for name, pair in tree["scores"].items()}
        statements = {str(name): Statement.from_dict(one) for name, one in tree.get("statements", {}).items()}
        return cls(**{**tree, "scores": scores, "statements": statements})


def _number(value: Any) -> float | None:
    return None if value is None else float(value)


def failed(case: Case, error: str) -> Row:
    """The row of a case that could not be carried out."""
    return Row(case.id, case.use, case.leak_lpm, case.fault, case.levels, case.replicate, error=error)


def work(plan: Plan, case: Case, keep: Path | None = None) -> Row:
    """Carry out one case; what goes wrong becomes the row's error. `keep`: folder to write the recording into."""
    started = time.process_time()
    try:
        row = _work(plan, case, keep)
    except SealscopeError as error:
        row = failed(case, str(error))
    except MemoryError:
        row = failed(case, "out of memory")
    except Exception as error:  # a fault of the program must not end ten thousand other cases; it is told in the table
        row = failed(case, f"{type(error).__name__}: {error}".splitlines()[0])
    return Row(**{**row.__dict__, "seconds": round(time.process_time() - started, 4)})


def _work(plan: Plan, case: Case, keep: Path | None) -> Row:
    from sealscope.campaigns.entries import stated
    from sealscope.campaigns.machines import experiment_of
    from sealscope.diagnosis.calibration.calibrated import looked_at, place_of
    from sealscope.diagnosis.calibration.scorers import Look
    from sealscope.simulation.simulate import run

    made = run(experiment_of(plan, case))
    if keep is not None:
        from sealscope.recordings import write

        write(made.recording, keep / f"{case.id}.nc")
    part, _, reason = looked_at(made.recording, INSPECTED)
    if reason is not None:
        raise InputError(f"the record cannot be judged: {reason}")
    look = Look(part, plan.onset_s, plan.false_alarm, plan.assumed or plan.rig)
    scores, statements = stated(look, plan.detectors, plan.views)
    return Row(
        id=case.id,
        use=case.use,
        leak_lpm=case.leak_lpm,
        fault=case.fault,
        levels=case.levels,
        replicate=case.replicate,
        flow_lpm=made.truth.mean_leak_lpm if case.leak_lpm else 0.0,
        place=asdict(place_of(part)),
        scores=scores,
        statements=statements,
    )
