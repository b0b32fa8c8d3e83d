"""From the single tests of a claim to its verdict: one rule for all claims."""

from __future__ import annotations

from collections.abc import Sequence

from sealscope.thesis.engine.products import Verdict


def verdict_of(tests: Sequence[bool | None]) -> Verdict:
    """`holds` where every test passed, `does not hold` where none did, `holds in part` between; tests that could not
    be made (None) do not count, and without any other the claim `cannot be tested`."""
    made = [test for test in tests if test is not None]
    if not made:
        return "cannot be tested"
    if all(made):
        return "holds"
    return "holds in part" if any(made) else "does not hold"
