"""Ends of agents on a pipe: read as they come, whole, and never waited for."""

from __future__ import annotations

import os
import time

import msgspec
import pytest

from swarmctl.agent.agent_end import AgentEnd, EndReader, write_end

LONGEST_LINE_BYTES = 4096  # that a pipe takes whole


def test_ends_are_read_as_they_come_and_a_line_only_when_it_is_whole() -> None:
    read_fd, write_fd = os.pipe()
    reader = EndReader(read_fd)
    assert reader.end_of(0) is None
    write_end(write_fd, AgentEnd(agent=2, exit_code=4, words="vehicle: silent for 15 s"))
    line = msgspec.json.encode(AgentEnd(agent=0, exit_code=0)) + b"\n"
    os.write(write_fd, line[:7])
    assert reader.end_of(2) == AgentEnd(agent=2, exit_code=4, words="vehicle: silent for 15 s")
    assert reader.end_of(0) is None
    os.write(write_fd, line[7:])
    assert reader.end_of(0) == AgentEnd(agent=0, exit_code=0)
    os.close(write_fd)
    assert reader.end_of(1) is None
    with pytest.raises(OSError, match="Bad file descriptor"):
        os.fstat(read_fd)
    assert reader.end_of(2) is not None, "what was read is kept"


def test_the_last_line_of_what_an_agent_says_is_told_as_of_a_process() -> None:
    read_fd, write_fd = os.pipe()
    write_end(write_fd, AgentEnd(agent=1, exit_code=2, words="a.toml: one problem\na.toml: another\n\n"))
    os.close(write_fd)
    end = EndReader(read_fd).end_of(1)
    assert end is not None
    assert end.words == "a.toml: another"


def test_looking_for_an_end_does_not_wait() -> None:
    read_fd, write_fd = os.pipe()
    reader = EndReader(read_fd)
    began_s = time.monotonic()
    assert reader.end_of(0) is None
    assert time.monotonic() - began_s < 1.0
    os.close(write_fd)
    assert reader.end_of(0) is None


@pytest.mark.parametrize(
    "words", ["\x1b" * 100_000, "\u202e" * 100_000, "\U000e0001" * 500, "é€😀" * 10_000, "\n" * 100_000]
)
def test_whatever_an_agent_says_is_one_line_that_a_pipe_takes_whole(words: str) -> None:
    read_fd, write_fd = os.pipe()
    write_end(write_fd, AgentEnd(agent=1, exit_code=1, words=words))
    written = os.read(read_fd, 1 << 20)
    assert len(written) <= LONGEST_LINE_BYTES
    assert written.count(b"\n") == 1
    os.close(read_fd)
    write_end(write_fd, AgentEnd(agent=1, exit_code=1))  # a supervisor that has gone is no error
    os.close(write_fd)
