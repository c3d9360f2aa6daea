#!/usr/bin/env python
"""`python run.py demo`: the command `taichi-edges` from a checkout, installed or not."""

import sys

from taichi_edges.corridor.arguments import main

if __name__ == "__main__":
    sys.exit(main())
