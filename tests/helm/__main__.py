"""Build Helm and the registry where they are missing; print their folder."""

import sys

from tests.helm import main

sys.exit(main())
