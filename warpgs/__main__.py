"""``python -m warpgs``."""

import sys

from .cli import main

sys.exit(main())
