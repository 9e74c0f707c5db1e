"""Parameters of planning with commitments, and those of the MPCs that plan and that track them."""

from __future__ import annotations

from pydantic import Field

from swarmctl.control.model import VehicleModelParams
from swarmctl.control.mpc.mpc_params import AxisWeights, MpcParams
from swarmctl.core.frames import GRAVITY_M_S2
from swarmctl.core.params import Params

_FOLLOWING_MOVES_Z = 10
_MARGIN_M, _MARGIN_M_S2, _MARGIN_S = 0.01, 4.0, 0.1  # two cubics of so much acceleration leave their chords by so much
_MODEST_LEAD_S = 0.5  # proposals with a longer lead may be longer than others count on


class CommitParams(Params):
    """Sets up planning with `separation.mode = "guaranteed"`."""

    dt_s: float = Field(0.1, ge=0.05, le=0.5)  # time between two points of a trajectory
    horizon: int = Field(20, ge=5, le=60)  # steps before the final braking
    moves: int = Field(8, ge=2, le=40)  # control horizon: steps after which the input is constant; at most horizon
    brake_m_s2: float = Field(1.5, ge=0.5, le=10)  # deceleration of the final braking
    tilt_fraction_01: float = Field(  # share of the controller's tilt that plans may use; the rest is for tracking
        0.8, gt=0, le=1
    )
    period_s: float = Field(0.1, ge=0, le=2)  # least time between two plans
    lead_min_s: float = Field(0.06, ge=0.02, le=2)  # least time from proposing to flying; the vehicle may need more
    lead_max_s: float = Field(1.5, ge=0.1, le=5)  # longest such lead, however late the others answer
    clock_error_max_s: float = Field(1.0, ge=0.01, le=10)  # nothing is proposed while a peer's clock is known less well
    right_of_way_rad: float = Field(1.0, ge=0, le=1.2)  # overrides `separation`: plans with stops lock sooner
    stuck_m: float = Field(1.0, gt=0, le=10)  # overrides `separation`: agents that meet turn while they still move
    follow_z: AxisWeights = AxisWeights(q_pos=20.0, q_vel=0.5, r=0.05)  # tracks commitments to the centimetre

    def stretch_m(self, speed_m_s: float) -> float:
        """Return the length [m] of the longest proposal that is no faster than this, with its final braking."""
        return speed_m_s * (self.horizon * self.dt_s + _MODEST_LEAD_S) + self.stop_m(speed_m_s)

    def stop_m(self, speed_m_s: float) -> float:
        """Return the way [m] on which a vehicle brakes to rest."""
        return 0.5 * speed_m_s**2 / self.brake_m_s2

    def for_vehicle(self, vehicle: VehicleModelParams) -> CommitParams:
        """Return parameters by which a proposal leaves what is committed no sooner than the vehicle can.

        Until the vehicle responds it flies on as before, and is then beside what it has committed to: six PX4s, which
        respond after 0.28 s, left tubes of 10 cm 68 to 136 times in a flight with a lead of 0.14 s, and 38 times with
        0.28 s.
        """
        return self.model_copy(update={"lead_min_s": max(self.lead_min_s, vehicle.response_s)})


def following(mpc: MpcParams, params: CommitParams) -> MpcParams:
    """Return controller parameters for tracking commitments: z is stiffer, and freer, than for a desired reference.

    With the three moves of the thesis, heights of a commitment that begins to climb are missed by 0.16 m.
    """
    return mpc.model_copy(update={"z": params.follow_z, "control_z": max(mpc.control_z, _FOLLOWING_MOVES_Z)})


def interpolation_margin_m(mpc: MpcParams, params: CommitParams, vehicle: VehicleModelParams) -> float:
    """Return what proposals keep on top, as they are checked as straight lines between points and flown as cubics.

    With an acceleration of a that leaves the line by a dt_s^2 / 8, for each of two vehicles.
    """
    accel_m_s2 = planning(mpc, params, vehicle).accel_max_m_s2(vehicle)
    return _MARGIN_M * max(1.0, max(1.0, accel_m_s2 / _MARGIN_M_S2) * (params.dt_s / _MARGIN_S) ** 2)


def planning(mpc: MpcParams, params: CommitParams, vehicle: VehicleModelParams) -> MpcParams:
    """Return controller parameters on the planner's grid, with bounds that leave room for tracking."""
    return mpc.model_copy(
        update={
            "dt_s": params.dt_s,
            "discretisation": "zoh",
            "thrust_ahead": "held",
            "control_z": params.moves,
            "horizon_z": params.horizon,
            "control_xy": params.moves,
            "horizon_xy": params.horizon,
            "blocking_xy": "none",
            "u_max": params.tilt_fraction_01 * min(mpc.u_max, vehicle.u_max()),
            "thrust_min_m_s2": max(mpc.thrust_min_m_s2, 0.7 * GRAVITY_M_S2),
            "thrust_max_m_s2": min(mpc.thrust_max_m_s2, 1.4 * GRAVITY_M_S2),
            "terminal_z": "none",
            "terminal_xy": "none",
            "proximal_xy": 0.0,  # proposals answer commitments, which stand
        }
    )
