"""Flies `swarmctl campaign`, for programs that call it by this path; see its `--help`."""

from __future__ import annotations

import sys

from sitl.studies.campaign.command import main

if __name__ == "__main__":
    sys.exit(main())
