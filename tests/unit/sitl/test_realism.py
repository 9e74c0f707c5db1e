"""Wind, battery, rotors and faults from a configuration to the simulator: in lockstep, and through a launch's argv."""

from __future__ import annotations

from pathlib import Path

import pytest

from sitl.__main__ import _parser, _realism, main
from sitl.lockstep import Lockstep, sitl_params
from swarmctl.config import Config, dump, load
from swarmctl.core.simulated import RealismParams
from swarmctl.errors import ConfigError
from swarmctl.ops.processes import RunContext, sitl_command

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
    realism = sitl_params(config).realism
    assert realism == config.sitl.realism()
    assert realism.faults[0].value == 0.7
    assert sitl_params(load(None)).realism == RealismParams()


def test_a_launch_hands_everything_to_its_simulator(config: Config, tmp_path: Path) -> None:
    context = RunContext("run", f"unixsock-stream/{tmp_path}/bus.sock", tmp_path)
    argv = sitl_command(config, context, (1, 2, 3)).argv
    options = _parser().parse_args(list(argv[3:]))
    assert _realism(options) == config.sitl.realism()
    assert options.control == tmp_path / "sitl.sock"
    plain = sitl_command(load(None), context, (1, 2, 3)).argv
    assert not [item for item in plain if item.startswith("--set")]
    assert _realism(_parser().parse_args(list(plain[3:]))) == RealismParams()


def test_flags_and_sets_say_the_same() -> None:
    flags = _parser().parse_args(["--wind=1,2,0", "--turbulence", "5"])
    sets = _parser().parse_args(["--set", "wind.mean_ned_m_s=[1,2,0]", "--set", "wind.turbulence_m_s=5"])
    assert _realism(flags) == _realism(sets) != RealismParams()


def test_faults_of_a_configuration_happen_in_lockstep_and_are_logged(config: Config) -> None:
    flight = Lockstep(config)
    for _ in range(20):
        flight.step()
    events = [(e["event"], e["kind"], e["vehicle"], e["since_boot_us"]) for e in flight.fault_events]
    assert events == [("fault_began", "motor", 1, 200_000), ("fault_ended", "motor", 1, 300_000)]


@pytest.mark.parametrize(
    ("item", "complaint"),
    [
        ('faults=[{kind="motor", vehicle=3}]', "sitl.faults.0.vehicle = 3: allowed: 0 to 2"),
        ('faults=[{kind="motor", value=2.0}]', "sitl.faults.0.value = 2.0: allowed for motor: 0 to 1"),
        ('faults=[{kind="gust", value=2.0}]', "sitl.faults.0.for_s = 0.0: gust has to end"),
        ('faults=[{kind="meteor"}]', "sitl.faults.0.kind = 'meteor'"),
        ('faults=[{kind="motor", when=3}]', "sitl.faults.0.when = 3: unknown key"),
    ],
)
def test_wrong_faults_are_refused(item: str, complaint: str) -> None:
    with pytest.raises(ConfigError) as refused:
        load(None, [f"sitl.{item}"])
    assert complaint in str(refused.value)


@pytest.mark.parametrize(
    "arguments",
    [["--set", "preset=x500"], ["--set", "wind.speed=3"], ["--wind", "1,2"], ["--speed", "0"], ["--turbulence", "99"]],
)
def test_wrong_arguments_are_one_clear_line(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    try:
        code = main(arguments)
    except SystemExit as end:
        code = int(end.code or 0)
    error = capsys.readouterr().err
    assert (code, error.count("\n"), error[:6]) == (2, 1, "sitl: ")
