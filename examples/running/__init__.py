"""Runs the use cases: `python -m examples.running --help`.

A use case is a folder beside this one with a `scenario.py`, whose function `scenario()` defines the real events
(the messages) and, from that alone, what must be detected and done. The runner plays the messages to the detector's own
engine with the folder's `detector.yaml` and `rules.yaml`, lets the rules' actions do their work, and compares.

    cases ─▶ scenario.py ─▶ recording (an MCAP file) ─▶ playing (engine, actions) ─▶ judging
                   └───────────────── what must come of it ─────────────────────────────┘
"""
