"""The safety filter in flight: gives the barrier function the known bodies, and records when it acts."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from swarmctl.agent.sensing.world_model import WorldModel
from swarmctl.control.collision.barrier import Barrier, BarrierParams
from swarmctl.control.estimation.disturbance import Estimate
from swarmctl.control.model import VehicleModelParams
from swarmctl.control.mpc.problem import Start
from swarmctl.core.trajectory import Trajectory
from swarmctl.core.types import Array

_QUIET_US = 500_000  # without a change of the input, after which an encounter counts as over


class SafetyFilter:
    """Replaces the virtual controls of a tick when bodies would touch otherwise.

    Args:
        params, vehicle: see `Barrier`.
        dt_s: time between two commands.
        world_model: source of bodies.
        downwash: see `SeparationParams`.
        note: is told `safety_filter`, with `acts=True` when an encounter begins and `acts=False, ticks=...` at its end.
        stopwatch_ns: measures the filter and has no influence.
    """

    def __init__(
        self,
        params: BarrierParams,
        vehicle: VehicleModelParams,
        dt_s: float,
        world_model: WorldModel,
        *,
        downwash: float,
        note: Callable[..., None],
        stopwatch_ns: Callable[[], int],
    ) -> None:
        self._params, self._world_model, self._note = params, world_model, note
        self._barrier = Barrier(params, vehicle, dt_s, downwash)
        self._stopwatch_ns = stopwatch_ns
        self._ticks, self._last_us = 0, 0
        self.acts, self.duration_ms = False, 0.0  # in the newest tick

    def keep_apart(
        self,
        now_us: int,
        act_utc_us: int,
        virtual_control: Array,
        start: Start,
        *,
        estimate: Estimate,
        flies: bool,
        committed_peers: Mapping[int, Sequence[Trajectory]],
    ) -> Array:
        """Return the virtual controls (3,) to fly from `act_utc_us` on; unchanged ones unless the agent `flies`.

        After an encounter it acts on until the plan's controls are as near as attitudes follow.

        Peers in `committed_peers` are placed on the trajectories they have committed to, others on their paths.
        """
        began_ns, changed = self._stopwatch_ns(), None
        if self._params.enabled and flies:
            wanted = self._barrier.eased(virtual_control, start) if self.acts else virtual_control
            changed = self._barrier.filtered(
                wanted,
                start,
                estimate.disturbance_ned_m_s2,
                estimate.hover_thrust_01,
                bodies=self._world_model.bodies(
                    start.pos_ned_m,
                    act_utc_us,
                    self._barrier.ahead_s,
                    self._params.margin_m,
                    committed_peers=committed_peers,
                ),
            )
            if changed is None and wanted is not virtual_control:
                changed = wanted
        self._count(now_us, changed is not None)
        self.duration_ms = (self._stopwatch_ns() - began_ns) * 1e-6
        return virtual_control if changed is None else changed

    def skip(self, now_us: int) -> None:
        """Record a tick in which the agent sends no setpoint."""
        self._count(now_us, False)
        self.duration_ms = 0.0

    def _count(self, now_us: int, acts: bool) -> None:
        self.acts = acts
        if acts:
            if not self._ticks:
                self._note("safety_filter", acts=True)
            self._ticks, self._last_us = self._ticks + 1, now_us
        elif self._ticks and now_us - self._last_us > _QUIET_US:
            self._note("safety_filter", acts=False, ticks=self._ticks)
            self._ticks = 0
