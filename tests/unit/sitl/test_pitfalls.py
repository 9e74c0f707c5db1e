"""Pitfalls for clients of PX4, present in the simulated one too; figures are those of PX4 1.18 in its simulator."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import pytest

from sitl.plant.estimator import ESTIMATORS, EXACT_ACCURACY_M
from tests.benches.px4_bench import COARSE, Bench

CURRENT_MODE, ESTIMATOR_STATUS, SYS_STATUS, HEARTBEAT = 436, 230, 1, 0
PREARM = 0x10000000


def claims(estimator: str, ekf_ready_s: float = 4.0, seconds: float = 12.0) -> list[Any]:
    """ESTIMATOR_STATUS at 10 Hz from the first frame on."""
    bench = Bench(wait_s=1.35, ekf_ready_s=ekf_ready_s, estimator=estimator, **COARSE)
    bench.command(511, ESTIMATOR_STATUS, 100_000)
    bench.run(seconds - 1.35)
    return bench.said(ESTIMATOR_STATUS)


@pytest.mark.parametrize("estimator", ["exact", "gps", "external"])
def test_after_boot_the_estimator_claims_to_be_far_off_then_far_too_good(estimator: str) -> None:
    model = ESTIMATORS[estimator]
    settled_m = (model.accuracy_m if model else EXACT_ACCURACY_M)[0]
    told = {round(m.time_usec * 1e-6, 1): m for m in claims(estimator)}
    assert told[1.5].pos_horiz_accuracy == pytest.approx(14.14, abs=0.01)
    assert told[1.5].flags == 164
    assert told[2.2].pos_horiz_accuracy < 0.06 * settled_m
    assert told[2.2].flags == 229
    assert told[4.2].pos_horiz_accuracy == pytest.approx(0.26 * settled_m, rel=0.2)
    assert told[4.2].flags == 1023
    assert told[9.0].pos_horiz_accuracy == pytest.approx(settled_m)
    rise = [m.pos_horiz_accuracy for t_s, m in sorted(told.items()) if t_s >= 2.1]
    assert all(later >= earlier for earlier, later in pairwise(rise))


def test_gps_settles_at_what_real_px4_claims() -> None:
    assert claims("gps")[-1].pos_horiz_accuracy == pytest.approx(0.285, abs=0.01)


def test_a_rebooted_estimator_settles_again() -> None:
    bench = Bench(ekf_ready_s=4.0, wait_s=12.0, estimator="gps", **COARSE)
    bench.world.reboot(0, bench.world.since_boot_us)
    bench.forget()
    bench.run(3.0)
    assert bench.said(ESTIMATOR_STATUS)[0].pos_horiz_accuracy > 10.0
