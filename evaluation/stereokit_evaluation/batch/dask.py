"""A batch on a cluster: Dask hands pairs to its workers, and again to others where a worker dies.

Files are read and written by the workers, who must see them under the same paths; frames of a video are sent to
them. Only as many pairs as keep the workers busy are with the cluster at a time. A pair whose worker died may have
got its map before: the next worker keeps that map.
"""

from __future__ import annotations

import time
import uuid
import warnings
from collections.abc import Generator, Iterable
from concurrent.futures import CancelledError
from typing import Any

from stereokit.errors import OptionError, StereokitError
from stereokit_evaluation.batch.job import Job, Outcome, describe, work
from stereokit_evaluation.batch.pairs import PairFiles
from stereokit_evaluation.batch.video import FramePair

__all__ = ["connect", "on_cluster"]

_CONNECT_S = 10
_LOOK_S = 1.0
_PATIENCE_S = 120.0
"""Longest time of a cluster without workers."""
_LOST = "the Dask scheduler was lost; the same command goes on when it is back"


def connect(scheduler: str) -> Any:
    """Return a client of the scheduler at an address such as ``tcp://host:8786``, or of a scheduler file (``.json``).

    Raises
    ------
    StereokitError
        If ``distributed`` is not installed.
    OptionError
        If no scheduler answers.
    """
    try:
        from distributed import Client
    except ModuleNotFoundError as error:
        raise StereokitError("engine 'dask' needs distributed: pip install 'stereokit[dask]'") from error
    target: dict[str, Any] = {"scheduler_file" if scheduler.endswith(".json") else "address": scheduler}
    try:
        return Client(**target, timeout=_CONNECT_S, set_as_default=False)
    except (OSError, TimeoutError, ValueError) as error:
        raise OptionError(f"scheduler must be one that answers, got {scheduler!r} ({describe(error)})") from error


def on_cluster(job: Job, pairs: Iterable[PairFiles | FramePair], client: Any) -> Generator[Outcome, None, None]:
    """Work on pairs with the workers of a cluster.

    Raises
    ------
    StereokitError
        If the scheduler is lost, or there are no workers for two minutes. What was written stays.
    """
    from distributed import wait

    waiting: dict[Any, str] = {}
    source = iter(pairs)
    run = uuid.uuid4().hex[:12]
    number, slots, last_look, last_seen = 0, 0, -_LOOK_S, time.monotonic()
    has_more = True
    try:
        while has_more or waiting:
            now = time.monotonic()
            if now - last_look > _LOOK_S:
                threads = _threads(client)
                slots, last_look = 2 * threads, now
                last_seen = now if threads else last_seen
                if now - last_seen > _PATIENCE_S:
                    raise StereokitError("the Dask scheduler has had no workers for two minutes; start some, and again")
            while has_more and len(waiting) < slots:
                pair = next(source, None)
                has_more = pair is not None
                if pair is None:
                    break
                if pair.left is None or pair.right is None:
                    yield Outcome(pair.name, reason=pair.reason)
                    continue
                with warnings.catch_warnings():  # a frame is sent with its task, or it would be lost with its worker
                    warnings.filterwarnings("ignore", "Sending large graph", UserWarning)
                    key = f"stereokit-{run}-{number}"
                    future = client.submit(work, job, pair.name, pair.left, pair.right, key=key, pure=False)
                waiting[future] = pair.name
                number += 1
            if not waiting:
                time.sleep(_LOOK_S / 5 if has_more else 0)
                continue
            try:
                with client.as_current():
                    done = wait(list(waiting), timeout=_LOOK_S, return_when="FIRST_COMPLETED").done
            except TimeoutError:
                continue
            except CancelledError:  # the client gives up all that it waited for when its connection ends
                raise StereokitError(_LOST) from None
            for future in done:
                if future.status in ("pending", "lost"):  # its worker died with the result; another repeats it
                    continue
                yield _result(future, waiting.pop(future))
    finally:
        if waiting and client.status == "running":
            client.cancel(list(waiting))


def _threads(client: Any) -> int:
    try:
        return sum(client.nthreads().values())
    except (OSError, RuntimeError):
        raise StereokitError(_LOST) from None


def _result(future: Any, name: str) -> Outcome:
    try:
        if future.status == "error":  # the task itself raises nothing: its workers died, again and again
            return Outcome(name, reason=describe(future.exception()))
        outcome: Outcome = future.result()
        return outcome
    except (CancelledError, OSError):
        raise StereokitError(_LOST) from None
