"""Airframes: the numbers of a vehicle and their sources. No equations."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class Preset:
    """The numbers of an airframe at nominal mass."""

    name: str
    mass_kg: float
    inertia_kg_m2: tuple[float, float, float]
    arm_m: float
    rotor_force_max_n: float  # each of four
    yaw_per_force_m: float  # d / b of the thesis: yaw torque of a rotor over its force
    thrust_coeff_n_s2: float  # b: rotor force over W^2
    rotor_inertia_kg_m2: float  # Jr
    drag_rotation_1_s: tuple[float, float, float]  # kp, kq, kr
    drag_n_s_m: tuple[float, float, float]  # ku, kv, kw times the nominal mass, body axes
    drag_scales_with_mass: bool  # thesis: an acceleration, independent of the mass; SIH: a force
    motor_tau_s: float  # 0: no lag
    rotor_radius_m: float  # of each rotor's disc, for power and ground effect
    cells: int = 4  # lithium-polymer cells in series

    @property
    def thrust_max_n(self) -> float:
        """Collective thrust at setpoint 1.0 [N]."""
        return 4.0 * self.rotor_force_max_n


PRESETS = {
    "thesis": Preset(
        name="thesis",  # thesis Table 1
        mass_kg=1.0,
        inertia_kg_m2=(8e-3, 8e-3, 14.2e-3),
        arm_m=0.24,
        rotor_force_max_n=5.0,  # a quarter of its 20 N bound
        yaw_per_force_m=1.1e-6 / 54.2e-6,
        thrust_coeff_n_s2=54.2e-6,
        rotor_inertia_kg_m2=1.08e-6,
        drag_rotation_1_s=(0.03, 0.03, 0.01),
        drag_n_s_m=(0.048, 0.11, 0.046),
        drag_scales_with_mass=True,
        motor_tau_s=0.0,
        rotor_radius_m=0.127,
    ),
    "x500": Preset(
        name="x500",  # PX4 1.18 SIH defaults
        mass_kg=1.0,
        inertia_kg_m2=(0.025, 0.025, 0.03),
        arm_m=0.2,
        rotor_force_max_n=5.0,
        yaw_per_force_m=0.02,
        thrust_coeff_n_s2=54.2e-6,
        rotor_inertia_kg_m2=0.0,
        drag_rotation_1_s=(0.0, 0.0, 0.0),
        drag_n_s_m=(1.0, 1.0, 1.0),
        drag_scales_with_mass=False,
        motor_tau_s=0.05,
        rotor_radius_m=0.127,  # 10 inch propellers
    ),
    # Crazyflie 2.1: mass, inertia, thrust, torque and drag of J. Foerster, System Identification of the Crazyflie 2.0
    # Nano Quadrocopter, ETH Zurich 2015 (28 g; Bitcraze's bare 2.1 weighs 27 g); motor lag of A. Molchanov et al.,
    # Sim-to-(Multi)-Real, IROS 2019 (settles within 2 % in 0.15 s, four time constants); propellers 47 mm.
    "crazyflie": Preset(
        name="crazyflie",
        mass_kg=0.028,
        inertia_kg_m2=(16.571710e-6, 16.655602e-6, 29.261652e-6),
        arm_m=0.046,
        rotor_force_max_n=0.1597,  # 2.130295e-11 c^2 + 1.032633e-6 c + 5.484560e-4 at full command c = 65535
        yaw_per_force_m=0.005964552,
        thrust_coeff_n_s2=1.9e-8,  # 0.0687 N at 1901 rad/s, hovering
        rotor_inertia_kg_m2=0.0,
        drag_rotation_1_s=(0.0, 0.0, 0.0),
        drag_n_s_m=(6.98e-3, 6.98e-3, 7.84e-3),  # (9.1785e-7, 10.311e-7) times the sum of four rotor speeds at hover
        drag_scales_with_mass=False,
        motor_tau_s=0.0375,
        rotor_radius_m=0.0235,
        cells=1,
    ),
    # ArduCopter 4.6.3 as measured with GUID_OPTIONS 8: hover 0.364-0.368, mean acceleration 0.25-0.7 s after
    # steps to 0.318, 0.418, 0.468. Vertical drag is fitted to these; lateral drag is small, as it drifts on when level.
    "arducopter": Preset(
        name="arducopter",
        mass_kg=3.0,
        inertia_kg_m2=(0.023, 0.023, 0.046),
        arm_m=0.175,
        rotor_force_max_n=20.185,  # hover at 0.3645
        yaw_per_force_m=0.02,
        thrust_coeff_n_s2=54.2e-6,
        rotor_inertia_kg_m2=0.0,
        drag_rotation_1_s=(0.0, 0.0, 0.0),
        drag_n_s_m=(0.15, 0.15, 1.35),
        drag_scales_with_mass=False,
        motor_tau_s=0.02,
        rotor_radius_m=0.15,  # disc area 0.28 m2
        cells=3,
    ),
}
