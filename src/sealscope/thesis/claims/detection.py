"""Judge the thesis's claims on the detection of leaks, and tabulate all claims of all chapters with verdicts."""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import astuple, replace
from typing import get_args

from sealscope.thesis.claims import rig, sheet
from sealscope.thesis.claims.evidence import gather_evidence
from sealscope.thesis.engine.context import Context
from sealscope.thesis.engine.items import Item
from sealscope.thesis.engine.products import Claim, ThesisTable, Verdict


def detection_claims(context: Context, item: Item) -> tuple[Claim, ...]:
    """Judge the claims on leak detection in the abstract and chapters 1, 5 and 6; `item` is unused."""
    evidence = gather_evidence(context)
    claims = (*sheet.leak_level_claims(), *sheet.claims(evidence), *sheet.curve_claims(evidence), *rig.claims(evidence))
    return tuple(sorted(claims, key=_claim_order))


def _claim_order(claim: Claim) -> tuple[int, ...]:
    """Return the numbers in a claim's id, such as (5, 4, 1), with 0 for "a", the abstract."""
    return tuple(int(number) for number in re.findall(r"[0-9]+", claim.id.replace("claim-a", "claim-0")))


def claims_tables(context: Context, item: Item) -> tuple[ThesisTable, ...]:
    """Tabulate the claims of all items that `item` needs, and the number of claims with each verdict."""
    claims = [product for name in item.needs for product in context.product(name) if isinstance(product, Claim)]
    claims.sort(key=_claim_order)
    verdicts = Counter(claim.verdict for claim in claims)
    rows = map(astuple, claims)
    missing = "" if context.sheet else " The data sheet was not given: claims that rest on it could not be tested."
    notes = f"Claims in our own words. A claim holds where every part of it does.{missing}"
    counts = ((verdict, verdicts[verdict]) for verdict in get_args(Verdict))
    title, heads = "How many claims have each verdict", ("verdict", "claims")
    claims_table = replace(item.table(rows, notes), claims=tuple(claim.id for claim in claims))
    return claims_table, item.table(counts, "", heads, tail="-verdicts", title=title)
