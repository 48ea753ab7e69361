"""`python -m morph_dslam`: the command `morph`."""

import sys

from morph_dslam.cli.app import main

sys.exit(main())
