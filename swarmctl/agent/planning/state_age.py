"""How old a vehicle's state usually is when it is used: as long as it takes from the autopilot to the agent. Pure."""

from __future__ import annotations

import math

_SETTLES_S = 10.0  # time constant of the usual age


class StateAge:
    """Tells when the vehicle was where its state says, as far as the state is old by its way alone.

    A state that is older than usual may come from a simulator whose time has stood still: its vehicle is late, and not
    merely seen late. So only the usual age is believed.
    """

    def __init__(self) -> None:
        self._usual_us: float | None = None
        self._updated_us = 0

    def seen_us(self, state_us: int, now_us: int) -> int:
        """Return the time at which a state counts that is stamped `state_us` and used now, by one clock."""
        age_us = max(0, now_us - state_us)
        if self._usual_us is None:
            self._usual_us = age_us
        share_01 = 1.0 - math.exp(-1e-6 * max(0, now_us - self._updated_us) / _SETTLES_S)
        self._updated_us = now_us
        self._usual_us += share_01 * (age_us - self._usual_us)
        return now_us - min(age_us, round(self._usual_us))
