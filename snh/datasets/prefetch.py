"""Decoding ahead of use."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import islice

from snh.datasets.sequence import FrameError, Sequence
from snh.frame import Frame


def prefetch(sequence: Sequence, indices: Iterable[int], ahead: int = 4) -> Iterator[Frame | FrameError]:
    """Frames `indices` of a sequence in order, decoded in a background thread up to `ahead` frames before use.

    A damaged frame comes as its FrameError in its place, so that the caller can say so and go on; any other error is
    raised at the frame that caused it. The thread ends with the iterator: at its end, at an error, or at `close()`.

    >>> for frame in prefetch(sequence, range(len(sequence))):  # doctest: +SKIP
    ...     if isinstance(frame, FrameError):
    ...         print(f"frame {frame.index} is skipped: {frame}")
    ...     else:
    ...         slam.step(frame)
    """

    def read(index: int) -> Frame | FrameError:
        try:
            return sequence[index]
        except FrameError as error:
            return error

    remaining = iter(indices)
    # One thread: a second one only competes for the cores that the caller computes on.
    pool = ThreadPoolExecutor(max_workers=1, thread_name_prefix="prefetch")
    try:
        pending: deque[Future[Frame | FrameError]] = deque(pool.submit(read, i) for i in islice(remaining, ahead))
        while pending:
            item = pending.popleft().result()
            pending.extend(pool.submit(read, i) for i in islice(remaining, 1))
            yield item
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
