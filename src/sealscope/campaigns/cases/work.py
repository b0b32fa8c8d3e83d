"""Run one case of a campaign: simulate its record and judge it with every detector of the plan."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

from sealscope.campaigns.cases.case import CampaignCase
from sealscope.campaigns.cases.machines import case_experiment
from sealscope.campaigns.cases.row import CaseRow, error_text
from sealscope.campaigns.cases.scoring import judge_record
from sealscope.campaigns.plans.model import SimulatedPlan
from sealscope.simulation.simulate import simulate_experiment


def run_case(plan: SimulatedPlan, case: CampaignCase, folder: Path | None = None) -> CaseRow:
    """Simulate and judge one case of a campaign, and return the row with its results or any error.

    The recording is written into `folder`, or discarded if `folder` is None.
    """
    start_time = time.process_time()
    try:
        simulated = simulate_experiment(case_experiment(plan, case))
        if folder is not None:
            from sealscope.recordings import write

            write(simulated.recording, folder / f"{case.id}.nc")
        scores, statements = judge_record(simulated.recording, plan.onset_s, plan, plan.assumed)
        flow = simulated.truth.mean_leak_lpm if case.leak_lpm else 0.0
        row = CaseRow.from_case(case, flow_lpm=flow, scores=scores, statements=statements)
    except Exception as error:  # a program defect in one case must not end the campaign; its row carries the error
        row = CaseRow.from_case(case, error=error_text(error))
    return replace(row, seconds=round(time.process_time() - start_time, 4))
