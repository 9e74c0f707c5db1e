"""Wind, battery, rotors and faults from a configuration to the simulator: in lockstep, and through a launch's argv."""

from __future__ import annotations

from pathlib import Path
from typing import get_args

import pytest

from sitl.__main__ import _config, _parser
from sitl.autopilot_kinds import AUTOPILOT_KINDS
from sitl.lockstep import Lockstep
from sitl.plant.airframes import PRESETS
from sitl.plant.attitude import THESIS_GAINS
from sitl.plant.estimator import ESTIMATORS
from swarmctl.config import Config, dump, load
from swarmctl.errors import ConfigError
from swarmctl.ops.processes import RunContext, sitl_command
from swarmctl.simulator_config import SimulatorConfig, SimulatorParams

OUTFIT = (
    "sitl.wind.mean_ned_m_s=[3.6,0,0.5]",
    "sitl.wind.turbulence_m_s=7.7",
    "sitl.battery.capacity_mah=3000",
    "sitl.thrust_curve_01=0.3",
    "sitl.motor_tau_s=0.08",
    "sitl.drag_scale=0.5",
    "sitl.ground_effect=true",
    'sitl.faults=[{kind="motor", vehicle=1, at_s=0.2, value=0.7, for_s=0.1}, {kind="gps_loss", at_s=30.0}]',
)


@pytest.fixture(scope="module")
def config() -> Config:
    return load(None, OUTFIT)


def test_a_resolved_configuration_reads_back_the_same(config: Config, tmp_path: Path) -> None:
    (tmp_path / "config.toml").write_text(dump(config), encoding="utf-8")
    assert load(tmp_path / "config.toml") == config


def test_lockstep_flies_what_was_configured(config: Config) -> None:
    params = Lockstep(config).world.params
    assert {key: getattr(params, key) for key in SimulatorParams.model_fields} == {
        key: getattr(config.sitl, key) for key in SimulatorParams.model_fields
    }
    assert (params.faults[0].value, params.drag_scale) == (0.7, 0.5)


def test_a_launch_hands_everything_to_its_simulator(config: Config, tmp_path: Path) -> None:
    context = RunContext("run", f"unixsock-stream/{tmp_path}/bus.sock", tmp_path, (0, 1, 2))
    argv = sitl_command(config, context, (1, 2, 3)).argv
    options = _parser().parse_args(list(argv[3:]))
    assert _config(options) == config.simulator() == Lockstep(config).world.params
    assert options.control == tmp_path / "sitl.sock"


def test_flags_and_sets_say_the_same() -> None:
    flags = _parser().parse_args(["--drag-scale", "0.5", "--ground-effect", "true", "--preset", "x500"])
    sets = _parser().parse_args(["--set", "drag_scale=0.5", "--set", "ground_effect=true", "--set", "preset=x500"])
    assert _config(flags) == _config(sets) == SimulatorConfig(drag_scale=0.5, ground_effect=True, preset="x500")


def test_every_choice_of_the_configuration_exists_in_the_simulator() -> None:
    def choices(key: str) -> tuple[str, ...]:
        return get_args(SimulatorParams.model_fields[key].annotation)

    assert choices("preset") == tuple(PRESETS)
    assert choices("attitude_gains") == tuple(THESIS_GAINS)
    assert choices("estimator") == tuple(ESTIMATORS)


def test_faults_of_a_configuration_happen_in_lockstep_and_are_logged(config: Config) -> None:
    flight = Lockstep(config)
    for _ in range(20):
        flight.step()
    events = [(e["event"], e["kind"], e["vehicle"], e["since_boot_us"]) for e in flight.fault_events]
    assert events == [("fault_began", "motor", 1, 200_000), ("fault_ended", "motor", 1, 300_000)]


def test_every_autopilot_that_a_configuration_can_name_has_a_row() -> None:
    assert set(AUTOPILOT_KINDS) == set(get_args(SimulatorConfig.model_fields["autopilot_kind"].annotation))


@pytest.mark.parametrize(
    ("item", "complaint"),
    [
        ('faults=[{kind="motor", vehicle=3}]', "sitl.faults.0.vehicle = 3: allowed: 0 to 2"),
        ('faults=[{kind="motor", value=2.0}]', "sitl.faults.0.value = 2.0: allowed for motor: 0 to 1"),
        ('faults=[{kind="gust", value=2.0}]', "sitl.faults.0.for_s = 0.0: gust has to end"),
        ('faults=[{kind="meteor"}]', "sitl.faults.0.kind = 'meteor'"),
        ('faults=[{kind="motor", when=3}]', "sitl.faults.0.when = 3: unknown key"),
        ("wind.turbulence_m_s=31", "sitl.wind.turbulence_m_s = 31"),
        ("wind.mean_ned_m_s=[50,0,0]", "sitl.wind.mean_ned_m_s.0 = 50"),
        ("wind.gust_for_s=0", "sitl.wind.gust_for_s = 0"),
        ("wind.turbulence=3", "did you mean 'turbulence_m_s'"),
        ("battery.capacity_mah=-1", "sitl.battery.capacity_mah = -1"),
        ("battery.charge_01=0", "sitl.battery.charge_01 = 0"),
        ("thrust_curve_01=1.5", "sitl.thrust_curve_01 = 1.5"),
        ("motor_tau_s=2", "sitl.motor_tau_s = 2"),
        ("drag_scale=-1", "sitl.drag_scale = -1"),
        ("estimator=perfect", "input should be 'exact', 'gps', 'external', 'px4_gps' or 'px4_external'"),
        ("autopilot_kind=inav", "sitl.autopilot_kind = 'inav'"),
        ("speed=5", "agents fly on wall time"),
    ],
)
def test_wrong_values_are_refused(item: str, complaint: str) -> None:
    with pytest.raises(ConfigError) as refused:
        load(None, [f"sitl.{item}"])
    assert complaint in str(refused.value)
