"""The six experiments of the thesis as flights: which preset flies what, from which start and at which radius."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

from sitl.studies.thesis import score
from sitl.studies.thesis.figures import FlightName
from sitl.studies.thesis.thesis_values import differences, with_thesis_values
from sitl.studies.thesis.trace import Path, Trace
from swarmctl.built_in_configs import built_in_config
from swarmctl.config import Config, load
from swarmctl.control.collision.barrier import BarrierParams
from swarmctl.control.collision.separation import SeparationParams

SAFE_RADIUS_M = 0.3
RADII: tuple[float, ...] = (3.0, 2.7, 2.5, 2.3, 2.0, 1.5, 1.0)  # times SAFE_RADIUS_M; the thesis stops at 2
TABLE_19_M: dict[float, float | None] = {3.0: 2.19, 2.7: 2.04, 2.5: 1.95, 2.3: 1.85}  # violated at 2
BODY_M = SeparationParams().body_m  # centres of two vehicles that touch
SAFETY_FILTER_M = SeparationParams().budget.barrier_m(BarrierParams().margin_m)  # what the safety filter keeps
THESIS, TUNED = "thesis values", "tuned"  # kinds of presets; tuned ones differ, see `Job.differences`
FULL_LOOP = ", full MAVLink loop"
_CERTIFIED_01 = 0.11  # share of the radius: certificate slack when the radius is small

Flown = Mapping[str, Trace]  # by job name


@dataclass(frozen=True, slots=True, kw_only=True)
class Job:
    """One flight of the table."""

    flight: FlightName
    name: str  # says "tuned" if and only if the preset differs from the thesis' values
    config: str  # name of a built-in configuration
    path: Path = "plant"
    overrides: tuple[str, ...] = ()
    thesis_values: bool = False  # all that the thesis prints replaces what the configuration says
    matched_velocity: bool = False  # starts with the reference's velocity; model only
    radius_m: float | None = None  # constraint radius, where a row depends on it

    @property
    def preset(self) -> str:
        """Return what the flown values of the controller are called."""
        return f"{self.config}, {THESIS}" if self.thesis_values else self.config

    def loaded(self) -> Config:
        """Return the configuration that is flown."""
        printed = with_thesis_values(self.flight) if self.thesis_values else ()
        return load(built_in_config(self.config), (*printed, *self.overrides))

    def differences(self) -> tuple[str, ...]:
        """Return in what the flown controller differs from the thesis' values."""
        return differences(self.flight, self.loaded())


def at_radius(radius_m: float) -> tuple[str, ...]:
    """Return the overrides of a swarm flight at another constraint radius.

    Where the safety filter would keep more than the radius, it is off: the vehicles of the thesis are points.
    """
    slack_m = min(0.1, _CERTIFIED_01 * radius_m)
    return (
        f"separation.radius_m={radius_m:.4f}",
        "separation.allow_small_radius=true",  # the thesis' vehicles are points
        f"separation.certify_slack_m={slack_m:.4f}",
        "limits.min_separation_m=0.1",
        *(("agent.barrier.enabled=false",) if radius_m < SAFETY_FILTER_M else ()),
    )


def radius_name(kind: str, factor: float) -> str:
    return f"circle {kind} {factor:g} x 0.3 m"


def _single(speed: str) -> Iterator[Job]:
    pid: FlightName = "pid_slow" if speed == "slow" else "pid_fast"
    mpc: FlightName = "mpc_slow" if speed == "slow" else "mpc_fast"
    yield Job(flight=pid, name=f"{pid} {THESIS}", config=f"thesis_4_{pid}")
    yield Job(flight=pid, name=f"{pid} {TUNED}", config=f"improved_4_{pid}")
    for kind, config in ((THESIS, f"thesis_4_{mpc}"), (TUNED, f"improved_4_{mpc}")):
        yield Job(flight=mpc, name=f"{mpc} {kind}", config=config)
        yield Job(flight=mpc, name=f"{mpc} {kind}, matched start", config=config, matched_velocity=True)


def _plant_jobs() -> Iterator[Job]:
    yield Job(flight="open_loop", name="open_loop", config="thesis_1_open_loop")
    yield Job(flight="pid_step", name="pid_step", config="thesis_2_pid_step")
    yield Job(flight="pid_steps", name="pid_steps", config="thesis_3_pid_steps")
    yield from _single("slow")
    yield from _single("fast")
    for factor in (factor for factor in RADII if factor >= 2.0):
        yield _circle(f"dmpc {THESIS}", factor, "thesis_5_circle", thesis_values=True)
    for factor in RADII:
        yield _circle(f"dmpc {TUNED}", factor, "thesis_5_circle")
    for factor in RADII:
        yield _circle(f"dmpc3 {TUNED}", factor, "improved_5_circle_dmpc3")
    yield Job(flight="obstacle", name=f"obstacle dmpc {THESIS}", config="thesis_6_obstacle", thesis_values=True)
    yield Job(flight="obstacle", name=f"obstacle dmpc {TUNED}, thesis weights", config="thesis_6_obstacle")
    yield Job(flight="obstacle", name=f"obstacle dmpc {TUNED}", config="improved_6_obstacle")
    yield Job(flight="obstacle", name=f"obstacle dmpc3 {TUNED}", config="improved_6_obstacle_dmpc3")


def _circle(kind: str, factor: float, config: str, *, thesis_values: bool = False) -> Job:
    radius_m = factor * SAFE_RADIUS_M
    return Job(
        flight="circle",
        name=radius_name(kind, factor),
        config=config,
        overrides=at_radius(radius_m),
        thesis_values=thesis_values,
        radius_m=radius_m,
    )


def _is_flown_in_full(job: Job) -> bool:
    """Return whether agents fly it too: none of them starts in motion, and the printed values are for the model."""
    return not job.matched_velocity and not job.thesis_values


PLANT_JOBS: tuple[Job, ...] = tuple(_plant_jobs())
FULL_JOBS: tuple[Job, ...] = tuple(
    replace(job, name=f"{job.name}{FULL_LOOP}", path="full") for job in PLANT_JOBS if _is_flown_in_full(job)
)


def is_flown_again(job: Job) -> bool:
    """Return whether a second flight is needed, at equal true distance: the default controller, model only."""
    return job.path == "plant" and job.preset == "thesis_5_circle"


def wider(job: Job, trace: Trace) -> Job:
    """Return the same swarm flight with the constraint radius widened by the shortfall of its true distances."""
    assert job.radius_m is not None
    radius_m = job.radius_m + max(0.0, job.radius_m - score.separation_m(trace))
    return replace(job, name=f"{job.name}, true distance", overrides=at_radius(radius_m), radius_m=radius_m)
