"""The view in a browser: a page on loopback, of a recording and of a live view, that ends with its command."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
import time
import urllib.request
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import psutil
import pytest

from swarmctl.errors import StartError
from swarmctl.telemetry.recording.run_files import load_run
from swarmctl.telemetry.scene.viewed_flight import AgentBounds, ViewedFlight
from swarmctl.telemetry.view.recordings import simulated_recording
from swarmctl.telemetry.view.web_page import web_page
from tests.benches.recorded_runs import write_configured_run

pytestmark = [pytest.mark.process, pytest.mark.timeout(120)]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a finished run of two agents, with its recording."""
    directory = tmp_path_factory.mktemp("run")
    write_configured_run(directory, 2, 2.0)
    simulated_recording(directory, load_run(directory), ViewedFlight(agents=(AgentBounds(),) * 2))
    return directory


def listeners(pid: int) -> list[tuple[str, int]]:
    """Return the addresses on which a process and its children listen."""
    family = [psutil.Process(pid), *psutil.Process(pid).children(recursive=True)]
    found = [connection for process in family for connection in process.net_connections("tcp")]
    return [(c.laddr.ip, c.laddr.port) for c in found if c.status == psutil.CONN_LISTEN]


def test_a_recording_is_served_to_browsers_of_this_computer_until_the_command_ends(folder: Path) -> None:
    command = [sys.executable, "-m", "swarmctl", "replay", str(folder), "--web"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        shown = re.search(r"http://\S+", process.stdout.readline())
        assert shown
        page = urlsplit(shown.group())
        with urllib.request.urlopen(shown.group(), timeout=20) as answer:
            assert b"web viewer" in answer.read()
        (source,) = parse_qs(page.query)["url"]
        addresses = listeners(process.pid)
        assert {ip for ip, _ in addresses} == {"127.0.0.1"}, "nobody else reaches it"
        assert {port for _, port in addresses} == {page.port, urlsplit(source).port}
        children = psutil.Process(process.pid).children(recursive=True)
    finally:
        process.send_signal(signal.SIGINT)
        code = process.wait(20)
    assert code == 0
    assert not psutil.wait_procs(children, timeout=10)[1]


def test_a_live_view_is_shown_where_it_is_served_and_its_page_dies_with_the_command(tmp_path: Path) -> None:
    script = tmp_path / "show.py"
    script.write_text(
        "import time\n"
        "from swarmctl.telemetry.view.web_page import web_page\n"
        "with web_page('rerun+http://127.0.0.1:9876/proxy') as page:\n"
        "    print(page.url, flush=True)\n"
        "    time.sleep(60)\n"
    )
    process = subprocess.Popen([sys.executable, str(script)], stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        url = process.stdout.readline().strip()
        assert parse_qs(urlsplit(url).query)["url"] == ["rerun+http://127.0.0.1:9876/proxy"]
        assert listeners(process.pid) == [("127.0.0.1", urlsplit(url).port)]
        (served,) = psutil.Process(process.pid).children()
    finally:
        process.kill()  # without a chance to end what it has started
        process.wait(10)
    until_s = time.monotonic() + 10.0
    while served.is_running() and served.status() != psutil.STATUS_ZOMBIE and time.monotonic() < until_s:
        time.sleep(0.05)
    assert not served.is_running() or served.status() == psutil.STATUS_ZOMBIE


def test_two_that_are_begun_at_once_serve_two_pages(folder: Path) -> None:
    """Each its own recording: a server whose data port is taken would send to the other one."""
    command = [sys.executable, "-m", "swarmctl", "replay", str(folder), "--web"]
    both = [subprocess.Popen(command, stdout=subprocess.PIPE, text=True) for _ in range(2)]
    try:
        ports: list[int | None] = []
        for process in both:
            assert process.stdout is not None
            shown = re.search(r"http://\S+", process.stdout.readline())
            assert shown, "it has said where it is"
            page = urlsplit(shown.group())
            ports += [page.port, urlsplit(parse_qs(page.query)["url"][0]).port]
            assert {port for _, port in listeners(process.pid)} == {*ports[-2:]}
            with urllib.request.urlopen(shown.group(), timeout=20) as answer:
                assert b"web viewer" in answer.read()
        assert len({*ports}) == 4
    finally:
        for process in both:
            process.send_signal(signal.SIGINT)
        codes = [process.wait(20) for process in both]
    assert codes == [0, 0]


def test_what_is_no_recording_is_refused(tmp_path: Path) -> None:
    with pytest.raises(StartError, match="no such recording"), web_page(str(tmp_path / "telemetry.rrd")):
        pytest.fail("nothing is served")
