"""`python -m taichi_edges`: the same as the command `taichi-edges`."""

import sys

from taichi_edges.corridor.arguments import main

sys.exit(main())
