"""Separation budget: every distance that keeps vehicles apart, derived in one place and explained in one sentence each.

All are between centres [m] unless their name says otherwise. `docs/separation.md` shows them in order, from touching
bodies to what plans keep. Distances differ by who enforces them: the safety filter the smallest, the certifier the
middle ones, the planner the largest, so that each acts before the next smaller one has to.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

_MAX_SLACK_01 = 0.2  # share of the distance beyond touching bodies that slack of commitments may use up
_HOME_01 = 2.0 / 3.0  # share of the radius that is left between starts when estimates have wandered


@dataclass(frozen=True, slots=True, kw_only=True)
class SeparationBudget:
    """Derives all distances of one configuration; `SeparationParams.budget` builds it.

    Args:
        body_m: distance of the centres of two vehicles that touch.
        tracking_m: tracking error that plans leave room for.
        radius_m: distance that estimated positions keep.
        certify_slack_m: what a plan may come closer than `radius_m` before it is refused.
        age_accel_m_s2, age_margin_max_m: growth of the margin around a peer with the age of its path, and its limit.
    """

    body_m: float
    tracking_m: float
    radius_m: float
    certify_slack_m: float
    age_accel_m_s2: float
    age_margin_max_m: float

    # -- safety filter ------------------------------------------------------------------------------------------------

    def barrier_m(self, margin_m: float) -> float:
        """Return the distance that the safety filter keeps from a peer on its committed trajectory."""
        return self.body_m + margin_m

    def barrier_peer_m(self, margin_m: float, peer_margin_m: float, age_margin_m: float) -> float:
        """Return the distance that the safety filter keeps from a peer that is known by its path only."""
        return self.barrier_m(margin_m) + peer_margin_m + age_margin_m

    def barrier_obstacle_m(self, margin_m: float) -> float:
        """Return the distance that the safety filter keeps between the own centre and an obstacle's surface."""
        return 0.5 * self.body_m + margin_m

    # -- before flight ------------------------------------------------------------------------------------------------

    def required_m(self, accuracy_m: float, drift_m: float = 0.0) -> float:
        """Return the least `radius_m` at which true bodies stay apart; a smaller one is refused before flight.

        It adds body, tracking error, twice the rms difference of two independent horizontal errors of rms
        `accuracy_m` each, and the drift of both vehicles when gusts blow them towards each other. At 0.9 m and default
        GPS, 6 of 16 flights of real autopilots came closer than 0.6 m in truth.
        """
        return self.body_m + self.tracking_m + 2.0 * math.sqrt(2.0) * accuracy_m + 2.0 * drift_m

    def standing_m(self, accuracy_m: float) -> float:
        """Return the least level distance at which vehicles may stand that are to take off, by their estimates.

        Autopilots climb straight up, so what is required of a radius is enough here. Starts that are `radius_m` apart
        must not be waited for because estimates of rms `accuracy_m` are.
        """
        return min(
            self.required_m(accuracy_m), self.radius_m - self.certify_slack_m - 2.0 * math.sqrt(2.0) * accuracy_m
        )

    @property
    def level_m(self) -> float:
        """Return the difference in height between vehicles on the ground above which an operator is told of it.

        Vehicles that estimate false heights pass above each other by their estimates alone.
        """
        return 0.5 * self.radius_m

    # -- hard minimum distances of plans ------------------------------------------------------------------------------

    @property
    def hard_min_distance_m(self) -> float:
        """Return the hard minimum distance of a best-effort plan: one that comes closer is never flown."""
        return self.radius_m - self.certify_slack_m

    def certified_peer_m(self, peer_margin_m: float) -> float:
        """Return the hard minimum distance to a peer that asks for `peer_margin_m` more by its path."""
        return self.radius_m + peer_margin_m - self.certify_slack_m

    def certified_obstacle_m(self, keep_out_m: float) -> float:
        """Return the hard minimum distance to the centre of an obstacle that plans keep `keep_out_m` from."""
        return keep_out_m - self.certify_slack_m

    @property
    def committed_m(self) -> float:
        """Return the hard minimum distance of two committed trajectories, which leaves room for tracking both."""
        slack_m = min(self.certify_slack_m, _MAX_SLACK_01 * max(0.0, self.radius_m - self.body_m))
        return self.radius_m - slack_m

    def radius_that_commits_m(self, committed_m: float) -> float:
        """Return the least `radius_m` by which two committed trajectories keep `committed_m`."""
        by_part_m = (committed_m - _MAX_SLACK_01 * self.body_m) / (1.0 - _MAX_SLACK_01)
        return min(committed_m + self.certify_slack_m, by_part_m)

    @property
    def tube_m(self) -> float:
        """Return how far two vehicles may both be off their committed trajectories without touching."""
        return 0.5 * (self.committed_m - self.body_m)

    # -- plans --------------------------------------------------------------------------------------------------------

    @property
    def planned_m(self) -> float:
        """Return the distance that plans keep: tracking errors then do not use up `radius_m`."""
        return self.radius_m + self.tracking_m

    def planned_peer_m(self, peer_margin_m: float, age_margin_m: float) -> float:
        """Return the distance that plans keep from a peer's path, with the peer's own margin and that of its age."""
        return self.planned_m + peer_margin_m + age_margin_m

    @property
    def planned_beyond_hard_min_m(self) -> float:
        """Return by how much the distance of plans exceeds their hard minimum, before margins of age."""
        return self.tracking_m + self.certify_slack_m

    def landing_m(self, margin_m: float) -> float:
        """Return the level distance to others at which a vehicle may land in place."""
        return self.radius_m + margin_m

    @property
    def home_m(self) -> float:
        """Return the level distance to others at which a vehicle lands at its start.

        Starts are `radius_m` apart or more. Estimates of vehicles that have landed wander on, so most of it must do.
        """
        return max(self.body_m + self.tracking_m, _HOME_01 * self.radius_m)

    # -- margins ------------------------------------------------------------------------------------------------------

    def age_margin_m(self, age_s: float, parked: bool) -> float:
        """Return how far a peer may have left a path of age `age_s`: a t^2 / 2 up to a limit, 0 for a landed one."""
        return 0.0 if parked else min(0.5 * self.age_accel_m_s2 * age_s * age_s, self.age_margin_max_m)
