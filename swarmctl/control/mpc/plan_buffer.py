"""The newest certified plan: the next plan is linearised around it, and it is flown when the next plan fails.

A vehicle that a gust has blown into the distance it keeps has plans that are refused, because they come closer before
they open. Each of them still comes less close than what was planned before the gust, or than braking there.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

from swarmctl.control.collision.keep_outs import KeepOut
from swarmctl.control.collision.separation import align, certify
from swarmctl.control.collision.volume_certificate import volume_margin_m
from swarmctl.control.mpc.problem import Start
from swarmctl.core.flight_volume import FlightVolume
from swarmctl.core.types import Array, Plan, PlanStatus, PredictedPath


class PlanBuffer:
    """Keeps a plan as long as it is worth flying.

    Args:
        agent: own id.
        dt_us, steps: grid of the controller's plans.
        brake_m_s2: deceleration that continues a plan beyond its end.
        volume: to stay in; None for none.
        takes_refused: a refused plan may be flown where it comes least close. Only where gusts are expected, which blow
            vehicles together although all plans are right, and not where commitments are flown.
    """

    def __init__(
        self,
        agent: int,
        dt_us: int,
        steps: int,
        brake_m_s2: float,
        *,
        volume: FlightVolume | None = None,
        takes_refused: bool = True,
    ) -> None:
        self._agent, self._dt_us, self._steps, self._brake_m_s2 = agent, dt_us, steps, brake_m_s2
        self._volume, self._takes_refused = volume, takes_refused
        self.plan: Plan | None = None

    def take(self, plan: Plan, start: Start, keep_outs: Sequence[KeepOut], fallback: Callable[[], Plan]) -> None:
        """Keep a good plan; after a bad one, of it, the one before and braking (`fallback`) what comes least close.

        None is kept where that is braking; a bad one only where it was refused for its distances.
        """
        if plan.status is PlanStatus.OK:
            self.plan = plan
            return
        kept = self.plan
        if kept is None and not self._takes_refused:
            return
        replayed_m = -math.inf if kept is None else certify(self.positions_ned_m(kept, start.t_us), keep_outs, 0)
        if replayed_m >= 0.0:
            return
        braking_m = certify(fallback().pos_ned_m, keep_outs, 0)
        if self._refused_m(plan, keep_outs) > max(replayed_m, braking_m):
            self.plan = plan
        elif replayed_m < braking_m:
            self.plan = None

    def _refused_m(self, plan: Plan, keep_outs: Sequence[KeepOut]) -> float:
        """Return the smallest margin [m] of a plan of ours that was refused for its distances alone, else -inf."""
        if not self._takes_refused or plan.by_own or plan.status is not PlanStatus.NOT_CERTIFIED:
            return -math.inf
        if not volume_margin_m(self._volume, plan.pos_ned_m, plan.vel_ned_m_s, 0) >= 0.0:
            return -math.inf
        return certify(plan.pos_ned_m, keep_outs, 0)

    def guess_ned_m(self, t0_us: int) -> Array | None:
        """Return positions (steps+1, 3) NED [m] of the plan from `t0_us` on; None without a plan or after its end."""
        if self.plan is None or t0_us - self.plan.t0_us >= self._steps * self._dt_us:
            return None
        return self.positions_ned_m(self.plan, t0_us)

    def positions_ned_m(self, plan: Plan, t0_us: int) -> Array:
        """Return positions (steps+1, 3) NED [m] of any plan from `t0_us` on."""
        path = PredictedPath(
            agent=self._agent,
            boot_id=0,
            seq=0,
            t0_utc_us=plan.t0_us,
            dt_us=plan.dt_us,
            margin_m=0.0,
            pos_ned_m=plan.pos_ned_m,
        )
        return align(path, t0_us, self._dt_us, self._steps, brake_m_s2=self._brake_m_s2)
