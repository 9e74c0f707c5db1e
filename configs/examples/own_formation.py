"""An own mission: a swarm changes from formation to formation, flown by configs/examples/own_formation.toml.

Which agent flies to which slot is chosen anew for every change, so that the sum of the squared distances is least.
Agents that begin and arrive together on straight lines don't meet then, if the slots of both formations are far enough
apart (Turpin, Michael, Kumar, IJRR 2014). Every agent computes the same assignment from the same starts: nobody leads.
"""

from typing import Annotated

import numpy as np
from pydantic import Field
from scipy.optimize import linear_sum_assignment

from swarmctl.control.reference.kind import MissionKind
from swarmctl.core.params import Params, Vec3


class Slots(Params):
    slots_ned_m: Annotated[tuple[Vec3, ...], Field(strict=False)]  # one for each agent, in any order


class Formations(MissionKind):
    formations: tuple[Slots, ...] = Field((), strict=False)  # in the order in which they are flown
    change_s: float = Field(5.0, gt=0, le=600)  # duration of each change
    stay_s: float = Field(2.0, ge=0, le=600)  # time in each formation, and before the first change
    assigned: bool = True  # false: agent i flies to slot i, and references may cross

    def problems(self, agents):
        for number, formation in enumerate(self.formations):
            if len(formation.slots_ned_m) != agents:
                yield f"formations.{number}: {len(formation.slots_ned_m)} slots for swarm.agents = {agents}"

    def reference(self, place):
        """Return a function of mission times (K,) that returns positions and velocities, (K, 3) each, NED."""
        places = np.array([stop[place.agent] for stop in self._stops(place.starts_ned_m)])  # (formations + 1, 3)

        def sampled(t_s):
            pos, vel = np.tile(places[0], (len(t_s), 1)), np.zeros((len(t_s), 3))
            for number, way in enumerate(np.diff(places, axis=0)):
                begin_s = number * (self.stay_s + self.change_s) + self.stay_s
                tau = np.clip((t_s - begin_s) / self.change_s, 0.0, 1.0)[:, None]
                pos += way * tau**3 * (10.0 - 15.0 * tau + 6.0 * tau**2)  # at rest at both ends
                vel += way / self.change_s * 30.0 * tau**2 * (1.0 - tau) ** 2
            return pos, vel

        return sampled

    def _stops(self, starts_ned_m):
        """Return where all agents are, (agents, 3), at the start and in each formation."""
        stops = [starts_ned_m]
        for formation in self.formations:
            slots = np.array(formation.slots_ned_m)
            squared_m2 = ((stops[-1][:, None] - slots[None]) ** 2).sum(axis=2)
            chosen = linear_sum_assignment(squared_m2)[1] if self.assigned else np.arange(len(slots))
            stops.append(slots[chosen])
        return stops
