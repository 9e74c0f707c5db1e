"""Imported for its effect, before numpy: linear algebra on one thread, as in the processes of a launch.

Matrices here are far too small to share out. SLSQP's library shares them out all the same, and then waits for the other
processor: on a busy machine that makes it up to ten times slower.
"""

from __future__ import annotations

import os

for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")
