"""The newest certified plan: the next plan is linearised around it, and it is flown when the next plan fails."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from swarmctl.control.collision.separation import KeepOut, align, certify
from swarmctl.control.mpc.problem import Start
from swarmctl.core.types import Array, Plan, PlanStatus, PredictedPath


class PlanBuffer:
    """Keeps a plan as long as it is worth flying.

    Args:
        agent: own id.
        dt_us, steps: grid of the controller's plans.
        brake_m_s2: deceleration that continues a plan beyond its end.
    """

    def __init__(self, agent: int, dt_us: int, steps: int, brake_m_s2: float) -> None:
        self._agent, self._dt_us, self._steps, self._brake_m_s2 = agent, dt_us, steps, brake_m_s2
        self.plan: Plan | None = None

    def take(self, plan: Plan, start: Start, keep_outs: Sequence[KeepOut], fallback: Callable[[], Plan]) -> None:
        """Keep a good plan; after a bad one drop the last good one if braking (`fallback`) comes less close than it."""
        if plan.status is PlanStatus.OK:
            self.plan = plan
        elif self.plan is not None:
            replayed_m = certify(self.positions_ned_m(self.plan, start.t_us), keep_outs, 0)
            if replayed_m < 0.0 and replayed_m < certify(fallback().pos_ned_m, keep_outs, 0):
                self.plan = None

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
