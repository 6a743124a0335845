import sys

from tests.s3 import main

sys.exit(main())
