"""Build kstatus where it is missing; print its folder."""

import sys

from tests.kstatus import main

sys.exit(main())
