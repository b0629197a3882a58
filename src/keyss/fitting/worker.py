"""The process that fits one plain model: `python -m keyss.fitting.worker FD`.

FD is the descriptor of a `multiprocessing` connection to the process that started this one. The standard
input is a pipe that closes when that process ends.
"""

from __future__ import annotations

import os
import pickle
import signal
import sys
import time
import traceback
from dataclasses import replace
from multiprocessing.connection import Connection

from keyss._processes import end_with_parent
from keyss.core.errors import Interrupted, signal_of
from keyss.fitting import loop
from keyss.fitting.side_by_side import POLL, Fit, fitted
from keyss.progress import Reporter


class _Sender(Reporter):
    """Sends progress, at most ten times a second unless numbers change."""

    def __init__(self, connection: Connection, loss_every: int) -> None:
        self.connection, self.loss_every = connection, loss_every
        self.sent, self.numbers = 0.0, dict[str, float]()

    def start(self, title: str, iterations: int, iteration: int) -> None:
        self.iterations = iterations

    def update(self, iteration: int, gaussians: int, numbers: dict[str, float]) -> None:
        now = time.monotonic()
        if numbers != self.numbers or iteration == self.iterations or now - self.sent >= POLL:
            self.sent, self.numbers = now, dict(numbers)
            _send(self.connection, (iteration, gaussians, self.numbers))


def _send(connection: Connection, message: object) -> None:
    # Connection.send would move tensors to shared memory, which may be small.
    connection.send_bytes(pickle.dumps(message))


def main(descriptor: int) -> None:
    """Send None, receive a fit, and send its progress and its model or error.

    An interrupted fit ends the process with the exit status of the signal.
    """
    loop.patient = True
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    end_with_parent()
    with Connection(descriptor) as connection:
        _send(connection, None)
        fit: Fit
        fit, resume, loss_every = pickle.loads(connection.recv_bytes())
        answer: object
        try:
            answer = fitted(replace(fit, reporter=_Sender(connection, loss_every)), "cpu", resume)
        except Interrupted as interrupt:
            os._exit(128 + signal_of(interrupt))
        except Exception as error:
            error.add_note(traceback.format_exc())
            answer = error
        _send(connection, answer)


if __name__ == "__main__":
    main(int(sys.argv[1]))
