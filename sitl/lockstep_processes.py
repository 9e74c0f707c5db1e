"""Flies a lockstep flight in several processes: each steps some agents and their vehicles, on a processor of its own.

The process that is asked leads: it steps the first part itself, has the others step theirs, and passes on between them
what agents send. Flights are the same bit for bit as in one process. In each step every process waits for the slowest.
"""

from __future__ import annotations

import signal
import traceback
from collections.abc import Callable, Sequence
from contextlib import suppress
from multiprocessing import get_context
from multiprocessing.connection import Connection
from multiprocessing.reduction import ForkingPickler
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sitl.flight_parts import OtherParts, SentMessage
from sitl.lockstep import Flown, Lockstep
from swarmctl.config import Config
from swarmctl.core.clock import Clock
from swarmctl.errors import StartError, SwarmError
from swarmctl.ops.processes import even_shares
from swarmctl.process_lifetime import serve_parent

_STEP, _ENDS_IN, _END = range(3)  # what a process is asked for
_Stepped = tuple[Sequence[SentMessage], bool]  # of a part in a step, and whether its agents have finished


class LockstepProcesses:
    """Steps one flight in several processes. As a context, it ends the others.

    Args:
        config: the run.
        directory: folder for the agents' files; None keeps everything in memory.
        jobs: processes, this one included; no more are started than there are agents.

    Attributes:
        clock: the simulated one.

    Raises:
        StartError: a process did not start.
    """

    def __init__(self, config: Config, directory: Path | None, jobs: int) -> None:
        agents = config.swarm.agents
        own, *others = even_shares(agents, min(agents, jobs))  # the leading one has the fewest
        self._workers: list[_Worker] = []
        try:
            for number, part in enumerate(others, 1):
                self._workers.append(_started(config, directory, part, number))
            following = _Following(self._workers)
            self._lead = Lockstep(config, directory, part=own, others=following if others else None)
        except BaseException:
            self._stop()
            raise
        self.clock: Clock = self._lead.clock

    def __enter__(self) -> LockstepProcesses:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop()

    def run(self, on_step: Callable[[], bool | None]) -> None:
        """Fly until every agent has landed, the time limit is reached, or `on_step` returns True."""
        self._lead.run(lambda _: on_step())

    def command(self, verb: str) -> None:
        """Send an order of the operator to all agents."""
        self._lead.command(verb)

    def end(self) -> Flown:
        """End the flight, have all files of agents written, and return what was flown."""
        for worker in self._workers:
            worker.ask(_END)
        return _joined([self._lead.end(), *(worker.answer() for worker in self._workers)])

    def _stop(self) -> None:
        for worker in self._workers:
            worker.stop()


class _Worker:
    """A process that steps a part, as the leading process sees it."""

    def __init__(self, config: Config, directory: Path | None, part: range, number: int) -> None:
        context = get_context("fork")  # there are no threads, sockets or sessions yet, and imports take a second
        self._part = part
        self._end, its_end = context.Pipe()
        self._process = context.Process(target=_work, args=(config, directory, part, number, its_end))
        self._process.start()
        its_end.close()

    def ask(self, for_what: int) -> None:
        """Ask for something; a process that has ended is noticed when it does not answer."""
        with suppress(OSError):
            self._end.send(for_what)

    def tell(self, content: bytes) -> None:
        """Pass on what everybody sent, pickled."""
        with suppress(OSError):
            self._end.send_bytes(content)

    def answer(self) -> Any:
        """Return the answer, or raise what the process raised.

        Raises:
            StartError: it has ended by itself.
        """
        try:
            answer = self._end.recv()
        except (EOFError, OSError) as error:
            told = f"agents {self._part[0]} to {self._part[-1]}: their process ended by itself"
            raise StartError(f"{told} (out of memory?); `--jobs 1` flies all in one") from error
        if isinstance(answer, BaseException):
            raise answer
        return answer

    def stop(self) -> None:
        """End it at once, if it has not ended."""
        self._end.close()
        self._process.kill()
        self._process.join()


def _started(config: Config, directory: Path | None, part: range, number: int) -> _Worker:
    """Return a worker that runs.

    Raises:
        StartError: the system has no room for one more.
    """
    try:
        return _Worker(config, directory, part, number)
    except OSError as error:
        raise StartError(f"--jobs: process {number + 1} did not start ({error.strerror}); give fewer") from error


class _Following(OtherParts):
    """The parts of the workers, as the leading process sees them."""

    def __init__(self, workers: Sequence[_Worker]) -> None:
        self._workers = workers
        self._finished = False

    def begin_step(self) -> None:
        for worker in self._workers:
            worker.ask(_STEP)

    def exchange(self, sent: Sequence[SentMessage], finished: bool) -> Sequence[SentMessage]:
        stepped: list[_Stepped] = [worker.answer() for worker in self._workers]
        self._finished = all(each for _, each in stepped)
        content = bytes(ForkingPickler.dumps([sent, *(messages for messages, _ in stepped)]))
        for worker in self._workers:
            worker.tell(content)
        return [message for messages, _ in stepped for message in messages]

    @property
    def finished(self) -> bool:
        return self._finished

    def ends_in_s(self) -> float:
        for worker in self._workers:
            worker.ask(_ENDS_IN)
        return max(float(worker.answer()) for worker in self._workers)


class _Leading(OtherParts):
    """All other parts, as a worker sees them.

    Args:
        end: of the pipe to the leading process.
        number: of this worker's messages among everybody's.
    """

    def __init__(self, end: Connection, number: int) -> None:
        self._end, self._number = end, number

    def begin_step(self) -> None:
        """Do nothing: this part ticks because it was told to."""

    def exchange(self, sent: Sequence[SentMessage], finished: bool) -> Sequence[SentMessage]:
        self._end.send((sent, finished))
        everybody: list[Sequence[SentMessage]] = self._end.recv()
        return [message for k, messages in enumerate(everybody) if k != self._number for message in messages]

    @property
    def finished(self) -> bool:
        return True

    def ends_in_s(self) -> float:
        return 0.0


def _work(config: Config, directory: Path | None, part: range, number: int, end: Connection) -> None:
    """Step a part as the leading process asks, which answers all signals that ask to stop."""
    serve_parent()
    for signum in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(signum, signal.SIG_IGN)
    with suppress(EOFError, BrokenPipeError):  # the leading process was interrupted, and has closed its end
        try:
            _obey(Lockstep(config, directory, part=part, others=_Leading(end, number)), end)
        except Exception as error:  # whatever an agent raises ends the flight
            end.send(_sendable(error))


def _obey(flight: Lockstep, end: Connection) -> None:
    """Do what is asked for until the end."""
    while (asked := end.recv()) != _END:
        if asked == _STEP:
            flight.step()
        else:
            end.send(flight.ends_in_s())
    end.send(flight.end())


def _sendable(error: Exception) -> Exception:
    """Return an error that another process can raise, with the traceback of this one."""
    if isinstance(error, SwarmError):
        return error
    return RuntimeError("".join(traceback.format_exception(error)))


def _joined(parts: Sequence[Flown]) -> Flown:
    """Return what all parts have flown, as one process would have recorded it."""
    return Flown(
        ticks={agent: rows for part in parts for agent, rows in part.ticks.items()},
        truth=np.concatenate([_by_step(part) for part in parts], axis=1).ravel(),
        events=[event for part in parts for event in part.events],
        fault_events=parts[0].fault_events,  # every part has the faults of all vehicles
        problems=[problem for part in parts for problem in part.problems],
        unwritten=tuple(line for part in parts for line in part.unwritten),
    )


def _by_step(part: Flown) -> NDArray[np.void]:
    """Return true states (T, N) of a part."""
    return part.truth.reshape(-1, len(part.ticks))
