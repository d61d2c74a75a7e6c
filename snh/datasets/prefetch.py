"""Decoding ahead of use."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import islice
from types import TracebackType

from snh.datasets.sequence import Sequence
from snh.frame import Frame


class prefetch(Iterator[Frame]):
    """Frames `indices` of a sequence in order, decoded in a background thread up to `ahead` frames before use.

    An error of a frame is raised by the `next` that would have given it, and the `next` after it goes on with the
    following frame. `close`, the end of a `with` block or of the iterator stops the thread.

    >>> with prefetch(sequence, range(len(sequence))) as frames:  # doctest: +SKIP
    ...     for frame in frames:
    ...         slam.step(frame)
    """

    def __init__(self, sequence: Sequence, indices: Iterable[int], ahead: int = 4):
        self._sequence = sequence
        self._indices = iter(indices)
        # One thread: a second one only competes for the cores that the caller computes on.
        self._pool = ThreadPoolExecutor(max_workers=1, thread_name_prefix="prefetch")
        self._pending: deque[Future[Frame]] = deque()
        self._submit(ahead)

    def _submit(self, count: int) -> None:
        for index in islice(self._indices, count):
            self._pending.append(self._pool.submit(self._sequence.__getitem__, index))

    def __next__(self) -> Frame:
        if not self._pending:
            self.close()
            raise StopIteration
        future = self._pending.popleft()
        self._submit(1)
        return future.result()

    def close(self) -> None:
        """Stops the thread after the frame that it works on; frames decoded ahead are dropped."""
        self._indices = iter(())
        self._pending.clear()
        self._pool.shutdown(wait=True, cancel_futures=True)

    def __enter__(self) -> prefetch:
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, traceback: TracebackType | None) -> None:
        self.close()

    def __del__(self) -> None:
        self._pool.shutdown(wait=False, cancel_futures=True)
