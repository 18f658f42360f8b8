"""Trains SplitGaussian: ``python train.py --data nerfds/as`` is ``warpgs train --data nerfds/as``."""

import sys

from warpgs.training.command import main

if __name__ == "__main__":
    sys.exit(main())
