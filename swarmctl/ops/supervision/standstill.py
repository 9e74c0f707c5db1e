"""For how long a process has not run, by the processor time that it has used: evidence, unlike its silence."""

from __future__ import annotations

from swarmctl.ops.processes import Child


class Standstill:
    """Measures standstills of processes. A process that only waits for its next tick uses some time in every second."""

    def __init__(self) -> None:
        self._seen: dict[int, tuple[float, float]] = {}  # by process: its processor time, since when it is that

    def lasts_s(self, child: Child, now_s: float) -> float:
        """Return for how long a process has used no processor time, 0 at the first look and in a debugger.

        Args:
            child: the process.
            now_s: monotonic time.
        """
        used_s = child.processor_s()
        if used_s is None:
            self._seen.pop(child.pid, None)
            return 0.0
        before_s, since_s = self._seen.get(child.pid, (-1.0, now_s))
        if used_s != before_s:
            since_s = now_s
        self._seen[child.pid] = used_s, since_s
        return now_s - since_s
