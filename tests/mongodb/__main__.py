import sys

from tests.mongodb import main

sys.exit(main())
