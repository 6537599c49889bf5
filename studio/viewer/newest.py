"""A thread for work of which only the newest matters: a new job cancels the one at work."""

import logging
import threading
from collections.abc import Callable

from studio.cancellation import Cancellation, CancelledError

Job = Callable[[Cancellation], None]

log = logging.getLogger(__name__)


class Newest:
    """A thread that does the newest job. Its methods may be called from any thread."""

    def __init__(self, name: str, rest: float = 0.0) -> None:
        """Start the thread; a job begins once there was no newer one for `rest` seconds."""
        self._rest = rest
        self._change = threading.Condition()
        self._job: tuple[Job, Cancellation] | None = None
        self._at_work: Cancellation | None = None
        self._stopping = False
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def put(self, job: Job) -> None:
        """Do this job, and give up any other."""
        self._replace((job, Cancellation()))

    def cancel(self) -> None:
        """Give up whatever waits or is at work."""
        self._replace(None)

    def stop(self) -> None:
        """End the thread; wait for it for at most five seconds."""
        self._stopping = True
        self._replace(None)
        self._thread.join(timeout=5.0)

    def _replace(self, job: tuple[Job, Cancellation] | None) -> None:
        with self._change:
            before = [c for c in (self._at_work, self._job and self._job[1]) if c]
            self._job = job
            self._change.notify()
        for cancellation in before:
            cancellation.cancel()

    def _run(self) -> None:
        while not self._stopping:
            with self._change:
                self._change.wait_for(lambda: self._job or self._stopping)
                while self._job and self._change.wait(self._rest):
                    pass  # a newer job came: its rest begins
                if self._job is None:
                    continue
                (job, cancellation), self._job = self._job, None
                self._at_work = cancellation
            try:
                job(cancellation)
            except CancelledError:
                pass
            except Exception:  # the thread must outlive a job that fails
                log.exception("a job of %s failed", self._thread.name)
            finally:
                with self._change:
                    self._at_work = None
