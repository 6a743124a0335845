"""Leaves the manager's worker processes in the usual scheduling class, each as nice as it is.

Python imports this at its start where this folder is on the path. In the idle class a process gets a thousandth of the
time that each of the others gets. A manager has its container for itself, but here all tests share two cores with it.
"""

import os

if hasattr(os, "SCHED_IDLE"):
    delattr(os, "SCHED_IDLE")
