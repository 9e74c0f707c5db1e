"""Who gives way lowers itself, and its session only where nobody else is in that."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from swarmctl.process_priority import WATCHER_NICE

GIVES_WAY = """if True:
    import os
    from pathlib import Path
    from swarmctl.process_priority import give_way
    give_way()
    print(os.getpriority(os.PRIO_PROCESS, 0), Path("/proc/self/autogroup").read_text().split()[-1])"""
IN_THE_SESSION_OF_ANOTHER = f"""if True:
    import subprocess, sys
    subprocess.run([sys.executable, "-c", {GIVES_WAY!r}], check=True)"""


@pytest.mark.skipif(not Path("/proc/self/autogroup").exists(), reason="the kernel does not weigh sessions")
@pytest.mark.parametrize(
    ("code", "session_nice"), [(GIVES_WAY, WATCHER_NICE), (IN_THE_SESSION_OF_ANOTHER, 0)], ids=["its own", "another's"]
)
def test_a_session_is_lowered_by_its_only_process_alone(code: str, session_nice: int) -> None:
    """A viewer that was started in the session of a terminal, or of tests, left a tenth of their time to all of it."""
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True, start_new_session=True
    )
    assert done.stdout.split() == [str(WATCHER_NICE), str(session_nice)]
