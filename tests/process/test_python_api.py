"""Every block of code of docs/python_api.md is run as it stands, in its order, with fewer agents and less time."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

import swarmctl

pytestmark = pytest.mark.process

ROOT = Path(__file__).parents[2]
CODE = re.findall(r"^```python\n(.*?)^```$", (ROOT / "docs" / "python_api.md").read_text(), re.DOTALL | re.MULTILINE)
LAUNCHED = {"swarm.agents": 1, "telemetry.enabled": False, "sitl.ground_z_m": 1.0}  # long enough to be held
EXAMPLE = f"""\
    import sys

    sys.path.append({str(ROOT / "configs" / "examples")!r})
    import steer_swarm
    steer_swarm.climb_in_turn(swarm, range(1))
"""
SHORTER = {  # what flies is shortened, and the launch has nobody to look at it
    '"swarm.agents": 3': '"swarm.agents": 1, "sitl.start": "air"',
    '"mission.duration_s": 20.0': '"mission.duration_s": 3.0',
    "launch(config": f"launch(swarmctl.load(set={LAUNCHED})",
    '"configs/examples/figure_8_mission.toml"': f'"{ROOT}/configs/examples/figure_8_mission.toml"',
    "    swarm.resume()\n": f"    swarm.resume()\n{EXAMPLE}",  # configs/examples/steer_swarm.py steers the same launch
}


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[str]]:
    """The folder in which the page was run, and what it has printed."""
    code = "".join(CODE)
    for shown, short in SHORTER.items():
        assert code.count(shown) == 1, shown
        code = code.replace(shown, short)
    folder = tmp_path_factory.mktemp("page")
    (folder / "page.py").write_text(code)
    done = subprocess.run(
        [sys.executable, "page.py"], cwd=folder, capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode == 0, done.stderr
    return folder, done.stdout.splitlines()


def test_what_the_page_shows_is_true(flown: tuple[Path, list[str]]) -> None:
    _, said = flown
    assert said[0] == "<Run first: 1 agent, completed> []"
    assert "agent-0 TRACK" in said
    (told,) = (line for line in said if line.startswith("mean "))
    mean_m, largest_m = (float(number) for number in re.findall(r"[\d.]+(?= m)", told))
    assert 0.0 < mean_m < largest_m < 8.0
    (judged,) = (line for line in said if line.startswith("agent 0: mean "))
    assert float(judged.split()[3]) == pytest.approx(mean_m, abs=0.002)
    (paths,) = (line for line in said if " paths, " in line)
    count, ahead_s = (float(number) for number in re.findall(r"[\d.]+", paths))
    assert count > 25, "3 s of mission, fifty a second, and the way there"
    assert 0.5 < ahead_s < 3.0
    assert said[-1] == "interrupted", "it was landed before the end of its mission"
    (height,) = (line for line in said if line.startswith("agent 0 is at "))
    assert float(height.split()[-2]) == pytest.approx(1.5, abs=0.25), "the script waits until it is within 0.2 m"


def test_an_order_was_obeyed_by_the_vehicle_and_the_launch_has_ended(flown: tuple[Path, list[str]]) -> None:
    run = swarmctl.load_run(flown[0] / "runs" / "second")
    obeyed = [event["verb"] for event in run.events if event["event"] == "operator"]
    steered = ["hold", "goto", "resume"]
    assert obeyed[:8] == [*steered, *steered, "mission", "land"], "by the page, and by the example"
    (changed,) = (event for event in run.events if event["event"] == "mission_changed")
    assert '"lemniscate"' in changed["mission"]
    assert run.true_states(0)["landed"][-1].as_py() == "ON_GROUND"
    assert run.ticks(0)["phase"][-1].as_py() == "DONE"
