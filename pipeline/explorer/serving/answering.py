"""Answer the requests for one run in worker threads, whatever carries them: HTTP or the messages of a notebook."""

from __future__ import annotations

import logging
import threading
from concurrent.futures import Future, ThreadPoolExecutor

from pipeline.explorer.data.explored import ExploredRun
from pipeline.explorer.live.live import LiveRun, live_problem
from pipeline.explorer.serving.answers import ANSWERS, Answer, Query, Reply, first_answers
from pipeline.specification.problems import SpecError
from pipeline.store.errors import StoreError
from pipeline.store.run import RunDirectory

LOG = logging.getLogger(__name__)

THREADS, MOST_WAITING = 3, 12
"""Requests that are worked on at once, and those that may wait besides."""


class RefusedRequestError(Exception):
    """Raised for a request that is not answered with data.

    Attributes
    ----------
    status : int
        As in HTTP: 400 the request is wrong, 429 too many wait, 500 the run cannot be read.
    """

    def __init__(self, status: int, sentence: str) -> None:
        super().__init__(sentence)
        self.status = status


class Answering:
    """A run that answers requests for data, with the state that all its requests share.

    Requests are answered in a few threads, and what waits is bounded.

    Parameters
    ----------
    run
        Run to show.
    """

    def __init__(self, run: RunDirectory) -> None:
        self.run = ExploredRun.of(run)
        self.live_problem = live_problem(self.run)
        self.live = None if self.live_problem else LiveRun(self.run)
        self.pool = ThreadPoolExecutor(THREADS, "explorer")
        self.waiting = 0
        self.compiled: Future[None] | None = None
        self._lock = threading.Lock()

    def warm(self) -> None:
        """Compute what the page requests first; then compile the code for live computation, in the background."""
        first = self.pool.submit(first_answers, self.run, self.live)
        if self.live is None:
            return
        live, compiled = self.live, Future[None]()
        self.compiled = compiled

        def tell(done: int, total: int) -> None:
            if live.is_warm("series") and not compiled.done():
                compiled.set_result(None)

        # what is compiled would hold up the first picture
        first.add_done_callback(lambda done: None if done.cancelled() else live.warm(tell))

    def ask(self, name: str, query: Query) -> Future[Reply]:
        """Start to answer a request, and return at once.

        A request that integrates first waits until the code is compiled, and takes no thread meanwhile.

        Returns
        -------
        Future
            The reply; RefusedRequestError if there is none.
        """
        found: Future[Reply] = Future()
        found.set_running_or_notify_cancel()
        answer = ANSWERS[name]
        with self._lock:
            accepted = self.waiting < THREADS + MOST_WAITING
            self.waiting += accepted
        if not accepted:
            sentence = "more is asked at once than may wait; try again in a moment"
            found.set_exception(RefusedRequestError(429, sentence))
            return found
        compiled = self.compiled
        if answer.integrates and compiled is not None:
            compiled.add_done_callback(lambda done: self._submit(answer, query, found))
        else:
            self._submit(answer, query, found)
        return found

    def _submit(self, answer: Answer, query: Query, found: Future[Reply]) -> None:
        try:
            self.pool.submit(self._answer, answer, query, found)
        except RuntimeError:  # the pool is closed
            self._end(found, RefusedRequestError(500, "this run is closed"))

    def _answer(self, answer: Answer, query: Query, found: Future[Reply]) -> None:
        try:
            if answer.fresh:
                self.run = self.run.refreshed()
            self.run.check_axes(query.at)
            reply = answer.give(self.run, query, self.live)
        except Exception as error:
            self._end(found, refusal_of(error, answer.name))
        else:
            self._end(found, reply)

    def _end(self, found: Future[Reply], result: Reply | RefusedRequestError) -> None:
        with self._lock:
            self.waiting -= 1
        if isinstance(result, Reply):
            found.set_result(result)
        else:
            found.set_exception(result)

    def close(self) -> None:
        """Cancel the requests that wait, and end live computation."""
        self.pool.shutdown(wait=False, cancel_futures=True)
        if self.live is not None:
            self.live.close()


def refusal_of(error: Exception, name: str) -> RefusedRequestError:
    """Return what is told of an error: a sentence for the user; an unexpected one is told to the log alone."""
    if isinstance(error, StoreError | OSError):
        return RefusedRequestError(500, str(error))
    if isinstance(error, SpecError):
        return RefusedRequestError(400, " ".join(error.problems))
    if isinstance(error, ValueError | ArithmeticError):
        return RefusedRequestError(400, str(error))
    LOG.error("api/%s", name, exc_info=error)
    return RefusedRequestError(500, "something went wrong that magpend did not expect; its terminal says what")
