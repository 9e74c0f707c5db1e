"""Events on a disk that fills up: one may be lost, and none makes another unreadable."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

FILLS = """
import resource, sys
from pathlib import Path
from swarmctl.telemetry.recording.event_log import EventLog
path = Path(sys.argv[1])
log = EventLog(path, "launch")
log.write("one")
most = path.stat().st_size + 30
resource.setrlimit(resource.RLIMIT_FSIZE, (most, resource.RLIM_INFINITY))
log.write("lost")  # has no room for the end of its line
resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
log.write("obstacles", list=[1, 2])
"""


def test_an_event_that_is_cut_off_by_a_full_disk_takes_none_with_it(tmp_path: Path) -> None:
    path = tmp_path / "launch.events.jsonl"
    subprocess.run([sys.executable, "-c", FILLS, str(path)], check=True, timeout=60)
    assert [json.loads(line)["event"] for line in path.read_text().splitlines()] == ["one", "obstacles"]
