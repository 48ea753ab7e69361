"""`python -m morph_dslam.cli`."""

import sys

from morph_dslam.cli.app import main

sys.exit(main())
