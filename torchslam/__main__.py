"""`python -m torchslam` is the command `torchslam`, also where the scripts of an environment are not on the path."""

import sys

from torchslam.cli.main import main

sys.exit(main())
