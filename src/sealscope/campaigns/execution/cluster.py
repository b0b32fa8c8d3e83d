"""Cases on the workers of a Dask scheduler; the rows are the same as on this machine."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

from sealscope.campaigns.cases.case import CampaignCase, code_key
from sealscope.campaigns.cases.row import CaseRow
from sealscope.errors import InputError, MissingExtra

#: Cases handed out ahead of each worker, so that it never waits.
_AHEAD = 4


def on_cluster(
    task: Callable[[CampaignCase], CaseRow], cases: Sequence[CampaignCase], address: str
) -> Iterator[CaseRow]:
    """Yield the rows of the cases from the workers of the scheduler at `address` (`tcp://host:8786`), as they end.

    The workers need the same Sealscope, and the folder where recordings are stored. Raises MissingExtra without Dask,
    InputError where no scheduler answers.
    """
    try:
        import distributed
    except ImportError:
        raise MissingExtra("a cluster needs Dask: pip install 'sealscope[cluster]'") from None
    dask: Any = distributed
    try:
        client = dask.Client(address, timeout=10, set_as_default=False)
    except (OSError, ValueError, TimeoutError) as error:
        raise InputError(f"--cluster must be the address of a Dask scheduler, got {address}: {error}") from None
    with client:
        _check_code(client, address)
        shared = client.scatter(task, broadcast=True)
        waiting = iter(cases)
        by_key: dict[str, CampaignCase] = {}

        def submit(case: CampaignCase) -> Any:
            by_key[f"case-{case.id}"] = case
            return client.submit(_carry_out, shared, case, key=f"case-{case.id}", pure=False, retries=1)

        width = _AHEAD * max(1, sum(client.nthreads().values()))
        first = [submit(case) for _, case in zip(range(width), waiting, strict=False)]
        futures = dask.as_completed(first, loop=client.loop)
        for future in futures:
            case, failure = by_key.pop(future.key), future.exception()
            if failure is None:
                yield future.result()
            else:
                yield CaseRow.of(case, error=f"a worker failed: {failure}".splitlines()[0])
            future.release()
            following = next(waiting, None)
            if following is not None:
                futures.add(submit(following))


def _carry_out(task: Callable[[CampaignCase], CaseRow], case: CampaignCase) -> CaseRow:
    return task(case)


def _check_code(client: Any, address: str) -> None:
    """Refuse workers that would make other rows."""
    if not client.nthreads():
        raise InputError(f"--cluster must have workers, got none ({address})")
    try:
        keys = client.run(code_key).values()
    except Exception as error:
        raise InputError(
            f"the cluster's workers must have Sealscope, got: {error} ({address})".splitlines()[0]
        ) from None
    if any(key != code_key() for key in keys):
        raise InputError(f"the cluster's workers must have the same Sealscope as this machine, got another ({address})")
