"""What the engine should do, said a second time: slow, obvious, and without a line of the engine's code.

Written from the semantics in docs/ and the design, so that a disagreement shows that one of the two is wrong. It keeps
all samples forever and computes everything anew at each tick.
"""
