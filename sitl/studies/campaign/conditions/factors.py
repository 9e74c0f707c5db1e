"""Factors of a cell: protections and estimator noise, each as settings of the run's configuration."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Noise:
    """An estimator of `sitl.plant.estimator`, and the margins for flying on it."""

    accuracy_m: float  # rms per horizontal axis, as vehicles report it; radii grow to what it needs
    arrive_m: float  # added to the scenario's own, because positions are this uncertain
    settings: tuple[str, ...] = ()


_WANDERING = (
    "agent.state_filter.enabled=true",  # the reported velocity is biased against the reported position
    "agent.state_machine.arrive_m=0.5",
    "agent.state_machine.arrive_m_s=0.4",
)

PROTECTIONS: dict[str, tuple[str, ...]] = {
    "guaranteed": ("separation.mode=guaranteed",),
    "default": (),
    "off": ("controller.kind=mpc", "agent.barrier.enabled=false"),  # the same plans without avoidance
}

UNCOOPERATIVE = (*PROTECTIONS["off"], "separation.mode=best_effort")  # makes no commitments either

NOISES: dict[str, Noise] = {
    "exact": Noise(0.01, 0.0),
    "external": Noise(0.04, 0.15, ("sitl.estimator=external", *_WANDERING)),
    "gps": Noise(0.29, 0.85, ("sitl.estimator=gps", *_WANDERING)),
}


def wind_settings(wind_m_s: float) -> tuple[str, ...]:
    """Return the settings of a steady wind that blows east, and Dryden turbulence of the same wind at 6 m."""
    if not wind_m_s:
        return ()
    return (f"sitl.wind.mean_ned_m_s=[0.0, {wind_m_s}, 0.0]", f"sitl.wind.turbulence_m_s={wind_m_s}")
