"""Simulated autopilots bring vehicles to rest as real ones did: 0.8, 1.2, 2 and 4 s after they were left."""

from __future__ import annotations

import math

import numpy as np
import pytest

from tests.benches.simulated_stops import stopped
from tests.benches.stops import SILENCE, Course

AFTER_S = np.array([0.8, 1.2, 2.0, 4.0])
SOON_M, LATER_M = 0.12, 0.4  # tolerance at the first two times, and at the last two
LINE_2, LINE_3 = Course(speed_m_s=2.0), Course(speed_m_s=3.0)
CIRCLE_2, CIRCLE_3 = Course(speed_m_s=2.0, radius_m=2.0), Course(speed_m_s=3.0, radius_m=3.0)

# What real ones did, PX4 1.18 and ArduCopter 4.6.3, by true states: how far they went ahead and to the right [m]. Means
# of two flights, of three on the smaller circle; one on the larger.
MEASURED = [
    ("px4", LINE_2, SILENCE, [1.58, 2.21, 2.74, 2.88], [0.01, 0.03, 0.07, 0.27]),
    ("px4", CIRCLE_2, SILENCE, [1.52, 2.06, 2.52, 2.60], [0.57, 1.00, 1.35, 1.16]),
    ("px4", LINE_2, "hold", [1.31, 1.54, 1.45, 1.83], [0.00, 0.00, 0.01, -0.09]),
    ("arducopter", LINE_3, SILENCE, [2.40, 3.59, 5.69, 7.28], [0.00, -0.01, -0.01, -0.03]),
    ("arducopter", LINE_2, "brake", [1.41, 1.88, 2.49, 3.10], [0.00, 0.00, -0.01, 0.00]),
    ("arducopter", CIRCLE_2, "brake", [1.46, 1.94, 2.59, 3.21], [0.39, 0.60, 0.74, 0.28]),
    ("arducopter", CIRCLE_3, "brake", [2.20, 2.95, 3.96, 4.99], [0.57, 0.87, 1.03, 0.31]),
]


@pytest.mark.parametrize(("kind", "course", "how", "ahead_m", "aside_m"), MEASURED)
def test_simulated_vehicles_that_are_left_go_where_real_ones_went(
    kind: str, course: Course, how: str, ahead_m: list[float], aside_m: list[float]
) -> None:
    stop = stopped(kind, course, how)
    heading, went_m = stop.heading_rad(), stop.at(AFTER_S)
    ahead = went_m[:, 0] * math.cos(heading) + went_m[:, 1] * math.sin(heading)
    aside = went_m[:, 1] * math.cos(heading) - went_m[:, 0] * math.sin(heading)
    apart_m = np.hypot(ahead - ahead_m, aside - aside_m)
    assert (apart_m[:2] < SOON_M).all() and (apart_m[2:] < LATER_M).all(), apart_m.round(2)
