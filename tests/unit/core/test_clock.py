"""The clock of a tick, on a host whose two clocks are read one after the other."""

from __future__ import annotations

from itertools import cycle

from swarmctl.core.clock import TickClock
from swarmctl.wall_clock import WallClock

EPOCH_US = 1_700_000_000_000_000
TICK_US = 20_000


class Host:
    """A host whose UTC is read 0 or 3 us after its monotonic time."""

    def __init__(self) -> None:
        self.now_us = 5_000_000
        later_ns = cycle((0, 3_000))
        self.clock = WallClock(lambda: 1000 * self.now_us, lambda: 1000 * (EPOCH_US + self.now_us) + next(later_ns))

    def utc_of_us(self, t_us: int) -> int:
        """Return the host's UTC at a time, asked for after a tick's time."""
        self.now_us += TICK_US
        return self.clock.utc_of_us(t_us)


def test_utc_is_as_far_ahead_of_monotonic_time_in_all_of_a_tick_and_follows_the_host_between_ticks() -> None:
    host, ahead_us = Host(), set[int]()
    assert {host.utc_of_us(0) for _ in range(4)} == {EPOCH_US, EPOCH_US + 3}
    clock = TickClock(host.clock)
    for _ in range(4):
        host.now_us += TICK_US
        clock.begin_tick(host.now_us)
        in_tick_us = set[int]()
        for t_us in (0, host.now_us, 9_000_000):
            host.now_us += 3_000  # the tick goes on
            in_tick_us.add(clock.utc_of_us(t_us) - t_us)
            host.now_us += 3_000
            in_tick_us.add(clock.utc_us() - host.now_us)
        assert len(in_tick_us) == 1
        ahead_us |= in_tick_us
    assert ahead_us == {EPOCH_US, EPOCH_US + 3}
