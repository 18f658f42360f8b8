"""Trains SplitGaussian: ``python train.py --data nerfds/as`` is ``warpgs train --data nerfds/as``."""

import sys

from warpgs.cli import train

if __name__ == "__main__":
    sys.exit(train(sys.argv[1:], "train.py"))
