"""Carry out one case: simulate, record, let every detector score."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

from sealscope.campaigns.cases.case import CampaignCase
from sealscope.campaigns.cases.machines import experiment_of
from sealscope.campaigns.cases.row import CaseRow, error_text
from sealscope.campaigns.cases.scoring import judge_record
from sealscope.campaigns.plans.model import SimulatedPlan
from sealscope.simulation.simulate import simulate_experiment


def work(plan: SimulatedPlan, case: CampaignCase, folder: Path | None = None) -> CaseRow:
    """Carry out one case; an error of any kind becomes the row's error. `folder` to write the recording into."""
    started = time.process_time()
    try:
        row = _work(plan, case, folder)
    except Exception as error:  # a defect of the program must not end ten thousand other cases; the table says it
        row = CaseRow.from_case(case, error=error_text(error))
    return replace(row, seconds=round(time.process_time() - started, 4))


def _work(plan: SimulatedPlan, case: CampaignCase, folder: Path | None) -> CaseRow:
    simulated = simulate_experiment(experiment_of(plan, case))
    if folder is not None:
        from sealscope.recordings import write

        write(simulated.recording, folder / f"{case.id}.nc")
    scores, statements = judge_record(simulated.recording, plan.onset_s, plan, plan.assumed)
    flow = simulated.truth.mean_leak_lpm if case.leak_lpm else 0.0
    return CaseRow.from_case(case, flow_lpm=flow, scores=scores, statements=statements)
