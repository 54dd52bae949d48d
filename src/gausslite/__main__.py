"""`python -m gausslite` is the `gausslite` command."""

import sys

from gausslite.cli.main import main

sys.exit(main())
