"""What must be met before an agent arms its vehicle. Pure."""

from __future__ import annotations

from swarmctl.control.phases.inputs import PhaseInputs
from swarmctl.core.types import Landed, Phase, VehicleState


def unmet_start_condition(inputs: PhaseInputs, state: VehicleState, peers: int) -> str:
    """Return the first condition for arming that is not met, or ""; `peers` is the number of the other agents."""
    if state.landed not in (Landed.ON_GROUND, Landed.IN_AIR):
        return "the autopilot to tell whether it has landed"
    if not inputs.armable:
        return f"the autopilot to be ready to arm (it is in {state.mode.name})"
    if inputs.unsettled:
        return inputs.unsettled
    absent = peers - sum(p.phase >= Phase.STANDBY and p.alive for p in inputs.peers.values())
    if absent:
        return f"{absent} of {peers} peers to stand by"
    return "the autopilot's answers" if inputs.busy else ""
