"""Figures of a vehicle's motion: thrust and attitude response, measured from its reports.

Each measure looks at samples (seconds since the mark, message), newest last.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

Samples = Sequence[tuple[float, Any]]


@dataclass(frozen=True, slots=True)
class Measure:
    """A figure and the message it is made from."""

    source: str
    of: Callable[[Samples], float]


def _crossing_s(samples: Samples, angle: str, target_rad: float, share: float) -> float:
    """When the angle first passes a share of the way from its first sample to the target."""
    start = getattr(samples[0][1], angle)
    for t_s, sample in samples:
        if abs(getattr(sample, angle) - start) >= share * abs(target_rad - start):
            return t_s
    return math.inf


def _rise(angle: str, target_deg: float, share: float) -> Callable[[Samples], float]:
    return lambda samples: _crossing_s(samples, angle, math.radians(target_deg), share)


def _highest_deg(angle: str) -> Callable[[Samples], float]:
    return lambda samples: max(math.degrees(getattr(m, angle)) for _, m in samples)


def _last_deg(angle: str) -> Callable[[Samples], float]:
    return lambda samples: math.degrees(getattr(samples[-1][1], angle))


def _highest_tilt_deg(samples: Samples) -> float:
    return max(math.degrees(math.acos(math.cos(m.roll) * math.cos(m.pitch))) for _, m in samples)


def _climb_m(samples: Samples) -> float:
    return float(samples[0][1].z - min(m.z for _, m in samples))


def _height_change_m(samples: Samples) -> float:
    return abs(float(samples[-1][1].z - samples[0][1].z))


def _height_m(samples: Samples) -> float:
    return -float(samples[-1][1].z)


def _height_above_home_m(samples: Samples) -> float:
    return float(samples[-1][1].relative_alt) * 1e-3


def _acceleration_down_m_s2(samples: Samples) -> float:
    """Slope of the reported velocity over the vehicle's own time, between 0.25 and 0.7 s."""
    rows = [(m.time_boot_ms * 1e-3, m.vz) for t_s, m in samples if 0.25 <= t_s <= 0.7]
    boot_s, speed_m_s = np.array(rows).T
    return float(np.polyfit(boot_s, speed_m_s, 1)[0])


def _mean_thrust_01(samples: Samples) -> float:
    return float(np.mean([m.thrust for _, m in samples]))


MEASURES: dict[str, Measure] = {
    "climb_m": Measure("LOCAL_POSITION_NED", _climb_m),
    "height_change_m": Measure("LOCAL_POSITION_NED", _height_change_m),
    "height_m": Measure("LOCAL_POSITION_NED", _height_m),
    "height_above_home_m": Measure("GLOBAL_POSITION_INT", _height_above_home_m),
    "acceleration_down_m_s2": Measure("LOCAL_POSITION_NED", _acceleration_down_m_s2),
    "mean_thrust_01": Measure("ATTITUDE_TARGET", _mean_thrust_01),
    "highest_tilt_deg": Measure("ATTITUDE", _highest_tilt_deg),
    **{f"{a}_highest_deg": Measure("ATTITUDE", _highest_deg(a)) for a in ("roll", "pitch", "yaw")},
    **{f"{a}_last_deg": Measure("ATTITUDE", _last_deg(a)) for a in ("roll", "pitch", "yaw")},
    **{
        f"{a}_{target}_t{share}_s": Measure("ATTITUDE", _rise(a, target, share / 100))
        for a, target in (("roll", 10), ("pitch", 10), ("roll", 30), ("yaw", 20))
        for share in (10, 50, 63, 90)
    },
}
