"""Seeded Monte Carlo in lockstep: scenario x agents x delay x loss x noise x wind x protections, judged on true states.

See `python tools/campaign.py --help` and `sitl.studies.campaign`.
"""

from __future__ import annotations

import sys

from sitl.studies.campaign.command import main

if __name__ == "__main__":
    sys.exit(main())
