"""What is imported at the start is no garbage: it is not looked through, then or later."""

from __future__ import annotations

import gc

from wayside.beginning import importing


def test_no_garbage_is_looked_for_while_importing_nor_in_what_was_imported() -> None:
    try:
        with importing():
            assert not gc.isenabled()
            imported = [[number] for number in range(10)]
        assert gc.isenabled()
        assert not {id(each) for each in imported} & {id(each) for each in gc.get_objects()}
    finally:
        gc.unfreeze()
