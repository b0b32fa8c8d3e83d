"""Every testable sentence of the thesis with its verdict: the chapters' own claims and those on detection."""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import astuple, replace
from typing import get_args

from sealscope.thesis.claims import rig, sheet
from sealscope.thesis.claims.evidence import gather
from sealscope.thesis.engine.context import Context
from sealscope.thesis.engine.items import Item
from sealscope.thesis.engine.products import Claim, ThesisTable, Verdict


def detection(context: Context, item: Item) -> tuple[Claim, ...]:
    """Judge the claims of the abstract and of chapters 1, 5 and 6, in the thesis's order."""
    evidence = gather(context)
    claims = (*sheet.levels(), *sheet.claims(evidence), *sheet.curves(evidence), *rig.claims(evidence))
    return tuple(sorted(claims, key=_place))


def _place(claim: Claim) -> tuple[int, ...]:
    """Return the order of a claim: the abstract first, then by the numbers of its id."""
    return tuple(int(number) for number in re.findall(r"[0-9]+", claim.id.replace("claim-a", "claim-0")))


def table(context: Context, item: Item) -> tuple[ThesisTable, ...]:
    """Tabulate every claim of every chapter, and count the verdicts."""
    claims = [product for name in item.needs for product in context.product(name) if isinstance(product, Claim)]
    claims.sort(key=_place)
    verdicts = Counter(claim.verdict for claim in claims)
    rows = map(astuple, claims)
    missing = "" if context.sheet else " The data sheet was not given: claims that rest on it could not be tested."
    notes = f"Claims in our own words. A claim holds where every part of it does.{missing}"
    counts = ((verdict, verdicts[verdict]) for verdict in get_args(Verdict))
    title, heads = "How many claims have each verdict", ("verdict", "claims")
    claims_table = replace(item.table(rows, notes), claims=tuple(claim.id for claim in claims))
    return claims_table, item.table(counts, "", heads, tail="-verdicts", title=title)
