"""How an agent keeps apart from its peers: a policy turns each tick into one directive that the tick obeys.

`BestEffort` plans around the predicted paths of peers. `Guaranteed` follows trajectories that every
participant has acknowledged. The tick doesn't know which of them is in force.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

from swarmctl.agent.planning.coordination import Coordination
from swarmctl.agent.planning.state_age import StateAge
from swarmctl.agent.sensing.world_model import WorldModel
from swarmctl.control.collision.keep_outs import NO_KEEP_OUTS, KeepOut, KeepOuts
from swarmctl.control.commit.situation import DesiredReference
from swarmctl.core.trajectory import Times, Trajectory
from swarmctl.core.types import Array, Phase, Reference, VehicleState


@dataclass(frozen=True, slots=True, kw_only=True)
class SeparationInputs:
    """Collects what a policy is told in a tick in which the agent flies its vehicle."""

    utc_us: int
    state: VehicleState
    state_utc_us: int  # of its stamp
    phase: Phase
    desired: DesiredReference  # motion the agent would follow if it were alone
    horizon_utc_us: Times  # (longest+1,) times of the controller's reference
    keep_outs: KeepOuts  # of peers and obstacles, on the controller's grid
    disturbance_ned_m_s2: Array  # (3,) estimated acceleration by wind


@dataclass(frozen=True, slots=True, kw_only=True)
class SeparationDirective:
    """Says what keeps a vehicle apart from its peers in one tick; the default asks for nothing."""

    reference: Reference | None = None  # replaces the desired reference where there is one
    keep_outs: KeepOuts = NO_KEEP_OUTS  # that the controller's plan has to respect
    committed_peers: Mapping[int, Sequence[Trajectory]] = field(default_factory=dict)  # for the safety filter
    lost_peer_keep_outs: tuple[KeepOut, ...] = ()  # may deadlock an agent, as those of the world model
    unresponsive_peer: bool = False  # the mission has to wait for a peer that may be flying on unseen
    cut_off: str = ""  # why the mission has to end where the vehicle is, because peers don't answer
    alert: str = ""  # what the operator has to know about it
    margin_m: float = 0.0  # peers have to keep this much more, because the vehicle isn't flown as it was committed to
    as_committed: bool = False  # the vehicle is where it was committed to be, so that peers know without its path
    duration_ns: int = 0  # time spent on agreeing with peers


class SeparationPolicy(Protocol):
    """Keeps one agent apart from its peers."""

    @property
    def uses_commitments(self) -> bool:
        """Return whether the agent flies only trajectories it has committed to, as its status tells peers."""

    @property
    def commits_refused(self) -> int | None:
        """Return the number of proposals withdrawn or expired; None if the policy makes no proposals."""

    def receive(self, utc_us: int) -> None:
        """Take in the messages that peers have sent for this policy."""

    def step(self, inputs: SeparationInputs) -> SeparationDirective:
        """Return the directive of a tick in which the agent flies its vehicle along its reference."""

    def idle(self, utc_us: int, state: VehicleState | None, keep_outs: KeepOuts) -> SeparationDirective:
        """Return the directive of a tick in which it does not: a pilot or a failsafe flies."""

    def wait(self, utc_us: int, state: VehicleState | None) -> SeparationDirective:
        """Return the directive of a tick whose newest state, if there is any, is stale."""

    def publish(self, utc_us: int, *, unsure_m: float, relays: bool) -> None:
        """Publish the messages that peers need for this policy.

        Args:
            utc_us: now.
            relays: pass on what peers lack of each other, which an agent without time for it does not.
            unsure_m: by how much more the vehicle may be away from its estimate than distances leave room for.
        """


class BestEffort:
    """Plans around the predicted paths of peers; nothing is agreed with them.

    Args:
        world_model: knows which peers are unresponsive.
    """

    uses_commitments = False
    commits_refused = None

    def __init__(self, world_model: WorldModel) -> None:
        self._world_model = world_model

    def receive(self, utc_us: int) -> None:
        """Do nothing: the world model receives the paths of peers."""

    def step(self, inputs: SeparationInputs) -> SeparationDirective:
        """Pass all keep-outs to the controller."""
        return self.idle(inputs.utc_us, inputs.state, inputs.keep_outs)

    def idle(self, utc_us: int, state: VehicleState | None, keep_outs: KeepOuts) -> SeparationDirective:
        """Pass all keep-outs to the controller, which plans also while a failsafe brakes."""
        return SeparationDirective(
            keep_outs=keep_outs, unresponsive_peer=self._world_model.has_unresponsive_peer(utc_us)
        )

    def wait(self, utc_us: int, state: VehicleState | None) -> SeparationDirective:
        """Ask for nothing: there is no plan."""
        return self.idle(utc_us, state, NO_KEEP_OUTS)

    def publish(self, utc_us: int, *, unsure_m: float, relays: bool) -> None:
        """Do nothing: the agent publishes its path in every mode."""


class Guaranteed:
    """Follows the trajectory that this agent has committed to.

    Unresponsive peers are no matter of the mission: without their acknowledgements the agent comes to rest.

    Args:
        coordination: this agent's part in the protocol.
        yaw_rad: heading of the reference.
        stopwatch_ns: measures the protocol and has no influence.
    """

    uses_commitments = True

    def __init__(self, coordination: Coordination, yaw_rad: float, stopwatch_ns: Callable[[], int]) -> None:
        self._coordination, self._yaw_rad, self._stopwatch_ns = coordination, yaw_rad, stopwatch_ns
        self._state_age = StateAge()

    @property
    def commits_refused(self) -> int | None:
        """Return the number of proposals withdrawn or expired."""
        return self._coordination.counts.withdrawn + self._coordination.counts.expired

    def receive(self, utc_us: int) -> None:
        """Take in the trajectory messages of peers."""
        self._coordination.receive(utc_us)

    def step(self, inputs: SeparationInputs) -> SeparationDirective:
        """Agree with peers, then follow the committed trajectory, which keeps clear of all keep-outs already."""
        began_ns, coordination = self._stopwatch_ns(), self._coordination
        coordination.step(
            inputs.utc_us,
            inputs.state,
            inputs.phase,
            inputs.desired,
            state_utc_us=self._state_age.seen_us(inputs.state_utc_us, inputs.utc_us),
            disturbance_ned_m_s2=inputs.disturbance_ned_m_s2,
        )
        duration_ns = self._stopwatch_ns() - began_ns
        pos, vel = coordination.sample_committed(inputs.horizon_utc_us)
        return SeparationDirective(
            reference=Reference(pos, vel, self._yaw_rad),
            committed_peers=coordination.committed_peers,
            lost_peer_keep_outs=tuple(coordination.lost_peer_keep_outs),
            cut_off=coordination.cut_off,
            alert=coordination.alert,
            margin_m=coordination.margin_m,
            as_committed=coordination.is_held,
            duration_ns=duration_ns,
        )

    def idle(self, utc_us: int, state: VehicleState | None, keep_outs: KeepOuts) -> SeparationDirective:
        """Commit nothing, and leave it to the controller to keep clear."""
        self._coordination.idle(utc_us, state)
        return SeparationDirective(keep_outs=keep_outs)

    def wait(self, utc_us: int, state: VehicleState | None) -> SeparationDirective:
        """Keep what is committed for a moment: the vehicle still flies it when the gap is short."""
        self._coordination.wait(utc_us, state)
        return SeparationDirective(margin_m=self._coordination.margin_m)

    def publish(self, utc_us: int, *, unsure_m: float, relays: bool) -> None:
        """Publish the committed trajectory, the proposal and the acknowledgements."""
        self._coordination.publish(utc_us, unsure_m=unsure_m, relays=relays)
