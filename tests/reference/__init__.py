"""A second implementation of the engine: slow, simple, and without any of the engine's code.

Written from the semantics in docs/ and the design, so that a disagreement shows that one of the two is wrong. It keeps
all samples forever and recomputes everything at each tick.
"""
